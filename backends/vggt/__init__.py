"""VGGT as a backend."""

from backends.vggt.network import VGGTBackend

__all__ = ["VGGTBackend"]
