"""The compiled structural dissimilarity against kornia's."""

import pytest
import torch
from torch import Tensor

from vg2gt.losses.structure import structure_loss, structure_reference


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
    assert type(loss.grad_fn).__name__ == "_StructureBackward"
    torch.testing.assert_close(loss.double(), expected, rtol=1e-6, atol=1e-7)
    gradients = [torch.autograd.grad(3 * value, x)[0] for value, x in ((loss, found), (expected, exact))]
    assert (gradients[0] - gradients[1]).abs().max() < 1e-5 * gradients[1].abs().max()


def test_threads_change_nothing() -> None:
    images, reference = pictures(30, 44)
    results, threads = [], torch.get_num_threads()
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            found = images.clone().requires_grad_()
            loss = structure_loss(found, reference)
            results.append((loss.detach(), *torch.autograd.grad(loss, found)))
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        assert all(torch.equal(*pair) for pair in zip(result, results[0], strict=True))


def test_plain_where_it_must_be() -> None:
    """In float64, and where the reference asks for a gradient too."""
    images, reference = pictures(12, 12)
    assert "_Structure" not in str(structure_loss(images.double().requires_grad_(), reference.double()).grad_fn)
    reference.requires_grad_()
    (gradient,) = torch.autograd.grad(structure_loss(images, reference), reference)
    assert gradient.any()
