"""Image similarity."""

from __future__ import annotations

import kornia.metrics
from torch import Tensor

SSIM_WINDOW = 11  # kornia's Gaussian window has a standard deviation of 1.5 pixels


def psnr(predicted: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB of each image, colours clamped to [0, 1].

    Args:
        predicted: ``[..., 3, H, W]``.
        reference: ``[..., 3, H, W]``.

    Returns:
        ``[...]``; infinite for identical images.
    """
    difference = predicted.double().clamp(0, 1) - reference.double().clamp(0, 1)
    return -10 * difference.square().mean((-3, -2, -1)).log10()


def ssim(predicted: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity of each image (Gaussian window 11 x 11, sigma 1.5, range 1, no padding), clamped to [0, 1].

    Args:
        predicted: ``[..., 3, H, W]``, at least 11 pixels high and wide.
        reference: ``[..., 3, H, W]``.

    Returns:
        ``[...]``.
    """
    size = predicted.shape[-3:]
    first, second = (image.float().clamp(0, 1).reshape(-1, *size) for image in (predicted, reference))
    values = kornia.metrics.ssim(first, second, SSIM_WINDOW, padding="valid")
    return values.mean((-3, -2, -1)).reshape(predicted.shape[:-3])
