"""Time and memory of the stages marked in a model's forward pass."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

import torch

from vg2gt.profiling import listening


@dataclass
class Passes:
    """Measurements of a stage, one number per pass.

    Attributes:
        seconds: CPU time of all cores, which other processes hardly affect; device time on a GPU.
        peak_mb: peak memory allocated on the GPU, minus that at the start of the stage; 0 on a CPU.
    """

    seconds: list[float] = field(default_factory=list)
    peak_mb: list[float] = field(default_factory=list)

    @property
    def best(self) -> float:
        """Seconds of the fastest pass."""
        return min(self.seconds)

    @property
    def memory(self) -> float:
        """Largest peak in MB."""
        return max(self.peak_mb)


class StageClock:
    """Collects measurements by stage name, from the stages of models that run inside :meth:`listening`."""

    def __init__(self, device: torch.device, now: Callable[[], float] = time.process_time) -> None:
        self.device = device
        self.now = now  # used on a CPU only
        self.stages: dict[str, Passes] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measures the block; on a GPU with CUDA events, after synchronising."""
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
        """Context in which stages marked by models are measured."""
        return listening(self.stage)
