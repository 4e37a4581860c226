"""Scene index: checked file lists, poses and intrinsics of a scene, and its cache file."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
from collections import Counter
from collections.abc import Mapping, Sequence, Sized
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.base import DataError
from vg2gt.data.sources.parsing import check_intrinsics, rigid
from vg2gt.io.arrays import load_npz
from vg2gt.io.cameras_json import invert_pose
from vg2gt.io.image_files import Size, image_size, typical_size

log = logging.getLogger(__name__)

FORMAT = 5
"""Version of the index files; increment it when their format changes."""
_SIZES = ("size", "color_size", "depth_size")


@dataclass(frozen=True)
class SceneIndex:
    """Everything about a scene except its pixels; row i of each field belongs to frame ``frame_ids[i]``.

    Attributes:
        name: the scene's name.
        folder: the scene's folder.
        frame_ids: frame numbers, increasing.
        color: colour image files.
        depth: depth files; empty if the scene has none.
        world_to_camera: ``[n, 4, 4]`` float64 rigid OpenCV poses.
        intrinsics: ``[n, 3, 3]`` float64, integer pixel centres; for frames of ``size`` or, if ``color_size`` is None,
            for each colour image at its own size.
        size: ``(height, width)`` of decoded frames.
        color_size: size of the colour files; None: sizes differ, and each is resized to cover ``size`` and cropped.
        depth_size: size of the depth files; None: each has the size of its colour image.
        extra: further arrays per frame; ``sizes [n, 2]``, ``lens``, ``upright`` and ``mask`` are common to all loaders
            (``make_index``).
    """

    name: str
    folder: Path
    frame_ids: tuple[int, ...]
    color: tuple[Path, ...]
    depth: tuple[Path, ...]
    world_to_camera: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    size: Size
    color_size: Size | None
    depth_size: Size | None
    extra: Mapping[str, NDArray] = field(default_factory=dict)

    def row(self, frame: int) -> int:
        """Returns the row of a frame."""
        place = int(np.searchsorted(self.frame_ids, frame))
        if place == len(self.frame_ids) or self.frame_ids[place] != frame:
            raise DataError(f"scene {self.name} in {self.folder} has no usable frame {frame}")
        return place

    def own_size(self, row: int) -> Size:
        """Returns ``(height, width)`` of a frame before it is resized to ``size``."""
        height, width = self.of_image("sizes", row, self.size)
        return height, width

    def lens(self, row: int) -> str:
        """Returns the lens of a frame in the format of ``undistortion.lens_text``; empty for a pinhole."""
        return self.of_image("lens", row, "")

    def of_image(self, name: str, row: int, otherwise: Any) -> Any:
        """Returns a frame's value in ``extra``, or ``otherwise`` if the scene has none of that name."""
        return self.extra[name][row].tolist() if name in self.extra else otherwise


@dataclass(frozen=True)
class PosedImage:
    """Metadata of one image with a camera.

    Attributes:
        size: ``(height, width)`` of the image, upright and undistorted.
        intrinsics: ``[3, 3]`` for an image of that size, integer pixel centres.
        lens: see ``SceneIndex.lens``.
        upright: whether it must be rotated upright according to its EXIF data.
        mask: path of the mask file, or empty.
    """

    size: Size
    intrinsics: NDArray[np.float64]
    lens: str = ""
    upright: bool = False
    mask: str = ""


def first_size(files: Mapping[int, Path], scene: str) -> Size:
    """Returns ``(height, width)`` of the first image."""
    return image_size(next(iter(files.values())), scene)


def check_found(scene: str, folder: Path, found: Mapping[str, Sized]) -> None:
    """Raises ``DataError`` if a scene has no files of some kind."""
    for kind, files in found.items():
        if not files:
            raise DataError(f"scene {scene} has no {kind} in {folder}")


def make_index(
    name: str,
    folder: Path,
    color: Mapping[int, Path],
    depth: Mapping[int, Path] | None,
    camera_to_world: Mapping[int, NDArray[np.float64]],
    intrinsics: NDArray[np.float64] | Mapping[int, NDArray[np.float64]],
    color_size: Size | None = None,
    size: Size | None = None,
    depth_size: Size | None = None,
    posed: Mapping[int, PosedImage] | None = None,
) -> SceneIndex:
    """Makes the index of a scene. Frames without a colour image, pose or depth file are dropped with a warning.

    Args:
        name: the scene's name.
        folder: the scene's folder.
        color: colour image files by frame number.
        depth: depth files by frame number; None if the scene has no depth.
        camera_to_world: 4x4 OpenCV poses by frame number; a pose that is not finite drops its frame.
        intrinsics: one ``[3, 3]`` for all frames, or one per frame number; image size as in ``SceneIndex``.
        color_size: ``(height, width)`` of the colour files; None: size of the first file.
        size: size of decoded frames; None: that of the colour files, or their median if they differ.
        depth_size: size of the depth files; None: each has the size of its colour image.
        posed: image metadata by frame number, in place of ``intrinsics`` and ``color_size``.
    """
    if posed is not None:
        intrinsics = {i: image.intrinsics for i, image in posed.items()}
        sizes = [image.size for image in posed.values()]
        size = size or typical_size(sizes)
        color_size = size if set(sizes) == {size} else None
    else:
        check_found(name, folder, {"colour images": color})
        color_size = color_size or first_size(color, name)
        size = size or color_size
    where = f"{folder} (scene {name})"
    if color_size and depth_size and abs(color_size[0] * depth_size[1] / (color_size[1] * depth_size[0]) - 1) > 0.02:
        raise DataError(
            f"colour ({color_size[1]}x{color_size[0]}) and depth ({depth_size[1]}x{depth_size[0]}) in {where} have "
            "different aspect ratios: they are not registered"
        )
    dropped: Counter[str] = Counter()
    kept = []
    for number in sorted(color):
        pose = camera_to_world.get(number)
        if pose is None:
            dropped["without a pose"] += 1
        elif not (np.abs(pose) < np.finfo(np.float32).max).all():  # poses are used in float32
            dropped["whose pose is not finite"] += 1
        elif depth is not None and number not in depth:
            dropped["without a depth file"] += 1
        else:
            kept.append(number)
    listed = set(color) | set(depth or ()) | set(camera_to_world)
    lone = len(listed) - len(color)
    if lone:
        dropped["without a colour image"] = lone
    if not kept:
        found = f"{len(color)} colour images, {len(camera_to_world)} poses"
        found += f", {len(depth)} depth files" if depth is not None else ""
        reasons = "".join(f"; {count} frames {reason}" for reason, count in dropped.items())
        raise DataError(f"no usable frame in {where}: it has {found}{reasons}")
    for reason, count in dropped.items():
        log.warning("scene %s: %d of %d frames %s are left out", name, count, len(listed), reason)
    extra: dict[str, NDArray] = {}
    if posed is not None:
        extra = {key: np.array([getattr(posed[number], key) for number in kept]) for key in ("lens", "upright", "mask")}
        extra = {key: values for key, values in extra.items() if any(values.tolist())}
        extra["sizes"] = np.array([posed[number].size for number in kept], np.int64)
    poses = rigid(np.stack([camera_to_world[number] for number in kept]).astype(np.float64), kept, where)
    if isinstance(intrinsics, Mapping):
        matrices = np.stack([intrinsics[number] for number in kept]).astype(np.float64)
    else:
        matrices = np.broadcast_to(np.asarray(intrinsics, np.float64), (len(kept), 3, 3)).copy()
    return SceneIndex(
        name=name,
        folder=folder,
        frame_ids=tuple(kept),
        color=tuple(color[number] for number in kept),
        depth=tuple(depth[number] for number in kept) if depth is not None else (),
        world_to_camera=invert_pose(poses),
        intrinsics=check_intrinsics(matrices, where),
        size=size,
        color_size=color_size,
        depth_size=depth_size or color_size,
        extra=extra,
    )


def folder_state(folder: Path) -> str:
    """Returns a fingerprint of a file or folder.

    That of a folder changes when files are added or removed, or when a file directly in it is edited.
    """
    entries = sorted(folder.iterdir()) if folder.is_dir() else [folder]
    entries += [path for top in entries if top.is_dir() for path in _folders_in(top)]
    states = [(path, path.stat()) for path in entries]
    text = json.dumps([[str(path), state.st_mtime_ns, state.st_size] for path, state in states])
    return hashlib.sha256(text.encode()).hexdigest()


def _folders_in(folder: Path) -> list[Path]:
    """Lists the direct subfolders of a folder without a ``stat`` of every file."""
    with os.scandir(folder) as entries:
        return sorted(Path(entry.path) for entry in entries if entry.is_dir())


def index_to_bytes(index: SceneIndex) -> bytes:
    """Serialises an index as an ``.npz`` file."""
    facts = {"extra": list(index.extra)} | {name: getattr(index, name) for name in _SIZES}
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        facts=np.array(json.dumps(facts)),
        frame_ids=np.array(index.frame_ids, np.int64),
        color=_names(index.color, index.folder),
        depth=_names(index.depth, index.folder),
        world_to_camera=index.world_to_camera,
        intrinsics=index.intrinsics,
        **{f"extra_{name}": array for name, array in index.extra.items()},  # pyright: ignore[reportArgumentType]
    )
    return buffer.getvalue()


def read_index(path: Path, scene: str, folder: Path) -> SceneIndex | None:
    """Reads a cached index; None if it is missing or, with a warning, damaged."""
    if not path.is_file():
        return None
    try:
        facts = json.loads(str(load_npz(path, scene, ["facts"])["facts"]))
        extra = [f"extra_{name}" for name in facts["extra"]]
        arrays = load_npz(path, scene, ["frame_ids", "color", "depth", "world_to_camera", "intrinsics", *extra])
    except (DataError, ValueError) as error:
        log.warning("the cached index is damaged and will be rebuilt: %s", error)
        return None
    return SceneIndex(
        name=scene,
        folder=folder,
        frame_ids=tuple(arrays["frame_ids"].tolist()),
        color=tuple(folder / name for name in arrays["color"].tolist()),
        depth=tuple(folder / name for name in arrays["depth"].tolist()),
        world_to_camera=arrays["world_to_camera"],
        intrinsics=arrays["intrinsics"],
        extra={name: arrays[f"extra_{name}"] for name in facts["extra"]},
        **{name: facts[name] and tuple(facts[name]) for name in _SIZES},
    )


def _names(paths: Sequence[Path], folder: Path) -> NDArray[np.str_]:
    """Returns file names relative to the scene's folder, or absolute for files outside it."""
    inside = (path.relative_to(folder) if path.is_relative_to(folder) else path.resolve() for path in paths)
    return np.array([str(path) for path in inside], np.str_)
