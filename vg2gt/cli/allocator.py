"""What the C library's allocator is told before torch is imported."""

from __future__ import annotations

import ctypes
import os
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt in glibc's malloc.h
_LARGE = 1 << 20  # bytes


def give_back_large_blocks() -> None:
    """Blocks of 1 MiB and more go back to the system when they are freed (Linux with glibc; nothing elsewhere).

    Sizes differ from step to step with the voxels of their scenes. By default glibc keeps freed blocks, into which the
    next step's do not fit, and a training's memory grows. Large pages make up for most of what fetching blocks anew
    costs. ``MALLOC_MMAP_THRESHOLD_`` and ``THP_MEM_ALLOC_ENABLE`` in the environment have the last word.
    """
    if sys.platform != "linux" or "MALLOC_MMAP_THRESHOLD_" in os.environ:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries have none
    if mallopt is None:
        return
    mallopt(_MMAP_THRESHOLD, _LARGE)
    mallopt(_TRIM_THRESHOLD, _LARGE)
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # read by torch at its first allocation
