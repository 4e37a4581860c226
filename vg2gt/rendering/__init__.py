"""Rendering Gaussians as continuous stochastic solids, or by classic rasterisation."""

from vg2gt.rendering.renderer import Renderer, UnrenderableError, render

__all__ = ["Renderer", "UnrenderableError", "render"]
