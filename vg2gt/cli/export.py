"""``vg2gt export``: exports a frozen network as an ONNX bundle."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from vg2gt.cli.arguments import flag_parser, separate
from vg2gt.cli.errors import errors_in_one_line
from vg2gt.config import compose_groups

DETAILS = """
backend=NAME selects a network, VGGT or a relative DA3 network; backend.key=value sets its options.
The numbers of scenes, views, rows and columns stay dynamic."""


def main(argv: Sequence[str] | None = None) -> None:
    """Writes the bundle; errors are reported in one line."""
    given, overrides = separate(argv)
    parser = flag_parser("export", DETAILS)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    out = parser.parse_args(given).out
    if not any(override.startswith("backend=") for override in overrides):
        parser.error("give backend=NAME")
    with errors_in_one_line():
        from hydra.utils import instantiate

        from backends.onnx import export

        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        description = export(instantiate(compose_groups(*overrides).backend), out.expanduser())
        found = f"{out}: {description['name']}, licence: {description['licence']}"
        differences = ", ".join(f"{part} {value:.1e}" for part, value in description["max_difference"].items())
        print(f"{found}; largest difference to torch: {differences}")
