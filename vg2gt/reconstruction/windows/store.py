"""The views of a long capture, the files of its reconstruction in windows, and the voxels of its sets of images.

Each command adds or removes one set of images through the voxels that it pooled.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.format import open_memmap
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from vg2gt.data.sources.masks import mask_beside
from vg2gt.inputs.inputs import depth_range, given_poses, load_views, map_shift, source_of
from vg2gt.inputs.pictures import Picture
from vg2gt.io.errors import FormatError
from vg2gt.io.files import replacing, write_json
from vg2gt.io.tensors import read_tensors
from vg2gt.method.pooled import PooledVoxels, concatenate, merge
from vg2gt.model import Reconstructor
from vg2gt.monitor import Monitor
from vg2gt.types import Cameras, Hints

FORMAT = 3
"""Version of the folder's format; increment it when the format changes."""
_SET = "set.json"  # marks the folder of a set
ROWS = 400_000  # voxels merged at a time
AUTOMATIC = 100  # number of views above which a capture is processed in windows
SIZE = 24  # own views per window
MARGIN = 6  # minimum number of neighbours before and after them; a sixth of large windows
AT_ONCE = 16  # pictures decoded per finished step
_PLAIN = (bool, int, float, str, tuple, type(None))


class WindowStore:
    """The folder of one image set; its content survives an interruption.

    Args:
        folder: parent folder of all sets; the folder of this set is created in it if missing.
        key: hash of the images, model and sizes of the set.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder / key[:12]
        if not (self.folder / _SET).is_file():
            write_json(self.folder / _SET, {})

    def array(self, name: str, shape: Sequence[int] | None = None, fill: float = 0) -> Tensor:
        """Returns a memory-mapped float32 array of the folder; writing to the tensor writes to the file.

        Args:
            name: file name without extension.
            shape: shape to create the array with if it does not exist.
            fill: initial value of a new array.
        """
        path = self.folder / f"{name}.npy"
        if shape is not None and not path.is_file():
            with replacing(path) as temporary:
                made = open_memmap(temporary, "w+", np.float32, tuple(shape))
                if fill:
                    made[:] = fill
                del made
        return torch.from_numpy(open_memmap(path, "r+"))

    def has(self, name: str) -> bool:
        """Returns whether an array or a finished step of this name exists."""
        return any((self.folder / f"{name}.{suffix}").is_file() for suffix in ("npy", "safetensors"))

    def files(self, prefix: str) -> list[Path]:
        """Returns the files of all finished steps whose names begin with ``prefix``, in order."""
        return sorted(self.folder.glob(f"{prefix}-*.safetensors"))

    def save(self, name: str, tensors: Mapping[str, Tensor]) -> None:
        """Writes the result of a step, completely or not at all."""
        with replacing(self.folder / f"{name}.safetensors") as temporary:
            save_file({key: value.detach().cpu().contiguous() for key, value in tensors.items()}, temporary)

    def load(self, name: str) -> dict[str, Tensor] | None:
        """Reads the result of a step; None if it is not finished."""
        try:
            return read_tensors(self.folder / f"{name}.safetensors")
        except (FileNotFoundError, FormatError):
            return None


def set_key(model: Reconstructor, pictures: Sequence[Picture], size: tuple[int, int], window: int) -> str:
    """Returns a hash of the model's weights and options, the pictures, and the working and window size."""
    facts = [FORMAT, model.backend.identity(), [_facts(each) for each in pictures], size, window]
    digest = hashlib.sha256(json.dumps(facts).encode())
    for name, module in model.named_modules():
        options = {key: value for key, value in vars(module).items() if isinstance(value, _PLAIN) and key[0] != "_"}
        options.pop("training", None)
        digest.update(f"{name} {sorted(options.items())}".encode())
    digest.update(f"{model.visibility} {vars(model.scale)}".encode())
    for name, tensor in sorted(model.trained_state().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _facts(picture: Picture) -> list[Any]:
    """Returns what identifies a picture's content and camera, as JSON values."""
    path = picture.path
    files = [path, None if path is None else mask_beside(path), picture.container]
    states = [file.stat() for file in files if file is not None]
    matrices = [None if each is None else each.tolist() for each in (picture.pose, picture.intrinsics)]
    stamps = [[state.st_size, state.st_mtime_ns] for state in states]
    return [picture.name, picture.size, picture.source, picture.lens, matrices, stamps]


def merge_windows(files: Sequence[Path], monitor: Monitor, limit: int = ROWS) -> PooledVoxels:
    """Merges the voxels of all windows of a scene.

    The voxels of each window are sorted by x, so that a slab of space is a range of rows in each file.

    Args:
        files: voxel files of the windows, in the order of summation.
        monitor: shows the progress.
        limit: approximate number of voxels merged at a time.

    Raises:
        ValueError: if there are no voxels.
    """
    columns = [_read_rows(file, slice(None))["grid"][:, 0].contiguous() for file in files]
    slabs = _slabs(columns, limit)
    merged = []
    with monitor.stage("merge voxels", len(slabs)) as advance:
        for slab in slabs:
            parts = []
            for file, column in zip(files, columns, strict=True):
                begin, end = torch.searchsorted(column, torch.tensor(slab)).tolist()
                if end > begin:
                    found = _read_rows(file, slice(begin, end))
                    parts.append(PooledVoxels(**{each.name: found.get(each.name) for each in fields(PooledVoxels)}))  # pyright: ignore
            merged.append(merge(parts))
            advance()
    if not merged:
        raise ValueError("the backbone found no depth in any image, so there is nothing to reconstruct")
    return merged[0] if len(merged) == 1 else concatenate(merged)


def _slabs(columns: Sequence[Tensor], limit: int) -> list[tuple[int, int]]:
    """Returns ranges of x that hold about ``limit`` entries of the sorted columns each."""
    places, counts = torch.cat(list(columns)).unique(return_counts=True)
    slab = (counts.cumsum(0) - counts) // limit
    starts = torch.cat((torch.ones(1, dtype=torch.bool), slab.diff() > 0)).nonzero()[:, 0] if len(places) else []
    bounds = [int(places[start]) for start in starts]
    return list(zip(bounds, [*bounds[1:], int(places[-1]) + 1], strict=True)) if bounds else []


def _read_rows(file: Path, rows: slice) -> dict[str, Tensor]:
    """Reads some rows of all tensors in a finished step's file."""
    with safe_open(file, "pt") as opened:
        return {key: opened.get_slice(key)[rows] for key in opened.keys()}  # noqa: SIM118


def remove(folder: Path, but: Path | None = None) -> None:
    """Removes all sets of a folder, except for that in the folder ``but``; also the folder if it is empty then."""
    sets = [file.parent for file in folder.glob(f"*/{_SET}") if file.parent != but]
    for place in sets:
        shutil.rmtree(place)
    if sets and not any(folder.iterdir()):
        folder.rmdir()


@dataclass(frozen=True, eq=False)
class Window:
    """Views that go through the model together.

    Attributes:
        views: ``[n]`` indices of all its views, ascending.
        own: range of the views that enter the scene from this window; the others are their neighbours.
    """

    views: Tensor
    own: slice

    @property
    def inner(self) -> slice:
        """Positions of ``own`` in ``views``."""
        first = int(torch.searchsorted(self.views, self.own.start))
        return slice(first, first + self.own.stop - self.own.start)


def window_size(asked: int | None, views: int) -> int:
    """Returns the number of own views per window; 0: all views at once.

    Args:
        asked: requested number; None: automatic.
        views: number of views.

    Raises:
        ValueError: if ``asked`` is below 4 and not 0.
    """
    if asked is not None and asked != 0 and asked < 4:
        raise ValueError(f"window must be at least 4 views, or 0 for all views at once, got {asked}")
    size = asked if asked is not None else SIZE if views > AUTOMATIC else 0
    return size if 0 < size < views else 0


def cut(count: int, size: int) -> list[Window]:
    """Returns windows of at most ``size`` consecutive own views and their neighbours; each view is owned once."""
    blocks = -(-count // size)
    total = min(size + 2 * max(size // 6, MARGIN), count) if blocks > 1 else count
    windows = []
    for begin, end in itertools.pairwise(count * block // blocks for block in range(blocks + 1)):
        first = min(max(begin - (total - (end - begin)) // 2, 0), count - total)
        windows.append(Window(torch.arange(first, first + total), slice(begin, end)))
    return windows


class Capture:
    """All views of a long capture.

    Args:
        store: store of the decoded views.
        pictures: source pictures, one per view.
        size: ``(height, width)`` of the images.
        monitor: shows the progress.

    Attributes:
        images: ``[V, 3, H, W]``, memory-mapped.
        mask: ``[V, H, W]``, memory-mapped; None: all pixels count.
        given: given cameras ``[1, V]``; None if there are none.

    Raises:
        ValueError: if a picture cannot be read.
    """

    def __init__(
        self,
        store: WindowStore,
        pictures: Sequence[Picture],
        size: tuple[int, int],
        monitor: Monitor,
    ) -> None:
        self.pictures, self.store, self.size, count = pictures, store, size, len(pictures)
        self._source = source_of(pictures)
        self.images = store.array("images", (count, 3, *size))
        intrinsics = []
        with monitor.stage("load images", -(-count // AT_ONCE)) as advance:
            for first in range(0, count, AT_ONCE):
                name = f"loaded-{first:06d}"
                found = store.load(name)
                if found is None:
                    found = self._read(slice(first, min(first + AT_ONCE, count)), size)
                    store.save(name, found)
                intrinsics.append(found["intrinsics"])
                advance()
        self.mask = store.array("mask") if store.has("mask") else None
        self._depth = store.array("given_depth") if store.has("given_depth") else None
        self.given: Cameras | None = None
        if self._source:
            self.given = Cameras(given_poses(pictures, map_shift(pictures))[None], torch.cat(intrinsics)[None], size)

    def _read(self, rows: slice, size: tuple[int, int]) -> dict[str, Tensor]:
        views = load_views(self.pictures[rows], size, Monitor())
        shape = (len(self.pictures), *size)
        self.images[rows] = views.images
        if views.mask is not None:
            self.store.array("mask", shape, fill=1)[rows] = views.mask
        hints = views.hints
        if hints.cameras is None:
            return {"intrinsics": torch.eye(3).repeat(len(views.images), 1, 1)}
        if hints.depth is not None:
            self.store.array("given_depth", shape)[rows] = hints.depth[0]
        return {"intrinsics": hints.cameras.intrinsics[0]}

    def views(self, rows: Tensor) -> tuple[Tensor, Hints]:
        """Returns images ``[1, n, 3, H, W]`` and hints of the views ``rows [n]``."""
        mask = None if self.mask is None else self.mask[None, rows]
        if self.given is None:
            return self.images[None, rows], Hints(frame_ids=rows[None], mask=mask)
        depth = None if self._depth is None else self._depth[None, rows]
        near_far = depth_range([self.pictures[row] for row in rows.tolist()])
        hints = Hints(depth, self.given.select(rows), (self._source,), rows[None], near_far, mask)
        return self.images[None, rows], hints
