"""Numba kernels of the tile renderer for CPUs, driven by :mod:`vg2gt.rendering.cpu_tiles`."""
