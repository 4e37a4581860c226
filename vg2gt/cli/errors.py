"""How a command ends when the user can mend what went wrong."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode

from vg2gt.memory import OutOfMemory

USER_ERRORS = (ValueError, OSError, ImportError, ArithmeticError, OutOfMemory)
TRACEBACK = "HYDRA_FULL_ERROR"


@contextmanager
def said_in_one_line() -> Iterator[None]:
    """Ends the process with the message of an error instead of its traceback.

    ``HYDRA_FULL_ERROR=1`` shows the traceback. In a sweep errors are left to Hydra, which runs the other jobs first.
    """
    try:
        yield
    except (InstantiationException, *USER_ERRORS) as error:
        if os.environ.get(TRACEBACK) or in_a_sweep():
            raise
        # A constructor's own error is the cause of Hydra's.
        cause = error.__cause__ or error if isinstance(error, InstantiationException) else error
        # The line break ends a progress bar that was interrupted.
        sys.exit(f"\n{type(cause).__name__}: {cause}\n({TRACEBACK}=1 shows where)")


def in_a_sweep() -> bool:
    """Whether this is a job of a sweep (``-m``)."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
