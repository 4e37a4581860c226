"""One-line messages instead of tracebacks for errors that the user can fix."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf.errors import OmegaConfBaseException

USER_ERRORS = (ValueError, OSError, ImportError, ArithmeticError, MemoryError, HydraException, OmegaConfBaseException)
_TRACEBACK = "HYDRA_FULL_ERROR"


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Ends the process with the message of a user error; ``HYDRA_FULL_ERROR=1`` shows the traceback.

    In a sweep, errors are raised instead, so that the sweep continues.
    """
    try:
        yield
    except KeyboardInterrupt:
        if os.environ.get(_TRACEBACK):
            raise
        print("interrupted", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    except Exception as error:
        if os.environ.get(_TRACEBACK) or _in_a_sweep() or not isinstance(error, USER_ERRORS):
            raise
        # Hydra wraps errors of constructors: show the original one
        cause = error.__cause__ or error if isinstance(error, InstantiationException) else error
        said = str(cause)
        if isinstance(cause, OSError) and cause.strerror:
            said = f"{cause.filename}: {cause.strerror}" if cause.filename else cause.strerror
        if isinstance(cause, TypeError) and HydraConfig.initialized():
            said += f"; is a value of the wrong type? The overrides are: {' '.join(HydraConfig.get().overrides.task)}"
        if sys.stderr.isatty():
            print(file=sys.stderr)  # ends a progress bar that was interrupted
        sys.exit(f"{type(cause).__name__}: {' '.join(said.split())} ({_TRACEBACK}=1 shows where)")


def refuse_ranks_in_a_sweep(devices: str) -> None:
    """Refuses several devices in a sweep: ranks repeat the command line, which would start the whole sweep."""
    if _in_a_sweep() and devices != "1" and "LOCAL_RANK" not in os.environ and "SLURM_PROCID" not in os.environ:
        raise ValueError(f"trainer.devices={devices} in a sweep (-m): run its jobs one by one, or with one device each")


def _in_a_sweep() -> bool:
    """Whether this is a job of a sweep (``-m``)."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
