"""Runs ``infinigen_examples.generate_indoors`` on one thread; the arguments are Infinigen's.

Run by ``make.py`` in Infinigen's environment.
"""

import os
import runpy
import sys

# Blender asks once, when it is imported, how many cores there are.
_cores = os.sched_getaffinity(0)
os.sched_setaffinity(0, {min(_cores)})
import bpy  # noqa: E402, F401

os.sched_setaffinity(0, _cores)
if __name__ == "__main__":
    sys.path.insert(0, os.getcwd())  # where the links to Infinigen's packages are
    runpy.run_module("infinigen_examples.generate_indoors", run_name="__main__", alter_sys=True)
