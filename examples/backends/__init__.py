"""Published networks as plug-in backends; the package is not changed.

``vg2gt evaluate --config-dir examples/backends/configs backend=itermvs backend.path=FILE ...`` runs IterMVS.
"""
