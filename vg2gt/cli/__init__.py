"""The console script ``vg2gt COMMAND``."""

from vg2gt.cli.commands import COMMANDS, dispatch


def main() -> None:
    """Runs ``vg2gt COMMAND [arguments]``; each command parses its own arguments."""
    dispatch("vg2gt", COMMANDS)
