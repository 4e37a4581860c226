"""Structural dissimilarity ``1 - SSIM`` (Wang et al., 2004): plain, and compiled for CPUs."""

from __future__ import annotations

import torch
from kornia.metrics import ssim
from torch import Tensor

from vg2gt.kernels.structure import HALF, WINDOW, Structure


def structure_loss(images: Tensor, reference: Tensor) -> Tensor:
    """Returns the mean of ``1 - SSIM`` (paper, eqn gsloss): 11 x 11 Gaussian window, sigma 1.5, reflected borders.

    Args:
        images: ``[R, C, H, W]``, at least 6 pixels high and wide.
        reference: ``[R, C, H, W]``, of the same dtype.

    Returns:
        A scalar, differentiable in the images. Compiled if both are float32 on a CPU and the reference has no gradient.
    """
    on_cpu = all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in (images, reference))
    if on_cpu and not reference.requires_grad and min(images.shape[-2:]) > HALF:
        return Structure.apply(images, reference)  # pyright: ignore[reportReturnType]
    return structure_reference(images, reference)


def structure_reference(images: Tensor, reference: Tensor) -> Tensor:
    """:func:`structure_loss` with kornia, for any device; also differentiable in the reference."""
    return (1 - ssim(images, reference, WINDOW)).mean()
