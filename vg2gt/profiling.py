"""Stage markers for torch's profiler and for listeners; wall time and peak memory."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from torch.profiler import record_function

_MIB = 2**20
_BEFORE_HEAD = ("encode", "decode", "coarse", "decode_again")

Listener = Callable[[str], AbstractContextManager[None]]
_listeners: ContextVar[tuple[Listener, ...]] = ContextVar("listeners", default=())


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Marks a stage: torch's profiler shows it as ``vg2gt/<name>``, and listeners run around it."""
    with ExitStack() as stack:
        stack.enter_context(record_function(f"vg2gt/{name}"))
        for listener in _listeners.get():
            stack.enter_context(listener(name))
        yield


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Wraps every stage inside the block in ``listener(name)``."""
    token = _listeners.set((*_listeners.get(), listener))
    try:
        yield
    finally:
        _listeners.reset(token)


@dataclass
class Clock:
    """Wall time of a reconstruction in seconds: ``total``, and ``before_head`` for the stages in ``_BEFORE_HEAD``."""

    total: float = 0.0
    before_head: float = 0.0

    @property
    def head(self) -> float:
        """Time from tokens and geometry to Gaussians, the paper's decoding-head time."""
        return self.total - self.before_head


@contextmanager
def clocked(device: torch.device) -> Iterator[Clock]:
    """Times one forward pass inside the block; synchronises with the device at both ends of every stage."""
    clock = Clock()

    @contextmanager
    def listener(name: str) -> Iterator[None]:
        begin = now(device)
        yield
        if name in _BEFORE_HEAD:
            clock.before_head += now(device) - begin

    begin = now(device)
    with listening(listener):
        yield clock
    clock.total = now(device) - begin


def now(device: torch.device) -> float:
    """Returns seconds on a monotonic clock, after synchronising with the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def reset_peak_memory(device: torch.device) -> None:
    """Resets the peak on a GPU; the peak of a process cannot be reset."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_memory_mib(device: torch.device) -> float:
    """Returns peak MiB: allocated on the GPU since the reset, or resident in the process; 0 if unknown (Windows)."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / _MIB
    try:
        import resource
    except ImportError:
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / _MIB if sys.platform == "darwin" else peak / 1024
