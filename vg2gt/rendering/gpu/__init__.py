"""The renderer for CUDA devices: all views of all scenes in one sequence of six kernels, no atomics; deterministic.

Needs the package ``triton``, which comes with torch's CUDA builds.
"""

from vg2gt.rendering.gpu.function import RefusedError, render_triton

__all__ = ["RefusedError", "render_triton"]
