"""Parallel loops over compiled kernels that release the interpreter's lock, on as many threads as torch uses."""

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
VOXELS_AT_ONCE = 2048  # by one thread
_Body = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


def parallel_for(items: Sequence[Item], function: Callable[[Item], None]) -> None:
    """Calls ``function(item)`` for every item; which thread takes which is left open.

    Raises:
        Exception: the first one that ``function`` raised; items that no thread had begun are left out.
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
    """Every thread of the team takes the next item until none is left."""
    waiting, failures, begun = iter(items), [], []

    def body(_: int | None) -> None:
        """What one thread does."""
        try:
            begun.append(threading.get_ident())
            for item in waiting:  # a sequence's iterator hands out every item once, under the interpreter's lock
                if failures:
                    return
                function(item)
        except BaseException as error:  # must not pass through OpenMP
            failures.append(error)

    team(_Body(body), None, threads, 0)
    if failures:
        raise failures[0]
    if threading.get_ident() not in begun:  # an interruption came as ``body`` began here, and ctypes only reports it
        raise KeyboardInterrupt


@lru_cache(maxsize=1)
def _openmp_team() -> Callable[..., None] | None:
    """OpenMP's entry point for a parallel region in the library that torch uses, or None where it has none.

    Torch's own threads wait by spinning: threads of ours would share the cores with them.
    """
    if sys.platform != "linux":
        return None
    library = Path(torch.__file__).parent / "lib" / "libtorch_cpu.so"
    try:
        parallel = ctypes.CDLL(str(library)).GOMP_parallel  # looked up in the libraries that this one needs
    except (OSError, AttributeError):
        return None
    parallel.argtypes, parallel.restype = [_Body, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint], None
    return parallel


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:  # by process: a forked child must not use its parent's
    return ThreadPoolExecutor(threads, thread_name_prefix=f"vg2gt-{process}")


def compilable(*tensors: Tensor, dtype: torch.dtype = torch.float32) -> bool:
    """Whether all are of that type on a CPU, and ``torch.compile``, which cannot read kernels, is not tracing."""
    suits = all(tensor.device.type == "cpu" and tensor.dtype == dtype for tensor in tensors)
    return suits and not torch.compiler.is_compiling()


def over_voxels(voxels: int, run: Callable[[int, int], None]) -> None:
    """Calls ``run(first, last)`` for ranges that cover the voxels once, the same for any number of threads."""
    firsts = range(0, voxels, VOXELS_AT_ONCE)
    parallel_for(firsts, lambda first: run(first, min(first + VOXELS_AT_ONCE, voxels)))
