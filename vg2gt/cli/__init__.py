"""The console script ``vg2gt COMMAND``."""

from __future__ import annotations

import importlib
import sys

COMMANDS = {
    "train": "vg2gt.cli.train",
    "evaluate": "vg2gt.cli.evaluate",
    "ablate": "vg2gt.studies.ablation",
    "reconstruct": "vg2gt.cli.reconstruct",
    "render": "vg2gt.cli.render",
    "view": "vg2gt.cli.view",
}


def main() -> None:
    """Runs ``vg2gt COMMAND [arguments]``; the arguments are the command's own (Hydra overrides where it trains)."""
    asked = sys.argv[1] if len(sys.argv) > 1 else ""
    if asked not in COMMANDS:
        unknown = f"unknown command {asked!r}; " if asked not in ("", "-h", "--help") else ""
        print(f"{unknown}usage: vg2gt COMMAND [arguments], COMMAND is one of: {', '.join(COMMANDS)}")
        sys.exit(0 if asked in ("-h", "--help") else 2)
    command = importlib.import_module(COMMANDS[asked])
    # Further processes (DDP) are started as argv says: by the command's own file, without the command's name.
    sys.argv[:2] = [str(command.__file__)]
    command.main()
