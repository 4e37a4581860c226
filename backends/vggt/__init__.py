"""VGGT behind the backend interface."""

from backends.vggt.backend import VGGTBackend

__all__ = ["VGGTBackend"]
