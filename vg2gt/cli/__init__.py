"""The console script ``vg2gt COMMAND``."""

from vg2gt.cli.allocator import start_with_mimalloc
from vg2gt.cli.commands import COMMANDS, dispatch
from vg2gt.cli.leaving import run_and_leave


def main() -> None:
    """Runs ``vg2gt COMMAND [arguments]``; the arguments are the command's own (Hydra overrides where it trains)."""
    dispatch("vg2gt", COMMANDS)


def console() -> None:
    """:func:`main` as a process of its own, which may start again and ends with the command."""
    run_and_leave(lambda: dispatch("vg2gt", COMMANDS, start_with_mimalloc))
