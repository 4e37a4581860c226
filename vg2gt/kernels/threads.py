"""Parallel loops over compiled kernels that release the GIL, on as many threads as torch uses."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

Item = TypeVar("Item")
_VOXELS_AT_ONCE = 2048  # voxels per work item
_Body = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


def parallel_for(items: Sequence[Item], function: Callable[[Item], None]) -> None:
    """Calls ``function(item)`` for every item, in any order and on any thread.

    Raises:
        Exception: the first one raised by ``function``; items that have not started are skipped.
    """
    threads = min(torch.get_num_threads(), len(items))
    team = _openmp_team()
    if threads <= 1:
        for item in items:
            function(item)
    elif team is None:
        list(_pool(threads, os.getpid()).map(function, items))
    else:
        _on_team(team, threads, items, function)


def _on_team(team: Callable[..., None], threads: int, items: Sequence[Item], function: Callable[[Item], None]) -> None:
    """Runs the loop on an OpenMP team: every thread takes the next item until none is left."""
    waiting, failures, begun = iter(items), [], []

    def body(_: int | None) -> None:
        """Runs on each thread of the team."""
        try:
            begun.append(threading.get_ident())
            for item in waiting:  # under the GIL a sequence's iterator yields every item once
                if failures:
                    return
                function(item)
        except BaseException as error:  # must not propagate through OpenMP
            failures.append(error)

    team(_Body(body), None, threads, 0)
    if failures:
        raise failures[0]
    if threading.get_ident() not in begun:  # Ctrl-C arrived here before ``body`` began, and ctypes only prints it
        raise KeyboardInterrupt


@lru_cache(maxsize=1)
def _openmp_team() -> Callable[..., None] | None:
    """Returns ``GOMP_parallel`` of the OpenMP library that torch uses, or None if it has none.

    torch's threads spin while they wait: separate threads would compete with them for the cores. If a new torch ships
    no ``GOMP_parallel``, this returns None and a pool of threads takes over: slower, with the same results.
    """
    if sys.platform != "linux":
        return None
    library = Path(torch.__file__).parent / "lib" / "libtorch_cpu.so"
    try:
        parallel = ctypes.CDLL(str(library)).GOMP_parallel  # resolved in the library's dependencies
    except (OSError, AttributeError):
        return None
    parallel.argtypes, parallel.restype = [_Body, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint], None
    return parallel


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:  # per process: a forked child must not use its parent's
    return ThreadPoolExecutor(threads, thread_name_prefix=f"vg2gt-{process}")


def compilable(*tensors: Tensor) -> bool:
    """Whether compiled kernels can process all tensors: whether they are float32 on a CPU."""
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


def over_voxels(voxels: int, run: Callable[[int, int], None]) -> None:
    """Calls ``run(first, last)`` for ranges that cover all voxels once and do not depend on the number of threads."""
    firsts = range(0, voxels, _VOXELS_AT_ONCE)
    parallel_for(firsts, lambda first: run(first, min(first + _VOXELS_AT_ONCE, voxels)))
