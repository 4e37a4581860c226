"""``python -m vg2gt.evaluate``, the same as ``vg2gt evaluate``."""

from vg2gt.cli.evaluate import main

if __name__ == "__main__":
    main()
