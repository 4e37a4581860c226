"""Parallel loops over compiled kernels that release the interpreter's lock, on as many threads as torch uses."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

import torch

Item = TypeVar("Item")


def parallel_for(items: Sequence[Item], function: Callable[[Item], None]) -> None:
    """Calls ``function(item)`` for every item; which thread takes which is left open."""
    threads = min(torch.get_num_threads(), len(items))
    if threads <= 1:
        for item in items:
            function(item)
        return
    list(_pool(threads, os.getpid()).map(function, items))


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:  # by process: a forked child must not use its parent's
    return ThreadPoolExecutor(threads, thread_name_prefix=f"vg2gt-{process}")
