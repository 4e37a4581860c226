"""What compiled passes over voxels share: where they may run, and how threads share the voxels."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from vg2gt.io.threads import parallel_for

VOXELS_AT_ONCE = 2048


def compilable(*tensors: Tensor) -> bool:
    """Whether all are float32 on a CPU: kernels are compiled for nothing else."""
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


def over_voxels(voxels: int, run: Callable[[int, int], None]) -> None:
    """Calls ``run(first, last)`` for ranges that cover the voxels once, the same for any number of threads."""
    firsts = range(0, voxels, VOXELS_AT_ONCE)
    parallel_for(firsts, lambda first: run(first, min(first + VOXELS_AT_ONCE, voxels)))
