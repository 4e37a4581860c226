"""Datasets as plug-ins: each is a loader and a YAML file; the package is not changed.

``python train.py --config-dir examples/data_sets/configs data=tum data.root=FOLDER`` trains on TUM RGB-D. To add a
dataset, write a class like these in an importable module, and a YAML file that names it.
"""
