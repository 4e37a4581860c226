"""Everything compiled: numba kernels for CPUs, Triton kernels for CUDA devices, and what drives them.

The references that each is tested against are plain torch in the rooms that call it. ``compiled.py`` keeps compiled
code on disk, ``threads.py`` runs it on torch's threads, ``render_cpu/`` and ``render_gpu/`` are the tile renderers.
"""
