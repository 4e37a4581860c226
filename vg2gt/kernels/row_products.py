"""Linear layers over many rows by the faster of torch's two libraries."""

from __future__ import annotations

import platform

import torch
from torch import Tensor
from torch.nn import functional as F

IMAGES = 16  # fewest for which torch gives a convolution of one thread to oneDNN
MIN_ROWS = 1024  # below, calling a convolution costs more than it saves
# asked here: torch.compile traces through neither question
ONEDNN = platform.machine() in ("x86_64", "AMD64") and torch.backends.mkldnn.is_available()
ROWS_BITS = 4  # rows with more significant bits are left to MKL: oneDNN compiles and keeps code for every new number


def linear_rows(x: Tensor, weight: Tensor, bias: Tensor | None = None, relu: bool = False) -> Tensor:
    """``F.linear``, on x86 processors as a 1x1 convolution over the rows.

    torch multiplies matrices with MKL, which leaves half of some makers' vector units idle, but convolves with oneDNN,
    which uses all of them; values and input gradients then come about twice as fast, elsewhere equally fast. Only
    numbers of rows of four significant bits go that way (:func:`vg2gt.method.serialization.make_windows` makes such):
    oneDNN compiles code for every number that it has not seen, which takes longer than the product, and keeps it.

    Args:
        x: ``[..., C]``.
        weight: ``[D, C]``.
        bias: ``[D]`` or None.
        relu: applies it as well, in place.

    Returns:
        ``[..., D]``, equal to ``F.linear`` and ``F.relu`` up to the order of summation.
    """
    rows = x.numel() // max(x.shape[-1], 1)
    coarse = rows % (1 << max(rows.bit_length() - ROWS_BITS, 0)) == 0
    if rows < MIN_ROWS or not coarse or x.dtype != torch.float32 or not has_onednn(x.device):
        out = F.linear(x, weight, bias)
        return out.relu_() if relu else out
    images = x.reshape(IMAGES, -1, 1, x.shape[-1]).permute(0, 3, 1, 2)  # channels-last without moving anything
    out = F.conv2d(images, weight[..., None, None], bias)
    out = out.relu_() if relu else out
    return out.permute(0, 2, 3, 1).reshape(*x.shape[:-1], len(weight))


def has_onednn(device: torch.device) -> bool:
    """Whether convolutions there go to oneDNN on an x86 processor."""
    return device.type == "cpu" and ONEDNN
