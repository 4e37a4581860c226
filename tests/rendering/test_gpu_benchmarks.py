"""What a step asks of a GPU, counted without one; and the one command for those who have one."""

import importlib.util
import os

import pytest
import torch

from tests.gpu_counts import Operations, Waits
from vg2gt.rendering import Renderer
from vg2gt.rendering.options import RenderOptions
from vg2gt.types import Cameras, Gaussians

if importlib.util.find_spec("triton") is None:
    pytest.skip("needs triton, which has wheels for Linux on x86-64 only", allow_module_level=True)
if os.environ.get("TRITON_INTERPRET") == "1":
    pytest.skip("the interpreter's kernels are not launched as others are", allow_module_level=True)


from tests.rendering.kernel_launches import recorded


def count_step(benchmark_script, views: int) -> tuple[int, int, int]:
    """Launches, torch operations and waits of a forward and backward pass with colour, depth and normals."""
    scene = benchmark_script("render")
    gaussians, cameras = scene.room_gaussians(400, (224, 448)), scene.room_cameras(views, (224, 448))
    gaussians = gaussians.map(lambda t: t.requires_grad_() if t.is_floating_point() else t)
    with recorded() as launches, Waits() as waits, Operations() as operations:
        out = Renderer(implementation="triton")(gaussians, cameras)
        (out.color.sum() + out.depth.sum() + out.normal.sum()).backward()
    return len(launches), operations.places.total(), waits.places.total()


def test_a_step_is_a_few_launches_and_one_wait_whatever_the_views(benchmark_script) -> None:
    few, many = (count_step(benchmark_script, views) for views in (1, 8))
    assert few == many
    launches, operations, waits = many
    assert launches == 6
    assert launches + operations <= 60
    assert waits == 1


def test_many_refused_slots_do_not_overflow_their_sum() -> None:
    """One bad camera seen by ten million Gaussians: with 2^40 a slot the sum was negative, and memory was asked for."""
    from vg2gt.rendering.gpu.projection import REFUSED, SLOTS
    from vg2gt.rendering.gpu_tiles import RefusedError, render_triton

    assert SLOTS * REFUSED < 1 << 63
    count = (1 << 23) + 5
    one, matrix = torch.zeros(1, 3).expand(count, 3), torch.eye(4).expand(1, 1, 4, 4)
    gaussians = Gaussians(one, torch.ones(1, 4).expand(count, 4), one, one[:, 0], one[:, None], one[:, 0].long())
    cameras = Cameras(matrix, matrix[..., :3, :3], (8, 8))
    refused = recorded({"project_kernel": lambda counts, **_: counts.fill_(REFUSED)})
    with refused, pytest.raises(RefusedError, match="contain invalid values"):
        render_triton(gaussians, cameras, torch.zeros(3), RenderOptions())


def test_more_slots_than_can_be_numbered_are_refused() -> None:
    """A view whose Gaussians are so many; views are rendered in parts."""
    from vg2gt.rendering.gpu_tiles import _list

    views, count = (1 << 19) + 1, 1 << 11
    few, matrix = torch.zeros(count, 3), torch.eye(4).expand(1, views, 4, 4)
    tensors = (few, torch.ones(count, 4), few, few[:, 0], few[:, None], matrix, matrix[..., :3, :3], few[0])
    with recorded(), pytest.raises(ValueError, match="2048 Gaussians in 524289 views"):
        _list((*tensors, few[:, 0].long()), (8, 8), RenderOptions(), 1)
