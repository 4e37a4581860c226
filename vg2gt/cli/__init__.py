"""The console script ``vg2gt COMMAND``."""

from vg2gt.cli.commands import COMMANDS, dispatch


def main() -> None:
    """Runs ``vg2gt COMMAND [arguments]``; the arguments are the command's own (Hydra overrides where it trains)."""
    dispatch("vg2gt", COMMANDS)
