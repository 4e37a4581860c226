"""The views of a long capture: decoded once, kept in files, and read one window at a time."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.reconstruction.inputs import depth_range, given_poses, load_views, source_of
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.pictures import Picture
from vg2gt.reconstruction.windows.store import WindowStore
from vg2gt.types import Cameras, Hints

AUTOMATIC = 100  # number of views above which a capture is processed in windows
SIZE = 24  # own views per window
MARGIN = 6  # minimum number of neighbours before and after them; a sixth of large windows
_AT_ONCE = 16  # pictures decoded per finished step


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


def window_size(asked: int | None, views: int, kept: bool = False) -> int:
    """Returns the number of own views per window; 0: all views at once.

    Args:
        asked: requested number; None: automatic.
        views: number of views.
        kept: always use windows, because their voxels are kept.

    Raises:
        ValueError: if ``asked`` is below 4 and not 0.
    """
    if asked is not None and asked != 0 and asked < 4:
        raise ValueError(f"window must be at least 4 views, or 0 for all views at once, got {asked}")
    if kept:
        return min(asked or SIZE, views)
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
        pictures: see above.
        size: see above.
        images: ``[V, 3, H, W]``, memory-mapped.
        mask: ``[V, H, W]``, memory-mapped; None: all pixels count.
        given: given cameras ``[1, V]``; None if there are none.

    Raises:
        ValueError: if a picture cannot be read.
    """

    def __init__(self, store: WindowStore, pictures: Sequence[Picture], size: tuple[int, int], monitor: Monitor):
        self.pictures, self.store, self.size, count = pictures, store, size, len(pictures)
        self._source = source_of(pictures)
        self.images = store.array("images", (count, 3, *size))
        intrinsics = []
        with monitor.stage("load images", -(-count // _AT_ONCE)) as advance:
            for first in range(0, count, _AT_ONCE):
                name = f"loaded-{first:06d}"
                found = store.load(name)
                if found is None:
                    found = self._read(slice(first, min(first + _AT_ONCE, count)), size)
                    store.save(name, found)
                intrinsics.append(found["intrinsics"])
                advance()
        self.mask = store.array("mask") if store.has("mask") else None
        self._depth = store.array("given_depth") if store.has("given_depth") else None
        self.given: Cameras | None = None
        if self._source:
            self.given = Cameras(given_poses(pictures)[None], torch.cat(intrinsics)[None], size)

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
