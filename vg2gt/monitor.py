"""Progress, time and memory of a command's stages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from vg2gt.profiling import listening, now, peak_memory_mib, reset_peak_memory

_LABELS = {
    "encode": "backbone",
    "decode": "decode geometry",
    "coarse": "enhance tokens",
    "decode_again": "decode geometry",
    "fine": "fine voxels",
    "gaussians": "Gaussians",
}


class Monitor:
    """Measures stages and optionally shows them as progress bars.

    Args:
        show: draw progress bars on the standard error stream.
        device: device to synchronise with and to measure the memory of.
        watch: called after every step of a refinement with a function that returns the current Gaussians and cameras
            (:class:`vg2gt.viewer.live.LiveView`); None: nobody watches.

    Attributes:
        seconds: wall time by stage, in the order of their first start. Repeated stages add up; the time of a nested
            stage counts for the inner stage only.
    """

    def __init__(
        self, show: bool = False, device: torch.device | str = "cpu", watch: Callable[..., None] | None = None
    ) -> None:
        self.device, self.watch = torch.device(device), watch
        self.seconds: dict[str, float] = {}
        self._progress = Progress(
            TextColumn("{task.description:<24}"),
            BarColumn(24),
            TextColumn("{task.completed:.0f}{task.fields[unit]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=not show,
        )
        self._running: list[str] = []
        self._since = 0.0

    def __enter__(self) -> Monitor:
        reset_peak_memory(self.device)
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    @property
    def peak_memory_mib(self) -> float:
        """Peak memory so far: of the GPU since this monitor began, or of the whole process on a CPU."""
        return peak_memory_mib(self.device)

    @contextmanager
    def stage(self, name: str, total: int = 1, unit: str = "") -> Iterator[Callable[..., None]]:
        """Measures the block; ``unit`` is shown after the number of steps, by default their total.

        Yields:
            A function to call after each of ``total`` steps, or with the number of steps done and a note to show.
        """
        self._settle()
        self._running.append(name)
        self.seconds.setdefault(name, 0.0)
        task = self._progress.add_task(name, total=total, unit=unit or f"/{total}")

        def advance(done: float | None = None, note: str = "") -> None:
            if done is None:
                self._progress.update(task, advance=1)
            else:
                self._progress.update(task, completed=round(done), description=f"{name} {note}")

        try:
            yield advance
            self._progress.update(task, completed=total, description=name)
        finally:
            self._settle()
            self._running.pop()

    def _settle(self) -> None:
        """Adds the time since the last change of stage to the stage that was running."""
        moment = now(self.device)
        if self._running:
            self.seconds[self._running[-1]] += moment - self._since
        self._since = moment

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Reports the stages that a model marks inside the block as stages of this monitor."""

        @contextmanager
        def labelled(name: str) -> Iterator[None]:
            with self.stage(_LABELS.get(name, name)):
                yield

        with listening(labelled):
            yield
