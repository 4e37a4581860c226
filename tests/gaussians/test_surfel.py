"""The surfel start against surfaces whose normal, colour gradient and extent are known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.method.additions.surfel import (
    ALONE,
    COLOR_GAIN,
    MIN_REACH,
    SHARED,
    THICKNESS,
    surface_frame,
    surfel_start,
)
from vg2gt.method.additions.voxel_normals import facing_normals
from vg2gt.types import VoxelMoments


def moments_of(points: Tensor, colors: Tensor, facing: Tensor, pixel: float = 0.0) -> VoxelMoments:
    """Moments of one voxel from its points ``[N, 3]`` (cells), colours ``[N, 3]`` and how the camera sees it."""
    centered, tint = points - points.mean(0), colors - colors.mean(0)
    spread, cross = centered.T @ centered / len(points), centered.T @ tint / len(points)
    spread, facing = spread[None], F.normalize(facing, dim=-1)[None]
    return VoxelMoments(spread, cross[None], facing, spread.new_tensor([pixel]), facing_normals(spread, facing))


def square(frame: Tensor, gradient: Tensor, extent: tuple[float, float] = (1.0, 1.0)) -> tuple[Tensor, Tensor]:
    """Points all over a square spanned by the frame's first two axes, and colours that change linearly along them."""
    steps = (torch.arange(20, dtype=torch.float64) + 0.5) / 20 - 0.5
    u, v = torch.meshgrid(extent[0] * steps, extent[1] * steps, indexing="ij")
    place = torch.stack((u.flatten(), v.flatten()), -1)
    return place @ frame[:, :2].T, 0.5 + place @ gradient


FRAMES = quat_to_matrix(torch.randn(8, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
GRADIENT = torch.tensor([[0.3, 0.4, 0.2], [0.0, 0.0, 0.0]], dtype=torch.float64)


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_normal_direction_and_gradient_of_a_coloured_square(frame: Tensor, side: float) -> None:
    facing = side * frame[:, 2] + 0.3 * frame[:, 0]
    found, gradient, reach = surface_frame(moments_of(*square(frame, GRADIENT), facing))
    expected = torch.stack((frame[:, 0], side * frame[:, 1], side * frame[:, 2]), -1)
    torch.testing.assert_close(found[0], expected, atol=2e-3, rtol=0)
    assert torch.linalg.det(found[0]) > 0
    torch.testing.assert_close(gradient[0], frame[:, :2] @ GRADIENT, atol=0.01, rtol=0)  # the ridge takes 1 %
    torch.testing.assert_close(reach[0], torch.ones(2, dtype=torch.float64), atol=0.01, rtol=0)


def test_two_gaussians_lie_along_the_gradient_and_share_its_colours() -> None:
    frame = FRAMES[2]
    start = surfel_start(moments_of(*square(frame, GRADIENT), frame[:, 2]), 2)
    torch.testing.assert_close(
        start.offsets[0], torch.stack((-0.3 * frame[:, 0], 0.3 * frame[:, 0])), atol=5e-3, rtol=0
    )
    expected = COLOR_GAIN * 0.3 * GRADIENT[0]
    torch.testing.assert_close(start.colors[0], torch.stack((-expected, expected)), atol=5e-3, rtol=0)
    sizes = torch.tensor([SHARED / 2, ALONE, THICKNESS], dtype=torch.float64)
    torch.testing.assert_close(start.scales[0], sizes.expand(2, 3), atol=5e-3, rtol=0)


def test_where_the_surface_only_touches_the_cell_gaussians_are_smaller() -> None:
    frame = FRAMES[3]
    half = surfel_start(moments_of(*square(frame, GRADIENT, (1.0, 0.5)), frame[:, 2]), 1)
    torch.testing.assert_close(half.scales[0, 0, 1] / half.scales[0, 0, 0], torch.tensor(0.5, dtype=torch.float64))
    tiny = surfel_start(moments_of(*square(frame, GRADIENT, (1e-3, 1e-3)), frame[:, 2]), 1)
    torch.testing.assert_close(tiny.scales[0, 0, 0], torch.tensor(MIN_REACH * ALONE, dtype=torch.float64))


def test_few_points_stand_for_their_pixels() -> None:
    """One pixel that looks at a surface straight on covers its own side, and twice that at 60 degrees."""
    frame, point = FRAMES[4], torch.zeros(1, 3, dtype=torch.float64)
    straight = surface_frame(moments_of(point, point, frame[:, 2], pixel=0.5))[2]
    torch.testing.assert_close(straight[0], torch.full((2,), 0.5, dtype=torch.float64))
    leaning = 0.5 * frame[:, 2] + 0.75**0.5 * frame[:, 0]
    _, _, reach = surface_frame(moments_of(*square(frame, 0 * GRADIENT, (0.8, 0.4)), leaning, pixel=0.3))
    expected = torch.tensor([(0.8**2 + 0.6**2) ** 0.5, (0.4**2 + 0.3**2) ** 0.5], dtype=torch.float64)
    torch.testing.assert_close(reach[0], expected, atol=5e-3, rtol=0)


@pytest.mark.parametrize("points", ["one", "line", "same place"])
def test_degenerate_voxels_face_their_cameras(points: str) -> None:
    facing = F.normalize(torch.tensor([0.2, -0.3, 0.9], dtype=torch.float64), dim=-1)
    along = F.normalize(torch.linalg.cross(facing, torch.tensor([1.0, 0, 0], dtype=torch.float64)), dim=-1)
    count = {"one": 1, "line": 30, "same place": 30}[points]
    places = torch.linspace(-0.5, 0.5, count, dtype=torch.float64)[:, None] * along * (points == "line")
    colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for splits in (1, 2, 4, 5):
        start = surfel_start(moments_of(places, colors, facing).map(Tensor.float), splits)
        for part in (start.frame, start.offsets, start.scales, start.colors):
            assert part.isfinite().all()
        torch.testing.assert_close(start.frame[0, :, 2], facing.float(), atol=1e-3, rtol=0)
        torch.testing.assert_close(start.frame[0].T @ start.frame[0], torch.eye(3), atol=1e-5, rtol=0)
        assert (start.scales > 0).all()
