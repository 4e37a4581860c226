"""Precision policy of training, evaluation and reconstruction: networks in bfloat16 on a GPU, all else in float32.

TF32 stays off for matrix products: it is a switch for the whole process, and would round those of geometry. cuDNN's
convolutions in float32, such as those of the depth heads, use it: torch's default. If a new torch changes that, set
``torch.backends.cudnn.allow_tf32``.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn


class Float32Linear(nn.Linear):
    """A linear layer whose weights its owner reads: they stay float32 (:mod:`vg2gt.training.casts`)."""


def half_precision_on_gpu(like: Tensor) -> torch.autocast:
    """Returns a context with bfloat16 autocast if ``like`` is on a GPU, and with autocast off otherwise."""
    return torch.autocast(like.device.type, torch.bfloat16, enabled=like.is_cuda)


def full_precision(like: Tensor) -> AbstractContextManager[object]:
    """Returns a context with autocast off on the device of ``like``; a null context if it is off already."""
    device = like.device.type
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


def autocast_dtype(like: Tensor) -> torch.dtype:
    """Returns the dtype of networks on the device of ``like``: that of autocast, or float32 without autocast."""
    device = like.device.type
    return torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else torch.float32


def trainer_precision(asked: str, accelerator: str) -> str:
    """Returns Lightning's name of ``trainer.precision``: ``auto`` is bfloat16 networks on a GPU, float32 on a CPU."""
    return asked if asked != "auto" else "bf16-mixed" if accelerator in ("gpu", "cuda") else "32-true"
