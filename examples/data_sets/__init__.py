"""Data sets as plug-ins: a loader and a YAML each, without a change to the package.

``python train.py --config-dir examples/data_sets/configs data=tum data.root=FOLDER`` trains on TUM RGB-D. To add a data
set, write a class like one of these in a module that Python finds, and a YAML that names it.
"""
