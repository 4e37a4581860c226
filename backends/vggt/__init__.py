"""VGGT behind the backend interface."""

from backends.vggt.network import VGGTBackend

__all__ = ["VGGTBackend"]
