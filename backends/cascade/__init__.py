"""Cascade plane sweep, in training: meant to replace the plane sweep once it is better (recipes/cascade)."""

from backends.cascade.backend import CascadeBackend

__all__ = ["CascadeBackend"]
