"""The renderer for CUDA devices: tiles of 8 x 8 pixels, one warp each, no atomics; deterministic.

Needs the package ``triton``, which comes with torch's CUDA builds.
"""

from vg2gt.rendering.gpu.function import rasterize_triton

__all__ = ["rasterize_triton"]
