"""Lightning callbacks of the project."""

from vg2gt.callbacks.newest_checkpoints import NewestCheckpoints
from vg2gt.callbacks.stop_on_signal import StopOnSignal

__all__ = ["NewestCheckpoints", "StopOnSignal"]
