"""Trains VG²GT: ``python train.py [group=option ...] [key=value ...]``; ``python train.py -h`` lists the groups."""

from vg2gt.cli.train import main

if __name__ == "__main__":
    main()
