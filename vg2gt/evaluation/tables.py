"""Display of metrics: their labels, decimals and directions, and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Metric:
    """How tables show a metric: label with unit, decimals, and whether larger is better (None: neither)."""

    label: str
    decimals: int
    larger_is_better: bool | None = None


METRICS = {
    "psnr": Metric("PSNR [dB]", 2, True),
    "ssim": Metric("SSIM", 3, True),
    "lpips": Metric("LPIPS", 3, False),
    "abs_rel": Metric("abs_rel", 4, False),
    "mae": Metric("MAE", 4, False),
    "rmse": Metric("RMSE", 4, False),
    **{f"delta_{t}": Metric(f"d<{t}", 3, True) for t in ("1.25", "1.05", "1.03")},
    "delta_1.05_holes": Metric("d<1.05, holes fail", 3, True),
    "coverage": Metric("coverage", 4, True),
    "edge_abs_rel": Metric("abs_rel at edges", 4, False),
    "edge_psnr": Metric("PSNR at edges [dB]", 2, True),
    "abs_rel_rasterized": Metric("abs_rel, rasterised", 4, False),
    "decoded_abs_rel_before": Metric("abs_rel, backbone", 4),
    "decoded_abs_rel": Metric("abs_rel, decoded", 4, False),
    "normal_mean": Metric("normals [deg]", 1, False),
    "normal_median": Metric("median [deg]", 2, False),
    "normal_acc_10": Metric("acc@10", 3, True),
    "normal_acc_30": Metric("acc@30", 3, True),
    "normal_cosine": Metric("cosine", 3, True),
    **{f"rra_{t}": Metric(f"RRA@{t}", 3, True) for t in (5, 15, 30)},
    **{f"rta_{t}": Metric(f"RTA@{t}", 3, True) for t in (5, 15, 30)},
    **{f"auc_{t}": Metric(f"AUC@{t}", 3, True) for t in (3, 5, 15, 30)},
    "accuracy": Metric("accuracy", 4, False),
    "completeness": Metric("completeness", 4, False),
    "chamfer": Metric("chamfer", 4, False),
    "precision": Metric("precision", 3, True),
    "recall": Metric("recall", 3, True),
    "f_score": Metric("F-score", 3, True),
    **{f"held_{level}": Metric(f"within the {level} % bound", 3) for level in (50, 80, 90, 95)},
    **{f"width_{level}": Metric(f"median {level} % bound", 4, False) for level in (50, 80, 90, 95)},
    "ause": Metric("AUSE", 3, False),
    "cv": Metric("CV", 3, False),
    "gaussians": Metric("Gaussians", 0),
    "gaussians_per_pixel": Metric("per input pixel", 3),
    "reconstruct_seconds": Metric("reconstruct [s]", 3, False),
    "head_seconds": Metric("Gaussian head [s]", 3, False),
    "refine_seconds": Metric("refine [s]", 1, False),
    "render_seconds": Metric("render [s/view]", 4, False),
    "peak_memory_mib": Metric("peak memory [MiB]", 0, False),
}


def columns(
    *names: str, labels: Mapping[str, str] | None = None, decimals: Mapping[str, int] | None = None
) -> dict[str, Metric]:
    """Returns the columns of a table, by name.

    Args:
        names: names in :data:`METRICS`, or paths that end in one of them, such as ``rendered/gt_pose/solid/psnr``.
        labels: labels that replace the default ones.
        decimals: decimals that replace the default ones.
    """
    chosen = {name: METRICS[name.rpartition("/")[2]] for name in names}
    for name, label in (labels or {}).items():
        chosen[name] = replace(chosen[name], label=label)
    for name, digits in (decimals or {}).items():
        chosen[name] = replace(chosen[name], decimals=digits)
    return chosen


def number(value: float | None, decimals: int, sign: bool = False) -> str:
    """Formats a number for a table; ``n/a`` if it is missing or not finite."""
    if value is None or not math.isfinite(value):
        return "n/a"
    return f"{value:{'+' if sign else ''}.{decimals}f}"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1) -> str:
    """Formats a Markdown table, readable in a terminal; the first ``text_columns`` are left-aligned, others right."""
    widths = [max(map(len, cells)) for cells in zip(head, *rows, strict=True)]
    left = [True] * text_columns + [False] * (len(head) - text_columns)
    rule = ["-" * width if text else "-" * (width - 1) + ":" for width, text in zip(widths, left, strict=True)]
    lines = [
        [cell.ljust(width) if text else cell.rjust(width) for cell, width, text in zip(row, widths, left, strict=True)]
        for row in (head, *rows)
    ]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (lines[0], rule, *lines[1:]))
