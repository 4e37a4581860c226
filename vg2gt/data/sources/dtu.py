"""DTU in the two layouts of MVSNet: reduced images with depth for training, scans with full images for evaluation.

Files are in millimetres; everything read is in metres.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, folder_state, make_index
from vg2gt.data.sources.parsing import check_intrinsics, inverse, numbered, read_text_lines, rigid
from vg2gt.data.sources.scan_depth import VERSION, ScanDepth
from vg2gt.data.sources.scene_folders import scene_folders
from vg2gt.io.image_files import Size, image_size, read_depth
from vg2gt.io.pfm import read_pfm

EVALUATION_SCANS = (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)
"""The fifteen scans on which surface reconstruction is compared."""
SPARSE_VIEWS = (23, 24, 33)
"""Frame ids of the protocol with three input views, in the numbering of the files (from 0)."""
MILLIMETRE = 1e-3
FULL_SIZE = (1200, 1600)
"""Height and width of the recorded images."""
MASK_THRESHOLD = 10
"""Pixels whose ``depth_visual`` is not brighter have no depth."""

_QUARTER = 4


class DTUTraining(FileSource):
    """MVSNet's training set: a scene is a scan, lit in seven ways, of 49 or 64 frames of 640x512.

    Images are ``Rectified/scanN_train/rect_{id+1:03d}_{light}_r5000.png``: the recorded 1600x1200 halved and cropped to
    the middle. Depth is the first of ``Depths_raw/scanN`` (1600x1200), ``Depths/scanN_train`` and ``Depths/scanN``
    (160x128, every fourth pixel) with ``depth_map_%04d.pfm`` in mm and ``depth_visual_%04d.png``, brighter than 10
    where depth counts. Cameras are ``Cameras/train/%08d_cam.txt``, with the intrinsics of 160x128, or else
    ``Cameras/%08d_cam.txt``, with those of 1600x1200; both are brought to the images.

    Args:
        root: the folder of ``Rectified``, ``Cameras`` and ``Depths``.
        light: which of the seven lights, 0 to 6.
        keep_evaluation_scans: also offer the scans of ``EVALUATION_SCANS``, which are left out otherwise.
        scenes: names such as ``scan1``, or a text file of them; None: all.
        holdout: hold out every this many-th frame as an evaluation target; None: none.
        every: use every this many-th frame only.
        index_cache: see ``FileSource``.

    Raises:
        FileNotFoundError: if a root does not exist.
        DataError: if there is no scan.
    """

    layout = "MVSNet's DTU training set: Rectified/scanN_train, Cameras and Depths_raw or Depths"

    def __init__(
        self,
        root: str | Sequence[str] | None,
        light: int = 3,
        keep_evaluation_scans: bool = False,
        scenes: Sequence[str] | str | None = None,
        holdout: int | None = None,
        every: int = 1,
        index_cache: str | None = None,
    ) -> None:
        if light not in range(7):
            raise ValueError(f"light must be 0 to 6, got {light}")
        self.light = light
        self.keep_evaluation_scans = keep_evaluation_scans
        super().__init__(root, scenes, holdout, every, index_cache)

    def find(self, root: Path) -> Mapping[str, Path]:
        """Folders ``Rectified/scanN_train`` in the order of N."""
        found = {}
        for folder in (root / "Rectified").glob("scan*_train"):
            match = re.fullmatch(r"scan(\d+)_train", folder.name)
            if match and folder.is_dir():
                found[int(match[1])] = folder
        kept = [n for n in sorted(found) if self.keep_evaluation_scans or n not in EVALUATION_SCANS]
        return {f"scan{number}": found[number] for number in kept}

    def options(self) -> Mapping[str, object]:
        """The light."""
        return {"light": self.light}

    def state(self, scene: str, folder: Path) -> str:
        """Also that of the depth and the cameras."""
        root = folder.parents[1]
        places = (folder, root / "Cameras", *_training_depth(root, scene))
        return " ".join(folder_state(place) for place in places if place.exists())

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the images of one light and reads their cameras."""
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
        if not color:
            raise DataError(f"scene {scene} has no images rect_*_{self.light}_r5000.png in {folder}")
        size = image_size(next(iter(color.values())), scene)
        reduced = (root / "Cameras" / "train").is_dir()
        files = numbered(root / "Cameras" / ("train" if reduced else "."), scene, "*_cam.txt", (".txt",))
        cameras = {number: read_camera(path, scene) for number, path in files.items() if number in color}
        bring = _from_quarter if reduced else _from_full
        return make_index(
            name=scene,
            folder=folder,
            color=color,
            depth=numbered(depth_folder, scene, suffixes=(".pfm",)),
            camera_to_world={number: pose for number, (pose, _) in cameras.items()},
            intrinsics={number: bring(matrix, size) for number, (_, matrix) in cameras.items()},
            size=size,
            color_size=size,
        )

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes masked depth and registers it with the image."""
        return _registered(_masked_depth(index.depth[row], index.name), size, index.depth[row], index.name)


class DTU(FileSource):
    """Scans with ``images/``, ``cams/%08d_cam.txt`` and ``pair.txt`` (not needed), as MVSNet is tested on.

    The intrinsics are those of the images as they are. The layout has no depth; it can come from beside it.

    Args:
        root: a scan, a folder of scans, or a list.
        depth: ``pfm``: ``depth_map_%04d.pfm`` with ``depth_visual_%04d.png`` in ``depth_root/scanN`` (``Depths_raw`` of
            the training set, 1600x1200); ``scan``: rendered from ``depth_root/stlNNN_total.ply`` (``Points/stl`` of
            DTU) and kept in ``depth_cache``; null: none.
        depth_root: the folder of that depth.
        depth_cache: see ``ScanDepth``.
        scenes: names of scans, or a text file of them; None: all.
        holdout: hold out every this many-th frame as an evaluation target; None: none.
        every: use every this many-th frame only.
        index_cache: see ``FileSource``.

    Raises:
        FileNotFoundError: if a root does not exist.
        DataError: if there is no scan.
    """

    layout = "scans with images/ and cams/NNNNNNNN_cam.txt, there or one folder deeper"

    def __init__(
        self,
        root: str | Sequence[str] | None,
        depth: str | None = None,
        depth_root: str | None = None,
        depth_cache: str | None = None,
        scenes: Sequence[str] | str | None = None,
        holdout: int | None = None,
        every: int = 1,
        index_cache: str | None = None,
    ) -> None:
        if depth not in (None, "pfm", "scan"):
            raise ValueError(f"depth must be pfm, scan or null (none), got {depth!r}")
        if depth is not None and depth_root is None:
            raise ValueError(f"depth={depth} needs depth_root, the folder of the {depth} files")
        self.depth = depth
        self.has_depth = depth is not None
        self.depth_root = Path(depth_root).expanduser() if depth_root else None
        if self.depth_root is not None and not self.depth_root.is_dir():
            raise FileNotFoundError(f"the depth folder {self.depth_root} (seen from {Path.cwd()}) does not exist")
        self._scan_depth = ScanDepth(Path(depth_cache).expanduser() if depth_cache else None)
        super().__init__(root, scenes, holdout, every, index_cache)

    def find(self, root: Path) -> Mapping[str, Path]:
        """The folder itself, or scans one level below it."""
        return scene_folders(root, lambda folder: (folder / "images").is_dir() and (folder / "cams").is_dir(), levels=1)

    def place(self, scene: str) -> str:
        """``scanN``, as in the training set, so that a scan cannot serve both."""
        number = _scan_number(scene)
        return scene if number is None else f"scan{number}"

    def options(self) -> Mapping[str, object]:
        """Where depth comes from."""
        return {"depth": self.depth, "depth_root": str(self.depth_root)}

    def state(self, scene: str, folder: Path) -> str:
        """Also that of the depth."""
        places = [folder, *([self._depth_place(scene)] if self.depth else [])]
        return " ".join([f"scan depth {VERSION}", *(folder_state(place) for place in places if place.exists())])

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the images and reads their cameras."""
        color = numbered(folder / "images", scene)
        if not color:
            raise DataError(f"scene {scene} has no images in {folder / 'images'}")
        size = image_size(next(iter(color.values())), scene)
        files = numbered(folder / "cams", scene, "*_cam.txt", (".txt",))
        cameras = {number: read_camera(path, scene) for number, path in files.items()}
        for number, (_, matrix) in cameras.items():
            if not (abs(matrix[0, 2] / size[1] - 0.5) < 0.25 and abs(matrix[1, 2] / size[0] - 0.5) < 0.25):
                raise DataError(
                    f"{files[number]} of scene {scene} has its principal point at ({matrix[0, 2]:.6g}, "
                    f"{matrix[1, 2]:.6g}), but the images are {size[1]}x{size[0]}: the camera is one of another size"
                )
        depth = None
        if self.depth is not None:
            place = self._depth_place(scene)
            if not place.exists():
                raise DataError(f"scene {scene} has no depth: {place} does not exist; set data.depth=null, or add it")
            scan = self.depth == "scan"
            depth = dict.fromkeys(color, place) if scan else numbered(place, scene, suffixes=(".pfm",))
        return make_index(
            name=scene,
            folder=folder,
            color=color,
            depth=depth,
            camera_to_world={number: pose for number, (pose, _) in cameras.items()},
            intrinsics={number: matrix for number, (_, matrix) in cameras.items()},
            size=size,
            color_size=size,
        )

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes masked depth, or renders the scan."""
        path = index.depth[row]
        if self.depth == "pfm":
            return _registered(_masked_depth(path, index.name), size, path, index.name)
        pose, matrix = index.world_to_camera[row], index.intrinsics[row]
        return self._scan_depth.read(path, index.name, pose, matrix, size, MILLIMETRE)

    def _depth_place(self, scene: str) -> Path:
        number = _scan_number(scene)
        if number is None:
            raise DataError(f"scene {scene} is not called scanN, so that its depth in {self.depth_root} is not known")
        assert self.depth_root is not None
        return self.depth_root / (f"stl{number:03d}_total.ply" if self.depth == "scan" else f"scan{number}")


def read_camera(path: Path, scene: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reads a camera of MVSNet: ``extrinsic``, 4x4 world-to-camera in mm, ``intrinsic``, 3x3, and a depth range.

    Returns:
        Camera-to-world ``[4, 4]`` in metres, and intrinsics ``[3, 3]`` as they stand in the file, which are of the
        image size that the file was made for.

    Raises:
        DataError: if the file is missing or damaged, or its transform not rigid.
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
    if not (np.abs(pose) < 1e30).all():
        return np.full((4, 4), np.nan), intrinsics
    pose[:3, 3] *= MILLIMETRE
    return inverse(rigid(pose[None], [0], f"{path} of scene {scene}"))[0], intrinsics


def _from_quarter(intrinsics: NDArray[np.float64], size: Size) -> NDArray[np.float64]:
    """Intrinsics of MVSNet's 160x128 depth maps, brought to its 640x512 images.

    The file's principal point is ``(c / 2 - crop) / 4`` of the recorded image's c, without regard to where pixels have
    their centres; the centre of a halved image's pixel lies 1/4 of its width away from c / 2.
    """
    return _scaled(intrinsics, _QUARTER, (-0.25, -0.25))


def _from_full(intrinsics: NDArray[np.float64], size: Size) -> NDArray[np.float64]:
    """Intrinsics of the recorded 1600x1200, brought to the images: halved, and cropped to the middle."""
    top, left = ((full // 2 - part) // 2 for full, part in zip(FULL_SIZE, size, strict=True))
    return _scaled(intrinsics, 0.5, (-0.25 - left, -0.25 - top))


def _scaled(intrinsics: NDArray[np.float64], scale: float, shift: tuple[float, float]) -> NDArray[np.float64]:
    out = intrinsics.copy()
    out[:2] *= scale
    out[:2, 2] += shift
    return out


def _masked_depth(path: Path, scene: str) -> NDArray[np.float32]:
    """Depth in metres, 0 where the mask beside it says that there is none."""
    depth = read_pfm(path, scene)
    mask = read_depth(path.with_name(path.stem.replace("depth_map", "depth_visual") + ".png"), scene, depth.shape)
    valid = (mask > MASK_THRESHOLD) & np.isfinite(depth) & (depth > 0)
    return np.where(valid, depth, 0) * np.float32(MILLIMETRE)


def _registered(depth: NDArray[np.float32], size: Size, path: Path, scene: str) -> NDArray[np.float32]:
    """Depth at the image's pixels: as it is, from every fourth pixel, or halved and cropped to the middle."""
    height, width = size
    if depth.shape == (height, width):
        return depth
    if depth.shape == (height // _QUARTER, width // _QUARTER):
        # Sample i was taken at pixel 4 i: the nearest sample of pixel u is floor((u + 2) / 4).
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
