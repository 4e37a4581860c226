"""``python -m vg2gt.curves RUN ...``: the same as ``vg2gt curves``."""

from vg2gt.cli.curves import main

if __name__ == "__main__":
    main()
