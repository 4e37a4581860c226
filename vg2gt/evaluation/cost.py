"""Time and memory of a reconstruction."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import nn

from vg2gt.model import Reconstructor

Result = TypeVar("Result")
MIB = 2**20


@dataclass
class Clock:
    """Wall time of parts of a reconstruction, in seconds.

    Attributes:
        total: the whole pass.
        before_head: the backbone, its decoding and the coarse enhancement.
    """

    total: float = 0.0
    before_head: float = 0.0

    @property
    def head(self) -> float:
        """What makes Gaussians of tokens and geometry: the paper's decoding-head time."""
        return self.total - self.before_head


@contextmanager
def clocked(model: Reconstructor, device: torch.device) -> Iterator[Clock]:
    """Measures one pass of the model inside the block, waiting for the device at the ends of every part."""
    clock = Clock()
    backend: Any = model.backend
    coarse = getattr(model, "coarse", None)

    def timed(function: Callable[..., Result]) -> Callable[..., Result]:
        def call(*args: Any, **kwargs: Any) -> Result:
            begin = now(device)
            result = function(*args, **kwargs)
            clock.before_head += now(device) - begin
            return result

        return call

    parts = [(backend, "encode"), (backend, "decode")]
    if isinstance(coarse, nn.Module):
        parts.append((coarse, "forward"))
    own = [vars(owner).get(name) for owner, name in parts]
    for owner, name in parts:
        setattr(owner, name, timed(getattr(owner, name)))
    begin = now(device)
    try:
        yield clock
        clock.total = now(device) - begin
    finally:
        for (owner, name), before in zip(parts, own, strict=True):
            if before is None:
                delattr(owner, name)  # the class's own shows again
            else:
                setattr(owner, name, before)


def now(device: torch.device) -> float:
    """Seconds on a steady clock, once the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def reset_peak_memory(device: torch.device) -> None:
    """Begins a new measurement on a GPU; a process's own peak cannot be reset."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_memory_mib(device: torch.device) -> float:
    """Peak memory in MiB: allocated on the GPU since the last reset, or resident in the process since its start."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / MIB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / MIB if sys.platform == "darwin" else peak / 1024
