"""Everything compiled: numba kernels for CPUs, Triton kernels for CUDA devices, and what drives them.

The references that each is tested against are plain torch in the rooms that call it.
"""
