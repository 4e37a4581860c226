"""The console script ``vg2gt COMMAND``."""

from __future__ import annotations

import importlib
import sys

COMMANDS = {"train": "vg2gt.cli.train"}


def main() -> None:
    """Runs ``vg2gt COMMAND [arguments]``; the arguments are the command's own (Hydra overrides for ``train``)."""
    if len(sys.argv) < 2 or sys.argv[1] not in COMMANDS:
        known = ", ".join(COMMANDS)
        asked = (
            f"unknown command {sys.argv[1]!r}; " if len(sys.argv) > 1 and sys.argv[1] not in ("-h", "--help") else ""
        )
        print(f"{asked}usage: vg2gt COMMAND [arguments], COMMAND is one of: {known}")
        sys.exit(0 if not asked and len(sys.argv) > 1 else 2)
    command = sys.argv.pop(1)
    importlib.import_module(COMMANDS[command]).main()
