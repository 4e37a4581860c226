"""What several processes of a run tell each other, besides gradients."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from typing import Any, TypeVar

import lightning
import torch.distributed

_CONNECTION_LOST = ("onnection closed by peer", "onnection reset by peer", "Broken pipe", "NCCL", "Gloo", "gloo")

Key = TypeVar("Key")
Value = TypeVar("Value")


def world_size() -> int:
    """Number of processes that train together."""
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return 1
    return torch.distributed.get_world_size()


def all_gather_object(value: Value) -> list[Value]:
    """The value of every rank, in their order. Collective: every rank has to call it."""
    if world_size() == 1:
        return [value]
    found: list[Any] = [None] * world_size()
    torch.distributed.all_gather_object(found, value)
    return found


def interleave(parts: Sequence[Mapping[Key, Value]]) -> dict[Key, Value]:
    """Joins mappings of ranks that took turns, first entries first; a repeated key keeps its first value."""
    joined: dict[Key, Value] = {}
    for row in zip_longest(*parts):
        for key, part in zip(row, parts, strict=True):
            if key is not None:
                joined.setdefault(key, part[key])
    return joined


@contextmanager
def ending_together(trainer: lightning.Trainer) -> Iterator[None]:
    """Ends the ranks that this process started if it fails itself: they would wait forever.

    Raises:
        ChildProcessError: if this process failed because another one of the run has ended: a rank, or one that loads
            data.
    """
    try:
        yield
    except BaseException as error:
        launcher = trainer.strategy.launcher
        lost = _lost_process(error, trainer.world_size, getattr(launcher, "procs", ()))
        if launcher is not None:
            launcher.kill(signal.SIGKILL)
        if lost:
            raise ChildProcessError(f"{lost}; start the same command with ckpt=last to go on") from error
        raise


def _lost_process(error: BaseException, ranks: int, started: Sequence[subprocess.Popen[bytes]]) -> str | None:
    """Which process of the run has ended, if that is what an error says."""
    if not isinstance(error, RuntimeError):
        return None
    if "DataLoader worker" in str(error):
        return (
            "a process that loads data was killed, often because memory is full (fewer data.workers, less "
            f"data.memory_mb): {str(error).splitlines()[0]}"
        )
    if ranks == 1 or not any(said in str(error) for said in _CONNECTION_LOST):
        return None
    ended = [f"rank {rank} has ended with status {code}" for rank, code in _statuses(started) if code is not None]
    return ", ".join(ended) or f"another of the {ranks} processes of this run has ended"


def _statuses(started: Sequence[subprocess.Popen[bytes]]) -> Iterator[tuple[int, int | None]]:
    """Local ranks that this process started, and how they ended; their death may be a moment old."""
    deadline = time.monotonic() + 2
    while time.monotonic() < deadline and started and all(process.poll() is None for process in started):
        time.sleep(0.05)
    return ((number + 1, process.poll()) for number, process in enumerate(started))
