"""How many processes load data for one that trains on a GPU."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

MOST = 16  # more wait for the disk
PREFETCHED = 2  # batches that a process has ready: torch's default
PROCESS_MB = 600  # of a loader process, without its decoded frames
SHARED_MEMORY = Path("/dev/shm")  # through which batches reach the trainer


def automatic_workers(ranks: int, memory_mb: int, batch_mb: float) -> int:
    """Loader processes of each of this machine's ranks: a core each but one, as far as memory goes.

    Args:
        ranks: processes that train on this machine.
        memory_mb: decoded frames that each loader process keeps.
        batch_mb: the size of a batch.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limits = [MOST, cores // ranks - 1]
    if hasattr(os, "sysconf"):
        half = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2e6
        limits.append(int(half / ranks / (memory_mb + PROCESS_MB + PREFETCHED * batch_mb)))
    if SHARED_MEMORY.is_dir():  # small in containers: beyond it a process ends by a bus error
        free = shutil.disk_usage(SHARED_MEMORY).free / 1e6
        limits.append(int(free / ranks / (2 * PREFETCHED * batch_mb)))  # half of it: for training and for evaluation
    return max(0, min(limits))
