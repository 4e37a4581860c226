"""Base class of the loaders of datasets on disk: finds scenes, indexes them, decodes frames and caches indices."""

from __future__ import annotations

import hashlib
import json
import logging
from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.data.base import DataError, Frames, SceneSource
from vg2gt.data.sources.index import FORMAT, SceneIndex, folder_state, index_to_bytes, read_index
from vg2gt.data.sources.masks import joined_masks, resized_mask
from vg2gt.data.sources.parsing import expanded
from vg2gt.data.sources.undistortion import undistortion_of
from vg2gt.data.transforms import from_bytes, resize_depth, resize_images, resize_to_cover
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io.errors import some
from vg2gt.io.files import write_cached
from vg2gt.io.image_files import Size, check_size, is_damaged, read_color, read_depth, read_mask, read_mask_file

log = logging.getLogger(__name__)

_INDICES_IN_MEMORY = 64


class FileOptions(TypedDict, total=False):
    """Arguments of every ``FileSource``, passed on as ``**shared`` by loaders with arguments of their own."""

    scenes: Sequence[str] | str | None
    every: int
    index_cache: str | None


class HoldoutOptions(FileOptions, total=False):
    """``FileOptions`` with ``holdout``, for loaders that hold nothing out by default."""

    holdout: int | None


class FileSource(SceneSource):
    """Base class of datasets on disk.

    A loader implements ``index`` and, if the defaults do not fit, ``find`` and ``read_depth``. All methods raise
    ``DataError`` if a file is missing or damaged; the message names the file and the scene. All loaders share the
    arguments and errors below.

    Args:
        root: the dataset's folder, or several.
        scenes: names of the scenes to use, or a text file with one per line; names in a file that do not exist are
            skipped with a warning. None: all.
        holdout: hold out every ``holdout``-th frame as an evaluation target; None: none.
        every: use only every ``every``-th frame.
        index_cache: folder that caches the indices (file lists, poses, intrinsics); None: every process reads them from
            the dataset. An index is rebuilt when the scene's folder changes, but an in-place edit of a pose file inside
            a folder of pose files is not detected.

    Raises:
        FileNotFoundError: if a root does not exist.
        DataError: if there is no scene, or a named scene does not exist.
    """

    layout: ClassVar[str]
    """Expected layout of ``root``, for error messages."""
    scene_marks: ClassVar[tuple[str, ...]] = ()
    """Files and folders that a folder must contain to count as a scene."""
    scene_files: ClassVar[tuple[str, ...]] = ()
    """Suffixes of single files that count as scenes."""
    names_are_paths: ClassVar[bool] = False
    """Whether a scene is named by its path relative to ``root`` instead of its folder name."""
    index_version: ClassVar[int] = 2
    """Increment it when ``index`` changes its result for the same files; invalidates cached indices."""
    index_options: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that affect an index; part of its cache key, like the folder."""
    sparse_depth: ClassVar[bool] = False
    """Whether depth is known at single pixels only; see :class:`~vg2gt.data.base.Frames`."""
    reads_masks: ClassVar[bool] = False
    """Whether alpha and mask files weight the pixels; if not, alpha is only composited over white."""
    recorded: ClassVar[bool] = False
    """Whether a device measured the poses together with depth, so that they fit it better than other cameras."""
    leave_out_damaged: bool = False
    """Whether images that cannot be opened are left out, with a warning; otherwise they are errors."""
    depth_scale: float = 1000.0
    """Stored depth units per unit of the poses."""
    invalid: tuple[int, ...] = ()
    """Stored depth values that are invalid, in addition to 0."""

    def __init__(
        self,
        root: str | Sequence[str] | None,
        scenes: Sequence[str] | str | None = None,
        holdout: int | None = None,
        every: int = 1,
        index_cache: str | None = None,
    ) -> None:
        if holdout is not None and holdout < 2:
            raise ValueError(f"holdout must be at least 2 (or null for none), got {holdout}")
        if every < 1:
            raise ValueError(f"every must be at least 1 (use every this many-th frame), got {every}")
        self.holdout = holdout
        self.every = every
        self.index_cache = expanded(index_cache)
        self._folders = self._select(self._find_all(_roots(root, self.layout, self.scene_files)), scenes)
        self._indices: dict[str, SceneIndex] = {}
        self._frame_ids: dict[str, NDArray[np.int64]] = {}

    def is_scene(self, folder: Path) -> bool:
        """Returns whether a folder is a scene; by default, whether it contains all ``scene_marks``."""
        return all((folder / mark).exists() for mark in self.scene_marks)

    def find(self, root: Path) -> Mapping[str, Path]:
        """Finds scenes by name, with their folder or file: ``root`` itself, or folders up to two levels below it."""
        if self.is_scene(root):
            return {root.resolve().name: root}
        found: dict[str, Path] = {}
        scenes: set[Path] = set()
        for folder in (*sorted(root.glob("*")), *sorted(root.glob("*/*"))):
            if folder.parent in scenes:
                continue  # a part of that scene, such as COLMAP's dense/
            if (folder.is_dir() or folder.suffix.lower() in self.scene_files) and self.is_scene(folder):
                scenes.add(folder)
                name = folder.relative_to(root).as_posix() if self.names_are_paths else folder.name
                _add_scene(found, name, folder)
        return found

    @abstractmethod
    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Reads the file lists, poses and intrinsics of a scene."""

    def sound(self, color: Mapping[int, Path]) -> dict[int, Path]:
        """Returns the images, by frame number, without those that cannot be opened if these may be left out."""
        damaged = [i for i, path in color.items() if is_damaged(path)] if self.leave_out_damaged else []
        if not damaged or len(damaged) == len(color):  # whoever reads them says what is wrong
            return dict(color)
        names = some([str(color[i]) for i in damaged])
        log.warning("%d of %d images cannot be read and are left out: %s", len(damaged), len(color), names)
        return {i: path for i, path in color.items() if i not in damaged}

    def read_color(self, index: SceneIndex, row: int, least: Size | None = None) -> NDArray[np.uint8]:
        """Decodes the colour image ``[h, w, 3]`` of a row of the index, undistorted.

        Args:
            index: the scene.
            row: row of the frame in the index.
            least: ``(height, width)`` that suffices (``image_files.read_color``); None: full size.
        """
        lens, upright = index.lens(row), index.of_image("upright", row, False)
        if not lens:
            return read_color(index.color[row], index.name, index.color_size, upright=upright, least=least)
        size = undistortion_of(lens).lens_size
        pixels = read_color(index.color[row], index.name, size, upright=upright, least=least)
        return undistortion_of(lens, (pixels.shape[0], pixels.shape[1])).color(pixels)

    def read_mask(self, index: SceneIndex, row: int) -> NDArray[np.float32] | None:
        """Reads the pixel weights ``[h, w]`` in [0, 1] of a colour image from its mask file and alpha; None: all 1."""
        if not self.reads_masks:
            return None
        color, upright = index.color[row], index.of_image("upright", row, False)
        parts = [read_mask(color, index.name, upright=upright)]
        if path := index.of_image("mask", row, ""):
            parts.append(read_mask_file(Path(path), index.name, color, upright))
        mask = joined_masks(parts)
        if mask is None or not (lens := index.lens(row)):
            return mask
        undistortion = undistortion_of(lens)
        return undistortion.depth(resized_mask(mask, undistortion.lens_size))

    def read_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        """Decodes the depth ``[h, w]`` of a row of the index: z-depth in the dataset's unit, 0 = invalid.

        By default reads an integer image and applies ``depth_scale`` and ``invalid``.

        Args:
            index: the scene.
            row: row of the frame in the index.
            size: expected ``(height, width)``.
        """
        undistortion = undistortion_of(index.lens(row)) if index.lens(row) else None
        stored = read_depth(index.depth[row], index.name, undistortion.lens_size if undistortion else size)
        depth = stored / self.depth_scale
        depth = np.where(np.isin(stored, self.invalid), 0, depth).astype(np.float32)
        return undistortion.depth(depth) if undistortion else depth

    def watched(self, scene: str, folder: Path) -> Sequence[Path | None]:
        """Returns the folders and files that a scene's index depends on; by default the scene's folder.

        The cached index is rebuilt when one of them changes. They need not exist.
        """
        return (folder,)

    @property
    def scenes(self) -> Sequence[str]:
        """Names of the scenes."""
        return tuple(self._folders)

    def frames(self, scene: str) -> Sequence[int]:
        """Returns the numbers of the usable frames, in increasing order."""
        if scene not in self._frame_ids:
            self._frame_ids[scene] = np.array(self.scene_index(scene).frame_ids[:: self.every])
        return tuple(self._frame_ids[scene].tolist())

    def held_out(self, scene: str) -> Sequence[int]:
        """Returns every ``holdout``-th frame, starting at frame ``holdout // 2``."""
        return self.frames(scene)[self.holdout // 2 :: self.holdout] if self.holdout else ()

    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Decodes frames at the scene's size; resizes images of other sizes to it."""
        index = self.scene_index(scene)
        return Frames.concatenate([self._load_frame(index, index.row(frame)) for frame in frame_ids])

    def load_whole(self, scene: str, frame: int, least: Size | None = None) -> Frames:
        """Decodes one frame without cropping.

        Args:
            scene: its scene.
            frame: its number.
            least: ``(height, width)`` that suffices; large images without depth may be reduced to that. None: the
                frame's own size (``SceneIndex.own_size``).
        """
        index = self.scene_index(scene)
        return self._load_frame(index, index.row(frame), True, None if index.depth else least)

    def scene_index(self, scene: str) -> SceneIndex:
        """Returns the index of a scene, from memory, the cache, or the dataset."""
        if scene not in self._folders:
            raise DataError(f"no such scene: {scene}; available: {some(self._folders)}")
        if scene not in self._indices:
            # Indices of a thousand long videos would take gigabytes; forgotten ones are quickly read from the cache.
            if self.index_cache is not None and len(self._indices) >= _INDICES_IN_MEMORY:
                self._indices.clear()
            self._indices[scene] = self._recall_index(scene, self._folders[scene])
        return self._indices[scene]

    def _load_frame(self, index: SceneIndex, row: int, whole: bool = False, least: Size | None = None) -> Frames:
        pixels = self.read_color(index, row) if least is None else self.read_color(index, row, least)
        if index.color_size is None and least is None:
            check_size(index.color[row], index.name, pixels.shape[:2], index.own_size(row))
        images = from_bytes(torch.from_numpy(pixels)).permute(2, 0, 1)[None].contiguous()  # [1, 3, H, W]
        depth = torch.zeros_like(images[:, 0])  # [1, H, W]
        if index.depth:
            depth = torch.from_numpy(self._valid_depth(index, row, index.depth_size or pixels.shape[:2]))[None]
        poses = torch.from_numpy(index.world_to_camera[row : row + 1]).float()
        intrinsics = torch.from_numpy(index.intrinsics[row : row + 1])
        if least is not None:
            own = index.own_size(row)
            intrinsics = resize_intrinsics(intrinsics, pixels.shape[1] / own[1], pixels.shape[0] / own[0])
        intrinsics = intrinsics.float()
        stored = self.read_mask(index, row)
        mask = None if stored is None else torch.from_numpy(resized_mask(stored, pixels.shape[:2]))[None]
        if index.color_size is None or least is not None:
            frames = Frames(images, depth, poses, intrinsics, self.sparse_depth, mask)
            return frames if whole else resize_to_cover(frames, index.size)
        depth = resize_depth(depth, index.size, self.sparse_depth)
        mask = None if mask is None else resize_images(mask[:, None], index.size)[:, 0]
        return Frames(resize_images(images, index.size), depth, poses, intrinsics, self.sparse_depth, mask)

    def _valid_depth(self, index: SceneIndex, row: int, size: Size) -> NDArray[np.float32]:
        depth = self.read_depth(index, row, size)
        if not (depth > 0).any():
            raise DataError(
                f"{index.depth[row]} of scene {index.name} has no valid depth in any pixel; remove the frame, or "
                "correct the depth unit, the values that mean 'invalid', or the range (data.max_depth)"
            )
        return depth

    def _find_all(self, roots: Sequence[Path]) -> dict[str, Path]:
        found: dict[str, Path] = {}
        for root in roots:
            inside = self.find(root)
            if not inside:
                names = sorted(path.name for path in root.iterdir())
                raise DataError(f"no scene in {root}: expected {self.layout}; found: {some(names, 5) or 'nothing'}")
            for name, folder in inside.items():
                _add_scene(found, name, folder)
        return found

    def _select(self, found: dict[str, Path], scenes: Sequence[str] | str | None) -> dict[str, Path]:
        if scenes is None:
            return found
        names = read_split(scenes) if isinstance(scenes, str) else list(scenes)
        unknown = [name for name in names if name not in found]
        # A list file covers the whole dataset, but often only a part of it is on disk.
        if unknown and (not isinstance(scenes, str) or len(unknown) == len(names)):
            raise DataError(f"no such scene: {some(unknown)}; available: {some(found)}")
        if unknown:
            log.warning("skipped %d of the %d scenes listed in %s: not found", len(unknown), len(names), scenes)
        return {name: found[name] for name in names if name in found}

    def _recall_index(self, scene: str, folder: Path) -> SceneIndex:
        if self.index_cache is None:
            return self.index(scene, folder)
        options = {name: getattr(self, name) for name in self.index_options}
        state = [folder_state(place) for place in self.watched(scene, folder) if place and place.exists()]
        version = (type(self).__qualname__, FORMAT, self.index_version)
        key = json.dumps([version, str(folder.resolve()), scene, options, state], default=str)
        path = self.index_cache / "index" / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npz"
        index = read_index(path, scene, folder)
        if index is None:
            if not self._frame_ids:
                message = "reading file lists, poses and intrinsics of up to %d scenes; they are cached in %s"
                log.info(message, len(self._folders), self.index_cache)
            index = self.index(scene, folder)
            write_cached(path, index_to_bytes(index), self.index_cache)
        return index


def read_split(path: str) -> list[str]:
    """Reads scene names from a text file, one per line; ``#`` starts a comment.

    Raises:
        FileNotFoundError: if the file does not exist.
        DataError: if it names no scene, or a scene twice.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise FileNotFoundError(
            f"the scene list {file} does not exist; give a list of names or a text file of them, or use all scenes of "
            "data.root: data.train.scenes=null data.val.scenes=null"
        )
    names = [line.split("#")[0].strip() for line in file.read_text().splitlines()]
    names = [name for name in names if name]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if not names or twice:
        raise DataError(f"the scene list {file} " + (f"names {twice[0]} twice" if twice else "names no scene"))
    return names


def _roots(root: str | Sequence[str] | None, layout: str, files: tuple[str, ...]) -> list[Path]:
    if not root:
        raise FileNotFoundError(f"data.root is not set: give data.root=FOLDER, which holds {layout}")
    roots = [Path(path).expanduser() for path in ([root] if isinstance(root, str) else root)]
    for path in roots:
        if not (path.is_dir() or (path.is_file() and path.suffix.lower() in files)):
            raise FileNotFoundError(
                f"the data folder {path} (working directory: {Path.cwd()}) does not exist: set data.root=FOLDER to one "
                f"that contains {layout}"
            )
    return roots


def _add_scene(found: dict[str, Path], name: str, folder: Path) -> None:
    if name in found:
        raise DataError(
            f"two scenes are called {name}: {found[name]} and {folder}; rename one, or give data.root one of them or "
            "their common parent folder"
        )
    found[name] = folder
