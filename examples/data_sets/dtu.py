"""DTU in the two layouts of MVSNet: reduced images with depth for training, scans with full images for evaluation.

Files are in millimetres; loaded data is in metres.
"""

from __future__ import annotations

import re
from collections.abc import Container, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from examples.data_sets.scan_depth import ScanDepth
from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource, HoldoutOptions
from vg2gt.data.sources.index import SceneIndex, check_found, first_size, make_index
from vg2gt.data.sources.parsing import (
    check_intrinsics,
    expanded,
    numbered,
    read_text_lines,
    rigid,
)
from vg2gt.io.cameras_json import invert_pose
from vg2gt.io.image_files import Size, read_depth
from vg2gt.io.images import open_image

EVALUATION_SCANS = (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)
"""The fifteen scans used to evaluate surface reconstruction."""
MILLIMETRE = 1e-3
_FULL_SIZE = (1200, 1600)  # height and width of the recorded images
_MASK_THRESHOLD = 10  # pixels have depth only where depth_visual is brighter than this
_QUARTER = 4


class DTUTraining(FileSource):
    """MVSNet's training set: a scene is a scan of 49 or 64 frames of 640x512, with seven lightings.

    Images are ``Rectified/scanN_train/rect_{id+1:03d}_{light}_r5000.png``: the recorded 1600x1200 images, halved and
    centre-cropped. Depth is in the first folder that exists of ``Depths_raw/scanN`` (1600x1200), ``Depths/scanN_train``
    and ``Depths/scanN`` (160x128, every fourth pixel): ``depth_map_%04d.pfm`` in mm, valid where
    ``depth_visual_%04d.png`` is brighter than 10. Cameras are ``Cameras/train/%08d_cam.txt``, with intrinsics for
    160x128, or else ``Cameras/%08d_cam.txt``, with intrinsics for 1600x1200; both are converted to the image size.

    Args:
        root: folder of ``Rectified``, ``Cameras`` and ``Depths``.
        light: which of the seven lightings, 0 to 6.
        keep_evaluation_scans: whether to include the scans in ``EVALUATION_SCANS``.
        shared: see ``FileSource``; scenes are called ``scan1``, ``scan2``, ...
    """

    layout = "MVSNet's DTU training set: Rectified/scanN_train, Cameras and Depths_raw or Depths"
    index_options = ("light",)

    def __init__(
        self,
        root: str | Sequence[str] | None,
        light: int = 3,
        keep_evaluation_scans: bool = False,
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        if light not in range(7):
            raise ValueError(f"light must be 0 to 6, got {light}")
        self.light = light
        self.keep_evaluation_scans = keep_evaluation_scans
        super().__init__(root, **shared)

    def find(self, root: Path) -> Mapping[str, Path]:
        """Returns the folders ``Rectified/scanN_train``, ordered by N."""
        found = {}
        for folder in (root / "Rectified").glob("scan*_train"):
            match = re.fullmatch(r"scan(\d+)_train", folder.name)
            if match and folder.is_dir():
                found[int(match[1])] = folder
        kept = [n for n in sorted(found) if self.keep_evaluation_scans or n not in EVALUATION_SCANS]
        return {f"scan{number}": found[number] for number in kept}

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the folders of images, cameras and depth."""
        root = folder.parents[1]
        return folder, root / "Cameras", *_training_depth(root, scene)

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the images of one lighting and reads their cameras."""
        root = folder.parents[1]
        depth_folder = next((place for place in _training_depth(root, scene) if place.is_dir()), None)
        if depth_folder is None:
            looked = ", ".join(str(place.relative_to(root)) for place in _training_depth(root, scene))
            raise DataError(f"scene {scene} in {root} has no depth: none of {looked} exists")
        color = {}
        for path in sorted(folder.glob(f"rect_*_{self.light}_r5000.png")):
            match = re.fullmatch(r"rect_(\d{1,9})_\d_r5000\.png", path.name)
            if match:
                color[int(match[1]) - 1] = path
        check_found(scene, folder, {f"images rect_*_{self.light}_r5000.png": color})
        depth = numbered(depth_folder, scene, suffixes=(".pfm",))
        size = first_size(color, scene)
        reduced = (root / "Cameras" / "train").is_dir()
        poses, intrinsics = _read_cameras(root / "Cameras" / ("train" if reduced else "."), scene, color)
        intrinsics = {number: _of_images(matrix, size, reduced) for number, matrix in intrinsics.items()}
        return make_index(scene, folder, color, depth, poses, intrinsics)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes masked depth and aligns it with the image."""
        return _registered(_masked_depth(index.depth[row], index.name), size, index.depth[row], index.name)


class DTU(FileSource):
    """MVSNet's test set: scans with ``images/``, ``cams/%08d_cam.txt`` and ``pair.txt`` (not needed).

    Intrinsics must match the size of the images. The layout has no depth, but depth can come from another folder.

    Args:
        root: a scan, a folder of scans, or a list of these.
        depth: ``pfm`` reads ``depth_map_%04d.pfm`` and ``depth_visual_%04d.png`` from ``depth_root/scanN``
            (``Depths_raw`` of the training set, 1600x1200). ``scan`` renders depth from
            ``depth_root/stlNNN_total.ply`` (``Points/stl`` of DTU) and caches it in ``depth_cache``. null for none.
        depth_root: folder of the depth files.
        depth_cache: see ``ScanDepth``.
        shared: see ``FileSource``.
    """

    layout = "scans with images/ and cams/NNNNNNNN_cam.txt, there or up to two folders deeper"
    scene_marks = ("images", "cams")
    index_options = ("depth", "depth_root")

    def __init__(
        self,
        root: str | Sequence[str] | None,
        depth: str | None = None,
        depth_root: str | None = None,
        depth_cache: str | None = None,
        **shared: Unpack[HoldoutOptions],
    ) -> None:
        if depth not in (None, "pfm", "scan"):
            raise ValueError(f"depth must be pfm, scan or null (none), got {depth!r}")
        if depth is not None and depth_root is None:
            raise ValueError(f"depth={depth} needs depth_root, the folder of the {depth} files")
        self.depth = depth
        self.has_depth = depth is not None
        self.depth_root = expanded(depth_root)
        self._scan_depth = ScanDepth(expanded(depth_cache))
        super().__init__(root, **shared)

    def place(self, scene: str) -> str:
        """Returns ``scanN`` as in the training set, so that a scan cannot be used in both sets."""
        number = _scan_number(scene)
        return scene if number is None else f"scan{number}"

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the folder of the scan and the place of its depth."""
        return folder, self._depth_place(scene) if self.depth else None

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the images and reads their cameras."""
        color = numbered(folder / "images", scene)
        check_found(scene, folder / "images", {"images": color})
        size = first_size(color, scene)
        poses, intrinsics = _read_cameras(folder / "cams", scene)
        for number, matrix in intrinsics.items():
            if not (abs(matrix[0, 2] / size[1] - 0.5) < 0.25 and abs(matrix[1, 2] / size[0] - 0.5) < 0.25):
                raise DataError(
                    f"camera {number} in {folder / 'cams'} of scene {scene} has its principal point at "
                    f"({matrix[0, 2]:.6g}, {matrix[1, 2]:.6g}), but the images are {size[1]}x{size[0]}: the camera is "
                    "one of another size"
                )
        depth = None
        if self.depth is not None:
            place = self._depth_place(scene)
            if not place.exists():
                raise DataError(f"scene {scene} has no depth: {place} does not exist; set data.depth=null, or add it")
            scan = self.depth == "scan"
            depth = dict.fromkeys(color, place) if scan else numbered(place, scene, suffixes=(".pfm",))
        return make_index(scene, folder, color, depth, poses, intrinsics)

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes masked depth, or renders depth from the scan."""
        path = index.depth[row]
        if self.depth == "pfm":
            return _registered(_masked_depth(path, index.name), size, path, index.name)
        pose, matrix = index.world_to_camera[row], index.intrinsics[row]
        return self._scan_depth.read(path, index.name, pose, matrix, size, MILLIMETRE)

    def _depth_place(self, scene: str) -> Path:
        number = _scan_number(scene)
        if number is None:
            raise DataError(f"scene {scene} is not named scanN, so its depth in {self.depth_root} cannot be found")
        assert self.depth_root is not None
        return self.depth_root / (f"stl{number:03d}_total.ply" if self.depth == "scan" else f"scan{number}")


def _read_camera(path: Path, scene: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Camera-to-world pose in metres and intrinsics as stored, from an MVSNet camera file.

    It has ``extrinsic`` (4x4 world-to-camera in mm), ``intrinsic`` (3x3) and a depth range.
    """
    words = " ".join(read_text_lines(path, scene)).split()
    try:
        if words[0] != "extrinsic" or words[17] != "intrinsic":
            raise ValueError("'extrinsic' and 16 numbers, 'intrinsic' and 9 numbers are expected")
        pose = np.array([float(word) for word in words[1:17]]).reshape(4, 4)
        intrinsics = np.array([float(word) for word in words[18:27]]).reshape(3, 3)
    except (ValueError, IndexError) as error:
        raise DataError(f"{path} of scene {scene} is not a camera of MVSNet: {error}") from error
    check_intrinsics(intrinsics, f"{path} of scene {scene}")
    pose[:3, 3] *= MILLIMETRE
    if np.isfinite(pose).all():
        pose = rigid(pose[None], [0], f"{path} of scene {scene}")[0]
    return invert_pose(pose), intrinsics


def _read_cameras(
    folder: Path, scene: str, wanted: Container[int] | None = None
) -> tuple[dict[int, NDArray[np.float64]], dict[int, NDArray[np.float64]]]:
    """Camera-to-world poses and intrinsics by frame number, for the wanted frames or all."""
    files = numbered(folder, scene, "*_cam.txt", (".txt",))
    cameras = {i: _read_camera(path, scene) for i, path in files.items() if wanted is None or i in wanted}
    return {i: pose for i, (pose, _) in cameras.items()}, {i: matrix for i, (_, matrix) in cameras.items()}


def _of_images(intrinsics: NDArray[np.float64], size: Size, reduced: bool) -> NDArray[np.float64]:
    """Converts intrinsics to the images, which are the recorded 1600x1200 images, halved and centre-cropped.

    Reduced ones are for depth maps of 160x128, with the principal point ``(c / 2 - crop) / 4``, where c is that of the
    recorded image, which ignores pixel centres: in the halved image, it must be shifted by -1/4 pixel.
    """
    top, left = (0 if reduced else (full // 2 - part) // 2 for full, part in zip(_FULL_SIZE, size, strict=True))
    out = intrinsics.copy()
    out[:2] *= _QUARTER if reduced else 0.5
    out[:2, 2] -= (0.25 + left, 0.25 + top)
    return out


def _masked_depth(path: Path, scene: str) -> NDArray[np.float32]:
    """Reads depth in metres, 0 where the mask file is dark."""
    try:
        with open_image(path) as image:
            depth = np.array(image)
    except (OSError, ValueError) as error:
        raise DataError(
            f"cannot read {path} of scene {scene}: {error}; restore the file or remove the frame"
        ) from error
    if depth.dtype != np.float32 or depth.ndim != 2:
        raise DataError(f"{path} of scene {scene} is not a one-channel PFM image: it has {depth.dtype} {depth.shape}")
    mask = read_depth(path.with_name(path.stem.replace("depth_map", "depth_visual") + ".png"), scene, depth.shape)
    valid = (mask > _MASK_THRESHOLD) & np.isfinite(depth) & (depth > 0)
    return np.where(valid, depth, 0) * np.float32(MILLIMETRE)


def _registered(depth: NDArray[np.float32], size: Size, path: Path, scene: str) -> NDArray[np.float32]:
    """Aligns depth with the image: unchanged, upsampled from every fourth pixel, or halved and centre-cropped."""
    height, width = size
    if depth.shape == (height, width):
        return depth
    if depth.shape == (height // _QUARTER, width // _QUARTER):
        # Sample i was taken at pixel 4 i, so the nearest sample to pixel u is floor((u + 2) / 4).
        rows, columns = (np.minimum((np.arange(n) + 2) // _QUARTER, n // _QUARTER - 1) for n in size)
        return depth[rows[:, None], columns]
    half = depth[::2, ::2]
    top, left = (half.shape[0] - height) // 2, (half.shape[1] - width) // 2
    if top < 0 or left < 0:
        raise DataError(
            f"{path} of scene {scene} is {depth.shape[1]}x{depth.shape[0]} pixels, which is neither the size of the "
            f"{width}x{height} images, nor a quarter of it, nor that of the recorded ones"
        )
    return np.ascontiguousarray(half[top : top + height, left : left + width])


def _training_depth(root: Path, scene: str) -> tuple[Path, ...]:
    return (root / "Depths_raw" / scene, root / "Depths" / f"{scene}_train", root / "Depths" / scene)


def _scan_number(scene: str) -> int | None:
    match = re.search(r"scan_?(\d{1,4})", scene)
    return int(match[1]) if match else None
