"""Linear layers over many rows, by the faster of MKL and oneDNN."""

from __future__ import annotations

import platform

import torch
from torch import Tensor
from torch.nn import functional as F

IMAGES = 16  # smallest batch for which torch passes a single-threaded convolution to oneDNN
MIN_ROWS = 1024  # below, calling a convolution costs more than it saves
# evaluated at import: torch.compile can trace neither call
ONEDNN = platform.machine() in ("x86_64", "AMD64") and torch.backends.mkldnn.is_available()
ROWS_BITS = 4  # row counts with more significant bits go to MKL: oneDNN compiles and keeps code for every new count


def linear_rows(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    """``F.linear``, on x86 processors as a 1x1 convolution over the rows.

    torch multiplies matrices with MKL, which leaves half of the vector units idle on some processors. It convolves with
    oneDNN, which uses all of them: values and input gradients are then about twice as fast there, and equally fast
    elsewhere. oneDNN compiles code for every new row count, which takes longer than the product, and keeps it. So only
    row counts with at most four significant bits use it (:func:`vg2gt.method.serialization.make_windows` makes such).

    Args:
        x: ``[..., C]``.
        weight: ``[D, C]``.
        bias: ``[D]`` or None.
        relu: whether to apply a ReLU to the result, in place.

    Returns:
        ``[..., D]``, equal to ``F.linear`` and ``F.relu`` up to the order of summation.
    """
    rows = x.numel() // max(x.shape[-1], 1)
    coarse = rows % (1 << max(rows.bit_length() - ROWS_BITS, 0)) == 0
    if rows < MIN_ROWS or not coarse or x.dtype != torch.float32 or not has_onednn(x.device):
        out = F.linear(x, weight, bias)
        return out.relu_() if relu else out
    images = x.reshape(IMAGES, -1, 1, x.shape[-1]).permute(0, 3, 1, 2)  # channels-last without a copy
    out = F.conv2d(images, weight[..., None, None], bias)
    out = out.relu_() if relu else out
    return out.permute(0, 2, 3, 1).reshape(*x.shape[:-1], len(weight))


def has_onednn(device: torch.device) -> bool:
    """Whether the device is an x86 CPU on which convolutions use oneDNN."""
    return device.type == "cpu" and ONEDNN
