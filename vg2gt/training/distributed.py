"""What several processes of a run tell each other, beside gradients."""

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
    """Joins the parts of ranks that took turns: the first of every rank, then the second of every rank.

    A key that several ranks hold keeps its first place and value.
    """
    joined: dict[Key, Value] = {}
    for row in zip_longest(*parts):
        for key, part in zip(row, parts, strict=True):
            if key is not None:
                joined.setdefault(key, part[key])
    return joined


@contextmanager
def ending_together(trainer: lightning.Trainer) -> Iterator[None]:
    """Ends the ranks that this process started if it fails itself: they would wait for it in vain.

    The other way round Lightning watches them, and whoever starts ranks on several machines watches all.
    """
    try:
        yield
    except BaseException:
        if trainer.strategy.launcher is not None:
            trainer.strategy.launcher.kill(signal.SIGKILL)
        raise
