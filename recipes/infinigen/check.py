"""Checks the views of a room: consistency of depth between views, and the fraction of pixels beyond windows.

``python check.py ROOM`` prints the results for a folder written by ``views.py``. Needs only NumPy.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_TOLERANCE = 0.02  # relative difference of depth
_LEAST_SHARED = 0.05  # minimum fraction of a view's pixels that must be comparable in the other view
_MOST_CONTRADICTIONS = 0.03
_MOST_BEYOND = 0.5

Camera = tuple[NDArray[np.float64], NDArray[np.float64]]  # intrinsics [3, 3] of pixel corners, camera-to-world [4, 4]


def warp(
    depth: NDArray[np.float64], camera: Camera, other_depth: NDArray[np.float64], other: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compares the points of one view with the depth of another view, where they project into it.

    Inverse depth is interpolated bilinearly, which is exact on planes; infinite depth has inverse 0. Points at edges,
    whose four pixels differ by more than 10 %, are left out.

    Args:
        depth: z-depth of the view ``[h, w]``; points at infinity are left out.
        camera: camera of the view.
        other_depth: z-depth of the other view ``[h, w]``.
        other: camera of the other view.

    Returns:
        ``z / depth - 1`` of each point, where ``z`` is its depth in the other view: once with the interpolated depth of
        the other view, and once with the smallest depth of the 4x4 pixels around it.
    """
    height, width = depth.shape
    y, x = np.nonzero(np.isfinite(depth))
    rays = np.stack((x + 0.5, y + 0.5, np.ones(len(x)))) * depth[y, x]
    relative = np.linalg.inv(other[1]) @ camera[1]
    points = relative[:3, :3] @ np.linalg.inv(camera[0]) @ rays + relative[:3, 3:]
    points = points[:, points[2] > 0.01]
    u, v, _ = other[0] @ points / points[2] - 0.5
    seen = (u >= 1) & (u < width - 2) & (v >= 1) & (v < height - 2)
    u, v, z = u[seen], v[seen], points[2, seen]
    column, row = u.astype(int), v.astype(int)
    around = np.min([other_depth[row + i, column + j] for i in range(-1, 3) for j in range(-1, 3)], 0)
    corners = 1 / np.stack([other_depth[row + i, column + j] for i in (0, 1) for j in (0, 1)])
    u, v = u - column, v - row
    inverse = ((1 - v) * (1 - u), (1 - v) * u, v * (1 - u), v * u) * corners
    smooth = corners.min(0) >= 0.9 * corners.max(0)
    return z[smooth] * inverse.sum(0)[smooth] - 1, z[smooth] / around[smooth] - 1


def read_views(room: Path) -> Iterator[tuple[str, Camera, NDArray[np.float64]]]:
    """Yields path, camera and depth of a room's views, in order."""
    for index, view in enumerate(json.loads((room / "views.json").read_text())):
        stem = f"0_0_{index:04d}_0"
        with np.load(room / f"frames/camview/camera_0/camview_{stem}.npz", allow_pickle=False) as file:
            camera = (file["K"], file["T"])
        depth = np.load(room / f"frames/Depth/camera_0/Depth_{stem}.npy", allow_pickle=False)
        yield view["path"], camera, depth.astype(np.float64)


def check_room(room: Path) -> dict[str, float | int | bool]:
    """Checks a room.

    Returns:
        Results by name. ``views``: number of views. ``pairs``: number of consecutive views of a path that overlap.
        ``contradictions``: mean fraction of warped points that lie more than 2 % in front of everything the other view
        sees around them, which is impossible. ``agreeing``: mean fraction within 2 % (most others are occluded).
        ``difference``: median relative difference of the agreeing points. ``beyond``: fraction of pixels beyond
        windows. ``nearest``, ``median``: depth in metres. ``ok``: whether the room is accepted.
    """
    views = list(read_views(room))
    figures = []
    for (path, camera, depth), (next_path, other, other_depth) in itertools.pairwise(views):
        if path != next_path:
            continue
        difference, to_nearest = warp(depth, camera, other_depth, other)
        if len(difference) < _LEAST_SHARED * depth.size:
            continue
        near = np.abs(difference) < _TOLERANCE
        figures.append(
            ((to_nearest < -_TOLERANCE).mean(), near.mean(), np.median(np.abs(difference[near])) if near.any() else 1.0)
        )
    depth = np.stack([depth for *_, depth in views])
    finite = depth[np.isfinite(depth)]
    contradictions, agreeing, difference = np.mean(figures, 0) if figures else (1.0, 0.0, 1.0)
    beyond = 1 - finite.size / depth.size
    found = {"contradictions": contradictions, "agreeing": agreeing, "difference": difference, "beyond": beyond}
    found |= {"nearest": finite.min(initial=np.inf), "median": np.median(finite) if finite.size else 0.0}
    ok = bool(contradictions <= _MOST_CONTRADICTIONS and beyond <= _MOST_BEYOND)
    counts = {"views": len(views), "pairs": len(figures)}
    return counts | {name: round(float(value), 5) for name, value in found.items()} | {"ok": ok}


if __name__ == "__main__":
    print(json.dumps(check_room(Path(sys.argv[1]))))
