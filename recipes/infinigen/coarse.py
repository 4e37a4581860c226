"""Runs ``infinigen_examples.generate_indoors`` on one thread, with Infinigen's arguments.

``make.py`` runs this script in Infinigen's environment.
"""

import os
import runpy
import sys

# Blender reads the number of cores once, on import.
_cores = os.sched_getaffinity(0)
os.sched_setaffinity(0, {min(_cores)})
import bpy  # noqa: E402, F401

os.sched_setaffinity(0, _cores)
if __name__ == "__main__":
    sys.path.insert(0, os.getcwd())  # contains the links to Infinigen's packages
    runpy.run_module("infinigen_examples.generate_indoors", run_name="__main__", alter_sys=True)
