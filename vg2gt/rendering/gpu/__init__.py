"""Triton kernels of the tile renderer for CUDA devices, driven by :mod:`vg2gt.rendering.gpu_tiles`."""
