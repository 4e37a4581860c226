"""Colours of Gaussians in every view: the compiled pass and the plain one."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.rendering.scenes import view_colors, view_colors_reference


def poses(generator: torch.Generator) -> Tensor:
    turns = torch.nn.functional.normalize(torch.randn(3, 4, generator=generator), dim=-1)
    shifts = torch.randn(3, 3, 1, generator=generator)
    top = torch.cat((quat_to_matrix(turns), shifts), -1)
    return torch.cat((top, torch.tensor([0.0, 0, 0, 1]).expand(3, 1, 4)), 1)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_compiled_colours_equal_the_plain_ones(degree: int) -> None:
    generator = torch.Generator().manual_seed(degree)
    sh = 0.6 * torch.randn(5000, (degree + 1) ** 2, 3, generator=generator)  # more than a chunk; many are clamped
    given = (sh, 2 * torch.randn(5000, 3, generator=generator), poses(generator))
    weights = torch.randn(3, 5000, 3, generator=generator)
    leaves, exact = [x.requires_grad_() for x in given], [x.detach().double().requires_grad_() for x in given]
    found = view_colors(*leaves)
    expected = view_colors_reference(exact[0], exact[1], invert_rigid(exact[2])[:, :3, 3])
    assert type(found.grad_fn).__name__ == "ViewColorsBackward"
    assert 0.05 < (found == 0).float().mean() < 0.5
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-6)
    gradients = torch.autograd.grad((weights * found).sum(), leaves)
    for mine, plain in zip(gradients, torch.autograd.grad((weights * expected).sum(), exact), strict=True):
        assert (mine - plain).abs().max() < 1e-5 * plain.abs().max()


def test_constant_colours_are_the_same_in_all_views() -> None:
    sh = torch.tensor([[[1.0, -9.0, 0.0]]])
    colors = view_colors(sh, torch.zeros(1, 3), torch.eye(4).expand(4, 4, 4))
    torch.testing.assert_close(colors, torch.tensor([[[0.28209479 + 0.5, 0.0, 0.5]]]))
