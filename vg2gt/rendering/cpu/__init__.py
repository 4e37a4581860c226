"""The renderer compiled for CPUs: tiles, vectorised rows, analytic gradients; bitwise deterministic."""

from vg2gt.rendering.cpu.function import rasterize_cpu

__all__ = ["rasterize_cpu"]
