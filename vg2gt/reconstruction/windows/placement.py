"""Brings windows into one frame and unit: similarities on shared views, and a pose graph for loops."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from vg2gt.geometry.alignment import Similarity, align_cameras, fit_depth_scale, weighted_median
from vg2gt.geometry.cameras import camera_centers, relative_to_first
from vg2gt.reconstruction.windows.store import Window
from vg2gt.types import Cameras
from vg2gt.visibility.counts import count_views

PARAMETERS = 7  # per window: log scale, rotation vector, translation
_OUTLIER = 0.1  # residual (relative, rad, window depths) beyond which an edge is down-weighted
_CONTRADICTS = 0.25  # residual from which a loop is rejected
AGREE = 0.1  # share of a loop's pixels that must agree with its other part
TOLERANCE, MARGIN = 0.05, 0.1  # relative depth differences of that check: agreement, looking through
ROUNDS = 50  # maximum function evaluations of the pose graph's solver
APART = 2  # minimum number of windows between those that a loop joins

Edge: TypeAlias = "tuple[int, int, NDArray[np.float64]]"
"""Indices of two windows a and b, and the 4x4 similarity transform from the frame of a to that of b."""


@dataclass(frozen=True)
class Found:
    """A backbone's prediction for some views, in a frame and unit of its own.

    Attributes:
        views: ``[n]`` int64 indices of the views.
        cameras: ``[1, n]`` cameras at the size of ``depth``.
        depth: ``[n, h, w]`` reduced depth, 0 = none.
        intrinsics: ``[1, n, 3, 3]`` intrinsics of the full images.
    """

    views: Tensor
    cameras: Cameras
    depth: Tensor
    intrinsics: Tensor

    def exact(self, views: Tensor) -> tuple[Cameras, Tensor]:
        """Returns cameras in float64, and depth, of some of the views."""
        rows = (self.views[None] == views[:, None]).int().argmax(1)
        chosen = self.cameras.select(rows)
        return replace(chosen, world_to_camera=chosen.world_to_camera.double()), self.depth[rows]


def place_windows(windows: Sequence[Found], loops: Sequence[Found] = ()) -> list[Similarity]:
    """Returns the similarity (float64, B = 1) of each window to the frame and unit of the first.

    Args:
        windows: in order, each sharing views with the next.
        loops: predictions that share views with distant windows, the most trusted first. A loop that contradicts the
            others is left out.

    Raises:
        ValueError: if a window shares no views with the others.
    """
    nodes, edges = [], []
    for window in windows:
        edges += _edges(nodes, window)
        nodes.append(window)
    poses = _chained(edges, np.zeros((1, PARAMETERS)), len(nodes))
    if len(edges) >= len(nodes):  # otherwise the chain satisfies every edge
        poses, _ = _solved(nodes, edges, poses)
    for loop in loops:
        more = [*edges, *_edges(nodes, loop)]
        tried, largest = _solved([*nodes, loop], more, _chained(more, poses, len(nodes) + 1))
        if largest < _CONTRADICTS:
            poses, edges = tried, more
            nodes.append(loop)
    rotations = Rotation.from_rotvec(poses[:, 1:4]).as_matrix()
    parts = zip(np.exp(poses[:, :1]), rotations, poses[:, 4:], strict=True)
    moves = [Similarity(*map(torch.tensor, (scale, turn[None], shift[None]))) for scale, turn, shift in parts]
    return moves[: len(windows)]


def _solved(
    found: Sequence[Found], edges: Sequence[Edge], start: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Returns the parameters ``[n, 7]`` that fit the edges best, with the first fixed, and the largest residual."""
    depths = [float(each.depth[each.depth > 0].median()) if (each.depth > 0).any() else 1.0 for each in found]
    a, b = np.array([edge[:2] for edge in edges]).T
    measured = np.stack([edge[2] for edge in edges])
    lengths = (np.exp(start[:, 0]) * depths)[a, None]  # in the first window's unit

    def misfits(flat: NDArray[np.float64]) -> NDArray[np.float64]:
        poses = np.concatenate((start[:1], flat.reshape(-1, PARAMETERS)))
        wanted = _compose(poses[b], measured)
        turn = (Rotation.from_rotvec(poses[a, 1:4]).inv() * Rotation.from_rotvec(wanted[:, 1:4])).as_rotvec()
        return np.column_stack((wanted[:, 0] - poses[a, 0], turn, (wanted[:, 4:] - poses[a, 4:]) / lengths))

    result = least_squares(
        lambda flat: misfits(flat).ravel() / _OUTLIER,
        start[1:].ravel(),
        loss="soft_l1",
        x_scale="jac",
        max_nfev=ROUNDS,
    )
    return np.concatenate((start[:1], result.x.reshape(-1, PARAMETERS))), float(np.abs(misfits(result.x)).max())


def loop_candidates(descriptors: Tensor, blocks: Sequence[slice], most: int) -> list[tuple[int, int]]:
    """Returns pairs of similar views from windows far apart in the order, the most similar first.

    Args:
        descriptors: ``[V, D]``, one per view.
        blocks: own views of each window.
        most: maximum number of pairs; a pair is skipped if both its windows neighbour those of a better pair.
    """
    unit = torch.nn.functional.normalize(descriptors - descriptors.mean(0), dim=1)
    pairs = []
    for i, j in itertools.combinations(range(len(blocks)), 2):
        if j - i > APART:
            alike = unit[blocks[i]] @ unit[blocks[j]].T
            best = int(alike.argmax())
            u, v = divmod(best, alike.shape[1])
            pairs.append((float(alike.flatten()[best]), i, j, blocks[i].start + u, blocks[j].start + v))
    chosen: list[tuple[int, int, int, int]] = []
    for _, i, j, u, v in sorted(pairs, reverse=True):
        if len(chosen) < most and all(abs(i - k) > 1 or abs(j - m) > 1 for k, m, _, _ in chosen):
            chosen.append((i, j, u, v))
    return [(u, v) for _, _, u, v in chosen]


def closes(loop: Found, parts: tuple[Tensor, Tensor]) -> bool:
    """Returns whether the two parts of a loop see the same surfaces, as the backbone places them.

    Args:
        loop: prediction for the views of both parts.
        parts: ``[m]`` rows of each part.
    """
    partners = torch.full((len(loop.views), max(map(len, parts))), -1, dtype=torch.int64)
    for own, other in (parts, parts[::-1]):
        partners[own, : len(other)] = other
    counts = count_views(loop.depth, loop.cameras, partners, TOLERANCE, MARGIN)
    known, agree = loop.depth > 0, counts.agree > 0
    against = (counts.through > counts.agree).sum()
    return bool(agree.sum() > AGREE * known.sum()) and bool(agree.sum() > against)


def _edges(found: Sequence[Found], last: Found) -> list[Edge]:
    """Returns edges from windows to a further one, where they share at least two views."""
    edges = []
    for number, each in enumerate(found):
        shared = each.views[torch.isin(each.views, last.views)]
        if len(shared) >= 2:
            edges.append((number, len(found), _between(each.exact(shared), last.exact(shared))))
    return edges


def _between(a: tuple[Cameras, Tensor], b: tuple[Cameras, Tensor]) -> NDArray[np.float64]:
    """Returns the similarity from frame a to frame b: scale from the views' depth, the rest from their cameras."""
    depths = a[1][:, None], b[1][:, None]  # one scale per view
    scale = fit_depth_scale(*depths, depths[0] > 0)
    scale = scale[torch.isfinite(scale)]
    move = align_cameras(a[0], b[0])
    size = float(scale.double().median()) if len(scale) else float(move.scale)
    turned = size * camera_centers(a[0])[0] @ move.rotation[0].T
    shift = weighted_median((camera_centers(b[0])[0] - turned).T, torch.ones(3, len(turned), dtype=torch.float64))
    turn = Rotation.from_matrix(move.rotation[0].numpy()).as_rotvec()
    return np.concatenate(([np.log(size)], turn, shift.numpy()))


def _chained(edges: Sequence[Edge], known: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Returns the parameters ``[n, 7]`` of all windows; those not ``known`` follow from an edge to an earlier one."""
    poses = list(known)
    for node in range(len(known), count):
        found = [edge for edge in edges if edge[1] == node]
        if not found:
            raise ValueError(f"window {node} shares no views with earlier windows: use larger windows (--window)")
        other, _, move = found[-1]
        poses.append(_compose(poses[other][None], _inverse(move))[0])
    return np.stack(poses)


def _compose(outer: NDArray[np.float64], inner: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the parameters ``[n, 7]`` of ``x -> outer(inner(x))``."""
    turn = Rotation.from_rotvec(outer[:, 1:4])
    shift = np.exp(outer[:, :1]) * turn.apply(inner[:, 4:]) + outer[:, 4:]
    turned = (turn * Rotation.from_rotvec(inner[:, 1:4])).as_rotvec()
    return np.column_stack((outer[:, 0] + inner[:, 0], turned, shift))


def _inverse(move: NDArray[np.float64]) -> NDArray[np.float64]:
    turn = Rotation.from_rotvec(move[1:4]).inv()
    return np.concatenate(([-move[0]], turn.as_rotvec(), -np.exp(-move[0]) * turn.apply(move[4:])))[None]


def seen_from(reference: Tensor, cameras: Cameras) -> Cameras:
    """Returns cameras in the frame of a camera with the pose ``[4, 4]``, float32.

    They are computed in float64 first; the reference itself becomes exactly the identity.
    """
    poses = cameras.world_to_camera
    reference = reference.to(poses)
    first = torch.cat((reference[None, None], poses), 1).double()
    seen = relative_to_first(replace(cameras, world_to_camera=first)).world_to_camera[:, 1:].float()
    same = (poses == reference).all(-1).all(-1)[..., None, None]
    return replace(cameras, world_to_camera=torch.where(same, torch.eye(4), seen))


def moves_onto(found: Sequence[Found], given: Cameras) -> list[Similarity]:
    """Returns the similarity (float64, B = 1) that aligns each window's cameras with the given ones."""
    exact = replace(given, world_to_camera=given.world_to_camera.double())
    return [align_cameras(window.exact(window.views)[0], exact.select(window.views)) for window in found]


def place_found(
    found: Sequence[Found], moves: Sequence[Similarity], windows: Sequence[Window], size: tuple[int, int]
) -> tuple[Cameras, Tensor]:
    """Places windows whose backbone predicts cameras.

    Args:
        found: prediction for each window.
        moves: similarity of each window into one frame (B = 1).
        windows: the windows.
        size: ``(height, width)`` of the images.

    Returns:
        Cameras ``[1, V]`` in that frame, and factors ``[V]`` float32 from the unit of a view's window to theirs.
    """
    poses, intrinsics, scales = [], [], []
    for each, move, window in zip(found, moves, windows, strict=True):
        moved = move.apply_cameras(each.exact(each.views)[0]).world_to_camera
        poses.append(moved[:, window.inner])
        intrinsics.append(each.intrinsics[:, window.inner])
        scales.append(move.scale.float().expand(window.own.stop - window.own.start))
    return Cameras(torch.cat(poses, 1), torch.cat(intrinsics, 1), size), torch.cat(scales)
