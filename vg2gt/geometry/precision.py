"""One policy of precision, of training, evaluation and reconstruction: networks in bfloat16 on a GPU, all else float32.

TF32 stays off: it is one switch for the whole process, and would round the matrices that geometry is made of.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor


def half_precision_on_gpu(like: Tensor) -> torch.autocast:
    """A context with bfloat16 autocast if ``like`` is on a GPU, and with autocast off on a CPU."""
    return torch.autocast(like.device.type, torch.bfloat16, enabled=like.is_cuda)


def full_precision(like: Tensor) -> AbstractContextManager[object]:
    """A context in which autocast is off on the device of ``like``; nothing at all where it already is."""
    device = like.device.type
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


def autocast_dtype(like: Tensor) -> torch.dtype:
    """What networks compute in where ``like`` is: the autocast's type, or float32 without one."""
    device = like.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32


def trainer_precision(asked: str, accelerator: str) -> str:
    """Lightning's name of ``trainer.precision``: ``auto`` is bfloat16 networks on a GPU and float32 on a CPU."""
    return asked if asked != "auto" else "bf16-mixed" if accelerator in ("gpu", "cuda") else "32-true"
