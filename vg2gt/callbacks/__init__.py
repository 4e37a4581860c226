"""Lightning callbacks of the project."""

from vg2gt.callbacks.stop_on_signal import StopOnSignal

__all__ = ["StopOnSignal"]
