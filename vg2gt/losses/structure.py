"""Structural dissimilarity of images, ``1 - SSIM`` (Wang et al., 2004): plain, and compiled for CPUs."""

from __future__ import annotations

import torch
from kornia.metrics import ssim
from torch import Tensor

from vg2gt.kernels.structure import HALF, WINDOW, Structure


def structure_loss(images: Tensor, reference: Tensor) -> Tensor:
    """Mean of ``1 - SSIM`` over all pixels (paper, eqn gsloss): Gaussian window 11 x 11, sigma 1.5, borders reflected.

    Args:
        images: ``[R, C, H, W]``, at least 6 pixels high and wide.
        reference: ``[R, C, H, W]``, of the same dtype.

    Returns:
        A scalar, differentiable in the images; compiled where both are float32 on a CPU and the reference is fixed.
    """
    on_cpu = all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in (images, reference))
    if on_cpu and not reference.requires_grad and min(images.shape[-2:]) > HALF:
        return Structure.apply(images, reference)  # pyright: ignore[reportReturnType]
    return structure_reference(images, reference)


def structure_reference(images: Tensor, reference: Tensor) -> Tensor:
    """:func:`structure_loss` by kornia, for any device and with gradients of the reference as well."""
    return (1 - ssim(images, reference, WINDOW)).mean()
