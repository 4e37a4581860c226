"""Compiled code: numba kernels for CPUs, Triton kernels for CUDA devices, and the functions that launch them.

Each kernel is tested against a plain torch reference in the package that calls it.
"""
