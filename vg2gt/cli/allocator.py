"""What the C library's allocator is told before torch is imported."""

from __future__ import annotations

import ctypes
import os
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt in glibc's malloc.h
_LARGE = 8 << 20  # bytes; the features of a default run's voxels lie below
_SPARE = 64 << 20


def give_back_large_blocks() -> None:
    """Blocks of 8 MiB and more go back to the system when they are freed (Linux with glibc; nothing elsewhere).

    Sizes differ from step to step with the voxels of their scenes. By default glibc keeps freed blocks of up to 32 MiB,
    into which the next step's do not fit, and a training's memory grows. Giving back smaller ones too takes less memory
    and more time, for they are fetched again many times a step (docs/reliability.md has both measured).
    ``MALLOC_MMAP_THRESHOLD_`` and ``THP_MEM_ALLOC_ENABLE`` in the environment have the last word.
    """
    if sys.platform != "linux" or "MALLOC_MMAP_THRESHOLD_" in os.environ:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries have none
    if mallopt is None:
        return
    mallopt(_MMAP_THRESHOLD, _LARGE)
    mallopt(_TRIM_THRESHOLD, _SPARE)
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # large pages; read by torch at its first allocation
