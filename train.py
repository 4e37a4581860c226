"""Trains VG²GT: ``python train.py [group=option ...] [key=value ...]``; ``python train.py -h`` lists the groups."""

from vg2gt.cli.allocator import start_with_mimalloc
from vg2gt.cli.leaving import run_and_leave

if __name__ == "__main__":
    start_with_mimalloc()
    from vg2gt.cli.train import main

    run_and_leave(main)
