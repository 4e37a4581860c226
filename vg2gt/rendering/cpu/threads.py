"""Parallel loops over compiled kernels that release the interpreter's lock, on as many threads as torch uses."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch


def parallel_for(count: int, function: Callable[[int], None]) -> None:
    """Calls ``function(index)`` for every index below ``count``; which thread takes which is left open."""
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        for index in range(count):
            function(index)
        return
    list(_pool(threads, os.getpid()).map(function, range(count)))


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:  # by process: a forked child must not use its parent's
    return ThreadPoolExecutor(threads, thread_name_prefix=f"vg2gt-render-{process}")
