"""``python -m vg2gt.ablate [key=value ...]``: the same as ``vg2gt ablate``."""

from vg2gt.cli.ablate import main

if __name__ == "__main__":
    main()
