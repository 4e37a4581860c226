"""``vg2gt curves``: training curves as a picture (extra: eval)."""

from __future__ import annotations

from pathlib import Path

from vg2gt.cli.arguments import flag_parser
from vg2gt.cli.commands import COMMANDS
from vg2gt.cli.errors import errors_in_one_line


def main() -> None:
    """Reads the runs and writes the picture."""
    parser = flag_parser("curves", COMMANDS["curves"])
    parser.add_argument("runs", type=Path, nargs="+", help="folders of runs")
    parser.add_argument("--out", type=Path, help="the PNG file; default: curves.png in the first run's folder")
    arguments = parser.parse_args()
    with errors_in_one_line():
        from vg2gt.studies.curves import plot_curves

        print(plot_curves(arguments.runs, arguments.out or arguments.runs[0] / "curves.png"))
