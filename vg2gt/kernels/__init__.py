"""Compiled code of everything but the renderer: numba kernels for CPUs and the functions that launch them.

Each kernel is tested against a plain torch reference in the package that calls it.
"""
