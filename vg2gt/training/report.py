"""The table at the end of a run: untrained head against trained head."""

from __future__ import annotations

import math

from rich.console import Console
from rich.markup import escape
from rich.table import Table

# name in metrics.json -> (label, decimals, larger is better; None: neither)
ROWS: dict[str, tuple[str, int, bool | None]] = {
    "psnr": ("PSNR [dB]", 2, True),
    "ssim": ("SSIM", 3, True),
    "abs_rel": ("rendered depth abs_rel", 4, False),
    "delta_1.05": ("rendered depth delta < 1.05", 3, True),
    "normal_mean": ("rendered normals, mean angle [deg]", 1, False),
    "coverage": ("share of pixels with a depth", 4, True),
    "decoded_abs_rel_before": ("decoded depth abs_rel, backbone", 4, None),
    "decoded_abs_rel": ("decoded depth abs_rel, enhanced", 4, False),
    "gaussians": ("Gaussians", 0, None),
    "cv": ("uniformity CV (k = 8)", 3, False),
}
CAPTION = "views never trained on, at ground-truth poses; depth aligned by one median scale a scene"


def _cells(untrained: dict[str, float], trained: dict[str, float]) -> list[tuple[str, str, str, str]]:
    rows = []
    for name, (label, decimals, _) in ROWS.items():
        before, after = untrained.get(name, math.nan), trained.get(name, math.nan)
        change = after - before
        relative = f" ({change / before:+.0%})" if before and math.isfinite(change) else ""
        shown = [f"{value:.{decimals}f}" if math.isfinite(value) else "n/a" for value in (before, after)]
        difference = f"{change:+.{decimals}f}{relative}" if math.isfinite(change) else "n/a"
        rows.append((label, shown[0], shown[1], difference))
    return rows


def print_comparison(untrained: dict[str, float], trained: dict[str, float]) -> None:
    """Prints the table to the terminal."""
    table = Table(title="untrained head -> trained head", caption=CAPTION)
    for heading in ("", "untrained", "trained", "change"):
        table.add_column(heading, justify="left" if not heading else "right")
    for row in _cells(untrained, trained):
        table.add_row(*map(escape, row))
    Console(width=110).print(table)


def comparison_table(untrained: dict[str, float], trained: dict[str, float]) -> str:
    """Returns the table as Markdown."""
    lines = ["| | untrained | trained | change |", "|---|---:|---:|---:|"]
    lines += ["| " + " | ".join(row) + " |" for row in _cells(untrained, trained)]
    return "\n".join([*lines, "", CAPTION + ".", ""])
