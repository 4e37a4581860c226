"""What compiled passes over voxels share: where they may run, and how threads share the voxels."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from vg2gt.io.threads import parallel_for

VOXELS_AT_ONCE = 2048


def compilable(*tensors: Tensor, dtype: torch.dtype = torch.float32) -> bool:
    """Whether all are of that type on a CPU, and ``torch.compile``, which cannot read kernels, is not tracing."""
    suits = all(tensor.device.type == "cpu" and tensor.dtype == dtype for tensor in tensors)
    return suits and not torch.compiler.is_compiling()


def over_voxels(voxels: int, run: Callable[[int, int], None]) -> None:
    """Calls ``run(first, last)`` for ranges that cover the voxels once, the same for any number of threads."""
    firsts = range(0, voxels, VOXELS_AT_ONCE)
    parallel_for(firsts, lambda first: run(first, min(first + VOXELS_AT_ONCE, voxels)))
