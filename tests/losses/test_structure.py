"""The compiled structural dissimilarity against kornia's."""

import pytest
import torch
from torch import Tensor

from vg2gt.losses.gaussian import structure_loss, structure_reference


def pictures(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(2, 3, height, width, generator=generator)
    images = reference + 0.2 * torch.randn(reference.shape, generator=generator)
    images[0, :, : height // 2] = reference[0, :, : height // 2]
    images[1, 0], reference[1, 0] = 0.25, 0.25  # flat: no variance
    return images, reference


@pytest.mark.parametrize("size", [(6, 6), (6, 40), (11, 17), (23, 300)])
def test_the_compiled_loss_equals_the_plain_one(size: tuple[int, int]) -> None:
    images, reference = pictures(*size)
    found, exact = images.clone().requires_grad_(), images.double().requires_grad_()
    loss, expected = structure_loss(found, reference), structure_reference(exact, reference.double())
    assert type(loss.grad_fn).__name__ == "StructureBackward"
    torch.testing.assert_close(loss.double(), expected, rtol=1e-6, atol=1e-7)
    gradients = [torch.autograd.grad(3 * value, x)[0] for value, x in ((loss, found), (expected, exact))]
    assert (gradients[0] - gradients[1]).abs().max() < 1e-5 * gradients[1].abs().max()
