"""The table at the end of a run: untrained head against trained head."""

from __future__ import annotations

import math

from vg2gt.evaluation.tables import columns, markdown_table, number, print_table

ROWS = columns(
    *("psnr", "ssim", "abs_rel", "delta_1.05", "normal_mean", "coverage"),
    *("decoded_abs_rel_before", "decoded_abs_rel", "gaussians", "cv"),
    labels={
        "abs_rel": "rendered depth abs_rel",
        "delta_1.05": "rendered depth delta < 1.05",
        "normal_mean": "rendered normals, mean angle [deg]",
        "coverage": "share of pixels with a depth",
        "decoded_abs_rel_before": "decoded depth abs_rel, backbone",
        "decoded_abs_rel": "decoded depth abs_rel, enhanced",
        "cv": "uniformity CV (k = 8)",
    },
)
HEAD = ("", "untrained", "trained", "change")
CAPTION = "views never trained on, at ground-truth poses; depth aligned by one median scale per scene"


def _rows(untrained: dict[str, float], trained: dict[str, float]) -> list[list[str]]:
    rows = []
    for name, metric in ROWS.items():
        before, after = untrained.get(name, math.nan), trained.get(name, math.nan)
        change = after - before
        relative = f" ({change / before:+.0%})" if before and math.isfinite(change) else ""
        shown = [number(before, metric.decimals), number(after, metric.decimals)]
        rows.append([metric.label, *shown, number(change, metric.decimals, sign=True) + relative])
    return rows


def print_comparison(untrained: dict[str, float], trained: dict[str, float]) -> None:
    """Prints the table to the terminal."""
    print_table(HEAD, _rows(untrained, trained), title="untrained head -> trained head", caption=CAPTION)


def comparison_table(untrained: dict[str, float], trained: dict[str, float]) -> str:
    """Returns the table as Markdown."""
    return f"{markdown_table(HEAD, _rows(untrained, trained))}\n\n{CAPTION}.\n"
