"""Time and memory of the stages that a model marks in its forward pass."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

import torch

from vg2gt.profiling import listening


@dataclass
class Passes:
    """What a stage took, one number per pass.

    Attributes:
        seconds: of all cores on a CPU (other processes hardly matter), of the device on a GPU.
        peak_mb: allocated on the GPU above what was there when the stage began; 0 on a CPU.
    """

    seconds: list[float] = field(default_factory=list)
    peak_mb: list[float] = field(default_factory=list)

    @property
    def best(self) -> float:
        """The fastest pass."""
        return min(self.seconds)

    @property
    def memory(self) -> float:
        """The largest peak."""
        return max(self.peak_mb)


class StageClock:
    """Collects stages by name; the model's marks report to it inside :meth:`listening`."""

    def __init__(self, device: torch.device, now: Callable[[], float] = time.process_time) -> None:
        self.device = device
        self.now = now  # on a CPU
        self.stages: dict[str, Passes] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measures what happens inside the block; on a GPU with events, after the device has done what came before."""
        passes = self.stages.setdefault(name, Passes())
        if self.device.type != "cuda":
            begin = self.now()
            yield
            passes.seconds.append(self.now() - begin)
            passes.peak_mb.append(0.0)
            return
        torch.cuda.synchronize(self.device)
        torch.cuda.reset_peak_memory_stats(self.device)
        before = torch.cuda.memory_allocated(self.device)
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        stream = torch.cuda.current_stream(self.device)
        begin.record(stream)
        yield
        end.record(stream)
        torch.cuda.synchronize(self.device)
        passes.seconds.append(begin.elapsed_time(end) / 1e3)
        passes.peak_mb.append((torch.cuda.max_memory_allocated(self.device) - before) / 1e6)

    def listening(self) -> AbstractContextManager[None]:
        """Takes the marks of the models inside the block."""
        return listening(self.stage)
