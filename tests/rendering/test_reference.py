"""The dense reference: finite differences."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.rendering.scenes import KINDS, PARAMETERS, pinhole, soup
from vg2gt.rendering import render
from vg2gt.rendering.options import DepthKind, Mode


@pytest.mark.parametrize("parameter", PARAMETERS)
@pytest.mark.parametrize(("mode", "depth"), KINDS)
def test_gradcheck_of_color_depth_and_normal(mode: Mode, depth: DepthKind, parameter: str) -> None:
    gaussians, cameras = soup(8, seed=5, size=0.4), pinhole((5, 6), focal=(8.0, 7.0))

    def outputs(value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        changed = replace(gaussians, **{parameter: value})
        out = render(
            changed, cameras, mode, implementation="dense", depth=depth, bisections=60, slope_floor=0.0, near=0.001
        )
        return out.color, out.depth, out.normal

    value = getattr(gaussians, parameter).clone().requires_grad_()
    assert (outputs(value)[1] > 0).float().mean() > 0.3
    assert torch.autograd.gradcheck(outputs, (value,), eps=1e-6, atol=1e-6, rtol=1e-5)
