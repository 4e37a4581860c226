"""Checks which pixels' depth the other views support, and how fine voxels may be: our addition to the paper.

Depth is unreliable on textureless walls, in the sky and beyond the searched range, and becomes floaters in voxels.
Other views see through a floater, and see a surface at the same place where the depth is correct.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from vg2gt.geometry.cameras import compose, focal_lengths, invert_rigid, strided_intrinsics, unproject
from vg2gt.types import Cameras, Geometry, TensorRecord, check_ranges
from vg2gt.visibility.counts import count_views, depth_ratio

STRIDE = 4  # pixels between samples of the disagreement, along each axis
NEIGHBORS = 8  # partners per view for the disagreement
_LOOKED_AT = 32  # evenly spaced views whose disagreement is measured if there are MANY
SAMPLES = 12  # pixels per side of the grid on which overlap is measured
# Above MANY views, a view has _MORE times as many partners, hidden points do not count, and near views count more.
MANY, _MORE = 100, 4
BEHIND = 1.1  # relative to a view's depth; points farther away are hidden from it
_LEAST_OVERLAP = 0.02  # smallest share of a view's samples in the image of a partner
LEAST = 2  # smallest number of views of a moment that look through a moved point, while none of them agrees


@dataclass(frozen=True)
class Support(TensorRecord):
    """Result of checking the views' depth against each other.

    Attributes:
        keep: ``[B, V, H, W]`` bool, pixels whose depth enters the scene.
        coarsen: ``[B]`` factor >= 1 on the smallest voxel size.
    """

    keep: Tensor
    coarsen: Tensor


@dataclass(frozen=True)
class ViewCheck:
    """Selects the pixels whose depth enters the scene, and how fine its voxels may be.

    A pixel is dropped if more views look through its point than agree with it; later rounds ignore its depth. Above 100
    views, a view counts more the nearer it is to the point: depth from other rooms is less precise.

    Args:
        tolerance: relative depth difference below which two views agree.
        margin: relative depth difference above which a view looks through a point.
        rounds: number of rounds.
        partners: largest number of views each view is compared with, four times as many above 100 views; bounds the
            time.
        fine_below: median disagreement of views in pixels up to which voxels are as fine as configured; above it, the
            smallest voxel grows in proportion.
        coarsest: largest factor by which it grows.
        moment: smallest number of frames in a moment. Pixels whose surface is gone at another moment show a moving
            object and are dropped (:func:`moved`); None assumes a static scene.
        moved_margin: relative depth difference above which a view shows that a surface is gone.

    Raises:
        ValueError: if an option is out of range; the message names it.
    """

    tolerance: float = 0.02
    margin: float = 0.04
    rounds: int = 2
    partners: int = 24
    fine_below: float = 1.4
    coarsest: float = 1.4  # 2: a third fewer Gaussians, up to 0.9 dB less on photographs (recipes/sweep/README.md)
    moment: int | None = None
    moved_margin: float = 0.08

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "model.visibility.",
            ("tolerance", self.tolerance > 0, "positive"),
            ("margin", self.tolerance <= self.margin < 1, "at least the tolerance and below 1"),
            ("rounds", self.rounds >= 1, "at least 1"),
            ("partners", self.partners >= 1, "at least 1"),
            ("fine_below", self.fine_below > 0, "positive"),
            ("coarsest", self.coarsest >= 1, "at least 1"),
            ("moment", self.moment is None or self.moment >= LEAST, f"at least {LEAST}, or null"),
            ("moved_margin", self.tolerance <= self.moved_margin < 1, "at least the tolerance and below 1"),
        )

    @torch.no_grad()
    def __call__(self, geometry: Geometry, frames: Tensor | None = None) -> Support:
        """Checks the depth of B scenes; ``keep`` is false at pixels without depth.

        Args:
            geometry: geometry of B scenes.
            frames: ``[B, V]`` frame numbers in temporal order; None: unknown, so nothing is dropped as moving.
        """
        times = [None] * len(geometry.depth) if frames is None else frames.to(geometry.depth.device)
        depth = geometry.depth.float().nan_to_num(0.0, 0.0, 0.0)
        scenes = [self._check(depth[b], geometry.cameras.scene(b), time) for b, time in enumerate(times)]
        return Support(*(torch.stack(parts) for parts in zip(*scenes, strict=True)))

    def _check(self, depth: Tensor, cameras: Cameras, frames: Tensor | None) -> tuple[Tensor, Tensor]:
        partners = choose_partners(depth, cameras, self.partners)
        keep, spare = (torch.zeros_like(depth, dtype=torch.bool) for _ in range(2))
        for _ in self.in_blocks(depth, cameras, partners, [slice(0, len(depth))], (keep, spare)):
            pass
        if self.moment is not None and frames is not None:
            left = torch.where(keep, depth, 0.0)
            keep = keep & ~moved(left, cameras, partners, frames, self.moment, self.tolerance, self.moved_margin)
        return keep, self.coarsening(depth, cameras, partners)

    @torch.no_grad()
    def in_blocks(
        self,
        depth: Tensor,
        cameras: Cameras,
        partners: Tensor,
        blocks: Sequence[slice],
        masks: tuple[Tensor, Tensor],
    ) -> Iterator[None]:
        """Checks the depth of one scene, except for ``moment``; yields after each block.

        Args:
            depth: ``[V, H, W]`` z-depth, 0 = none; may be memory-mapped.
            cameras: cameras of the views (B = 1).
            partners: ``[V, K]`` from :func:`choose_partners`.
            blocks: slices of views whose partners' depth fits in memory; together they cover all views.
            masks: two buffers ``[V, H, W]``, overwritten; at the end the first is 1 for pixels that are kept, else 0.
        """
        before, after = masks
        near_more = len(depth) > MANY  # near views count more (count_views)
        for rows in blocks:
            before[rows] = (depth[rows] > 0).to(before.dtype)
        for _ in range(self.rounds):
            for rows in blocks:
                views, local = _neighbourhood(partners, torch.arange(rows.start, rows.stop, device=partners.device))
                left = depth[views] * before[views]
                counts = count_views(left, cameras.select(views), local, self.tolerance, self.margin, near_more)
                inside = slice(0, rows.stop - rows.start)
                kept = counts.through[inside] <= counts.agree[inside]
                after[rows] = before[rows] * kept.to(before.dtype)
                yield
            before[:] = after

    @torch.no_grad()
    def coarsening(self, depth: Tensor, cameras: Cameras, partners: Tensor) -> Tensor:
        """Returns the factor on the smallest voxel size, a scalar; arguments as for :meth:`in_blocks`."""
        chosen = torch.arange(len(depth), device=partners.device)
        if len(depth) > MANY:
            chosen = torch.linspace(0, len(depth) - 1, _LOOKED_AT, device=partners.device).round().long()
        views, local = _neighbourhood(partners[:, :NEIGHBORS], chosen)
        return (disagreement(depth[views], cameras.select(views), local) / self.fine_below).clamp(1, self.coarsest)


@torch.no_grad()
def moved(
    depth: Tensor, cameras: Cameras, partners: Tensor, frames: Tensor, moment: int, tolerance: float, margin: float
) -> Tensor:
    """Returns the pixels ``[V, H, W]`` bool whose surface is gone at some moment, for one scene.

    Frames are grouped into moments of a few consecutive frames. Views of the same moment agree with a moving object's
    depth, views of another moment look through it. Counted over all views, an object that stays in place for half of
    the frames looks like correct depth. Counted per moment, all views of another moment contradict it.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = none.
        cameras: cameras of the views (B = 1), in the unit of the depth.
        partners: ``[V, K]`` int64, views that each view is compared with; -1 = none.
        frames: ``[V]`` frame numbers in temporal order.
        moment: smallest number of consecutive frames in a moment, and of partners in it; with fewer than twice as many
            views, there is only one moment.
        tolerance: relative depth difference below which views agree.
        margin: relative depth difference above which a view looks through a point.
    """
    views, most = len(depth), partners.shape[1]
    compared = views if most == views - 1 else most // 2  # unless all views are partners, only half are spread evenly
    moments = max(min(views, compared) // moment, 1)
    when = frames.argsort(stable=True).argsort() * moments // views  # [V]
    gone = torch.zeros_like(depth, dtype=torch.bool)
    for one in range(moments):
        # partners in this moment, for the views of other moments: [V, K]
        then = (partners >= 0) & (when[partners.clamp(min=0)] == one) & (when[:, None] != one)
        few = then.sum(1).max().item() if then.numel() else 0
        if few < LEAST:
            continue
        chosen = torch.where(then, partners, -1).sort(1, descending=True).values[:, : int(few)].contiguous()
        counts = count_views(depth, cameras, chosen, tolerance, margin)
        gone |= (counts.through >= LEAST) & (counts.agree == 0)
    return gone


def _neighbourhood(partners: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the given views ``[m]`` followed by their partners ``[n]``, and the partners ``[n, K]`` as indices.

    The added views have no partners themselves (-1).
    """
    if len(views) == len(partners):
        return views, partners
    named = partners[views].flatten()
    chosen = torch.cat((views, named[(named >= 0) & ~torch.isin(named, views)].unique()))
    place = partners.new_full((len(partners) + 1,), -1)
    place[chosen] = torch.arange(len(chosen), device=place.device)  # index -1 reads the last entry, which stays -1
    local = partners.new_full((len(chosen), partners.shape[1]), -1)
    local[: len(views)] = place[partners[views]]
    return chosen, local


@torch.no_grad()
def disagreement(depth: Tensor, cameras: Cameras, partners: Tensor) -> Tensor:
    """Returns the median of :func:`depth_differences` in pixels (times the focal length); 0 without overlap."""
    differences = depth_differences(depth, cameras, partners)
    return (
        differences.median() * focal_lengths(cameras.intrinsics)[0].to(depth).mean()
        if len(differences)
        else depth.new_zeros(())
    )


@torch.no_grad()
def depth_differences(depth: Tensor, cameras: Cameras, partners: Tensor) -> Tensor:
    """Returns relative differences ``[N]`` between points' depth in another view and that view's own depth.

    Args:
        depth: ``[V, H, W]`` z-depth of one scene, 0 = none.
        cameras: cameras of the views (B = 1), in the unit of the depth.
        partners: ``[V, K]`` int64, nearest first; -1 = none.
    """
    pose, intrinsics = cameras.world_to_camera[0].to(depth), cameras.intrinsics[0].to(depth)
    sampled = depth[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    strided = strided_intrinsics(intrinsics, STRIDE, STRIDE)
    to_world = invert_rigid(pose)
    size = (sampled.shape[1], sampled.shape[2])
    local = Cameras(torch.eye(4).to(depth).repeat(1, len(depth), 1, 1), strided[None], size)
    points = unproject(sampled[None], local)[0].flatten(1, 2)  # [V, P, 3] in each view's own frame
    differences = [depth.new_zeros(0)]
    for other in partners[:, :NEIGHBORS].T:
        there = other.clamp(min=0)
        ratio, known = depth_ratio(points, depth[there], compose(pose[there], to_world), intrinsics[there])
        known &= (sampled > 0).flatten(1) & (other >= 0)[:, None]
        differences.append((ratio - 1).abs()[known])
    return torch.cat(differences)


@torch.no_grad()
def choose_partners(depth: Tensor, cameras: Cameras, most: int) -> Tensor:
    """Selects for each view the other views that see its points.

    If more than ``most`` views qualify, half of the partners are the nearest by direction and overlap, and the others
    are spread evenly over the rest: near views confirm a surface, and views from the other side contradict floaters.
    More than 100 views often cover several rooms and would count points behind walls. Points hidden by a view's own
    depth are then ignored, and there are four times as many partners.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = none.
        cameras: cameras of the views (B = 1), in the unit of the depth.
        most: largest number of partners per view; four times as many above 100 views.

    Returns:
        ``[V, K]`` int64, nearest first; -1 where a view has fewer.
    """
    views, height, width = depth.shape
    count = min(most * (_MORE if views > MANY else 1), views - 1)
    if count < 1:
        return torch.empty(views, 0, dtype=torch.int64, device=depth.device)
    step = (max(height // SAMPLES, 1), max(width // SAMPLES, 1))
    rows, columns = slice(step[0] // 2, None, step[0]), slice(step[1] // 2, None, step[1])
    sampled = depth[:, rows, columns].double()
    pose, intrinsics = cameras.world_to_camera[0].double(), cameras.intrinsics[0].double()
    strided = strided_intrinsics(intrinsics, step[1], step[0])
    small = Cameras(pose[None], strided[None], (sampled.shape[1], sampled.shape[2]))
    points = unproject(sampled[None], small)[0].flatten(1, 2)  # [V, P, 3]
    known = (sampled > 0).flatten(1)  # [V, P]
    share = torch.zeros(views, views, dtype=torch.float64, device=depth.device)
    for other in range(views):
        seen = points @ pose[other, :3, :3].T + pose[other, :3, 3]
        pixel = seen @ intrinsics[other].T
        z = pixel[..., 2]
        u, v = pixel[..., 0] / z, pixel[..., 1] / z
        inside = known & (z > 0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        if views > MANY:
            column, row = (x.nan_to_num().clamp(0, side - 1).round().long() for x, side in ((u, width), (v, height)))
            inside &= z < BEHIND * depth[other][row, column]
        share[:, other] = inside.sum(1) / known.sum(1).clamp(min=1)
    share.fill_diagonal_(0)
    turn = torch.einsum("vij,wij->vw", pose[:, :3, :3], pose[:, :3, :3])  # 1 + 2 cos of the angle between views
    score = torch.where(share >= _LEAST_OVERLAP, share * (turn + 2), -1.0)
    ranked = score.argsort(dim=1, descending=True, stable=True)
    usable = (share >= _LEAST_OVERLAP).sum(1)
    return torch.stack([_spread(order, int(n), count) for order, n in zip(ranked, usable.tolist(), strict=True)])


def _spread(order: Tensor, usable: int, count: int) -> Tensor:
    """Picks ``count`` of the first ``usable`` entries: half from the front, half spread evenly; pads with -1."""
    if usable <= count:
        return torch.cat((order[:usable], order.new_full((count - usable,), -1)))
    dense = count // 2
    rest = torch.linspace(dense, usable - 1, count - dense, device=order.device).round().long()
    return torch.cat((order[:dense], order[rest]))
