"""Lightning callbacks of the project."""

from vg2gt.training.callbacks.newest_checkpoints import NewestCheckpoints
from vg2gt.training.callbacks.stop_on_signal import StopOnSignal

__all__ = ["NewestCheckpoints", "StopOnSignal"]
