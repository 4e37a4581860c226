"""``python -m vg2gt.cli COMMAND`` is ``vg2gt COMMAND``."""

from vg2gt.cli import main

main()
