"""Depth Anything 3 as a backend."""

from backends.da3.backend import DA3Backend
from backends.da3.metric import DA3MetricBackend, DA3NestedBackend

__all__ = ["DA3Backend", "DA3MetricBackend", "DA3NestedBackend"]
