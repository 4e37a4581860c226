"""Learned plane-sweep multi-view stereo: a small frozen backbone whose weights ship with the package."""

from backends.sweep.backend import SweepBackend

__all__ = ["SweepBackend"]
