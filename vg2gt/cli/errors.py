"""How a command ends when the user can mend what went wrong: with one line, the same way for all commands."""

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

from vg2gt.config import hydra_message

USER_ERRORS = (
    ValueError,
    OSError,
    ImportError,
    ArithmeticError,
    MemoryError,
    HydraException,
    OmegaConfBaseException,
)
TRACEBACK = "HYDRA_FULL_ERROR"
INTERRUPTED = 128 + signal.SIGINT


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Ends the process with the message of an error instead of its traceback.

    ``HYDRA_FULL_ERROR=1`` shows the traceback. In a sweep errors are left to Hydra, which runs the other jobs first.
    """
    try:
        yield
    except KeyboardInterrupt:
        if os.environ.get(TRACEBACK):
            raise
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except Exception as error:
        if os.environ.get(TRACEBACK) or in_a_sweep() or not isinstance(error, USER_ERRORS):
            raise
        # A constructor's own error is the cause of Hydra's.
        cause = error.__cause__ or error if isinstance(error, InstantiationException) else error
        if sys.stderr.isatty():
            print(file=sys.stderr)  # ends a progress bar that was interrupted
        if isinstance(cause, (HydraException, OmegaConfBaseException)):
            said = hydra_message(cause)
        elif isinstance(cause, TypeError) and HydraConfig.initialized():
            given = " ".join(HydraConfig.get().overrides.task)
            said = f"an option may have a value of another kind than expected ({cause}); given were: {given}"
        else:
            said = f"{type(cause).__name__}: {' '.join(_words_of(cause).splitlines())}"
        sys.exit(f"{said} ({TRACEBACK}=1 shows where)")


def _words_of(error: BaseException) -> str:
    """An error's message; the system's own begins with the file, not with its number."""
    if not isinstance(error, OSError) or not error.strerror:
        return str(error)
    return f"{error.filename}: {error.strerror}" if error.filename else error.strerror


def in_a_sweep() -> bool:
    """Whether this is a job of a sweep (``-m``)."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
