"""Communication between the processes of a run, other than gradients."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from typing import Any, TypeVar

import lightning
import torch.distributed

Key = TypeVar("Key")
Value = TypeVar("Value")


def world_size() -> int:
    """Returns the number of processes in the process group; 1 without one."""
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return 1
    return torch.distributed.get_world_size()


def all_gather_object(value: Value) -> list[Value]:
    """Returns the values of all ranks, in rank order. Collective: every rank must call it."""
    if world_size() == 1:
        return [value]
    found: list[Any] = [None] * world_size()
    torch.distributed.all_gather_object(found, value)
    return found


def interleave(parts: Sequence[Mapping[Key, Value]]) -> dict[Key, Value]:
    """Merges the ranks' mappings in round-robin order; a repeated key keeps its first value."""
    joined: dict[Key, Value] = {}
    for row in zip_longest(*parts):
        for key, part in zip(row, parts, strict=True):
            if key is not None:
                joined.setdefault(key, part[key])
    return joined


@contextmanager
def ending_together(trainer: lightning.Trainer) -> Iterator[None]:
    """Kills the ranks that this process launched if the block raises, as they would wait forever.

    Raises:
        ChildProcessError: if a data loading process was killed.
    """
    try:
        yield
    except BaseException as error:
        if trainer.strategy.launcher is not None:
            trainer.strategy.launcher.kill(signal.SIGKILL)
        if isinstance(error, RuntimeError) and "DataLoader worker" in str(error):
            raise ChildProcessError(
                "a data loading process was killed, often because memory is full (reduce data.workers or "
                f"data.memory_mb): {str(error).splitlines()[0]}; resume with the same command and ckpt=last"
            ) from error
        raise
