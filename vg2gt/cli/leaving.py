"""How a command ends."""

from __future__ import annotations

import atexit
import os
import sys
from collections.abc import Callable


def run_and_leave(command: Callable[[], None]) -> None:
    """Runs a command and, where it succeeds, ends the process without taking apart what was imported.

    Python spends one to two seconds on the modules of torch and Lightning. Everything that was imported after this call
    began has its own work at the end done first; a command that fails ends as always.
    """
    succeeded = False

    def leave() -> None:
        if succeeded:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:  # closed by whoever started the command
                    stream.flush()
            os._exit(0)

    atexit.register(leave)
    command()
    succeeded = True
