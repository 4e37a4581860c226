"""``python -m vg2gt.data.synthetic``, the same as ``vg2gt data synthetic``."""

import runpy
import sys

sys.argv[1:1] = ["synthetic"]
runpy.run_module("vg2gt.cli.data", run_name="__main__")
