"""The report of an evaluation as Markdown, readable in a terminal too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from vg2gt.evaluation import paper
from vg2gt.evaluation.evaluator import MODES, PROTOCOLS
from vg2gt.evaluation.tables import METRICS, Metric, columns, markdown_table, number

DEPTH = columns(*("abs_rel", "mae", "rmse", "delta_1.25", "delta_1.05", "delta_1.03", "coverage", "delta_1.05_holes"))
IMAGES = columns("psnr", "ssim", "lpips")
NORMALS = columns(
    *("normal_mean", "normal_median", "normal_acc_10", "normal_acc_30", "normal_cosine"),
    labels={"normal_mean": "mean [deg]"},
    decimals={"normal_mean": 2},
)
CAMERAS = columns(*(name for name in METRICS if name.startswith(("rra_", "rta_", "auc_"))))
POINTS = columns("accuracy", "completeness", "chamfer", "precision", "recall", "f_score")
STATED = columns(*(f"{name}_{level}" for name in ("held", "width") for level in (50, 80, 90, 95)), "ause")
_COST = columns(
    *("cv", "gaussians", "gaussians_per_pixel", "reconstruct_seconds", "head_seconds", "render_seconds"),
    "peak_memory_mib",
)
_HELD_OUT, _INPUTS = "rendered/gt_pose/solid", "rendered/context/solid"
SCENE = columns(
    *(f"{_HELD_OUT}/{name}" for name in ("psnr", "ssim", "abs_rel", "delta_1.05", "coverage", "normal_mean")),
    *(f"{_INPUTS}/psnr", f"{_INPUTS}/abs_rel", "decoded/after/abs_rel", "scene/cv", "scene/gaussians"),
    labels={
        f"{_INPUTS}/psnr": "PSNR of inputs [dB]",
        f"{_INPUTS}/abs_rel": "abs_rel of inputs",
        "decoded/after/abs_rel": "decoded abs_rel",
    },
    decimals={f"{_HELD_OUT}/normal_mean": 2},
)

# Paths of a section's metrics -> labels of their rows, after the number of views.
Paths = Mapping[str, Sequence[str]]
_RENDERED = {f"rendered/{protocol}/{mode}": (protocol, mode) for protocol in PROTOCOLS for mode in MODES}
DECODED = {"decoded/before": ("before",), "decoded/after": ("after",)}
_POINT_CLOUDS = {"points/rendered": ("rendered",), "points/decoded": ("decoded",)}

Figures = Mapping[str, float | None]
Rows = list[tuple[list[str], Figures]]


def report_markdown(report: Mapping[str, Any]) -> str:
    """Formats the content of ``metrics.json`` as Markdown: settings, a table per kind of metric, then the scenes."""
    settings, by_views = report["settings"], sorted(report["views"].items(), key=lambda item: int(item[0]))
    dataset, images = settings["paper"], IMAGES
    if settings["lpips"].startswith("n/a"):  # missing weights are noted in the heading
        images = images | {"lpips": replace(images["lpips"], label=f"LPIPS {settings['lpips']}")}

    def rows(paths: Paths, table: str | None = None) -> Rows:
        """For each number of views our rows, those of refined scenes, and the paper's."""
        found: Rows = []
        for views, result in by_views:
            for label, prefix in ((views, ""), (f"{views}, refined", "refined/")):
                found += [([label, *key], _below(result["mean"], prefix + path)) for path, key in paths.items()]
            if table:
                theirs = paper.rows_by_views(table, dataset, int(views))
                found += [([views, f"paper, {table}", mode], figures) for mode, figures in theirs]
        return found

    def papers_row(table: str, *key: str, method: str = paper.OURS) -> Rows:
        figures = paper.row(table, dataset, method)
        return [([*key], figures)] if figures else []

    costs = _COST | columns("refine_seconds") if settings.get("refinement") else _COST
    normals, decoded, cost = (f"paper, {table}" for table in (paper.NORMALS, paper.DECODED, paper.UNIFORMITY))
    rendered = ("views", "protocol", "rendering")
    scenes = [([scene, views], figures) for views, result in by_views for scene, figures in result["scenes"].items()]
    sections = [
        _section("Rendered depth", rendered, DEPTH, rows(_RENDERED, paper.DEPTH)),
        _section("Images", rendered, images, rows(_RENDERED, paper.IMAGES)),
        _section(
            "Rendered normals", rendered, NORMALS, rows(_RENDERED) + papers_row(paper.NORMALS, "-", normals, "solid")
        ),
        _section(
            "Decoded depth of the input views",
            ("views", "enhancement"),
            DEPTH,
            rows(DECODED)
            + papers_row(paper.DECODED, "-", f"before (DA3): {decoded}", method="DA3")
            + papers_row(paper.DECODED, "-", f"after: {decoded}"),
        ),
        _section("Stated errors of the decoded depth", ("views",), STATED, rows({"stated": ()})),
        _section("Cameras of the input views", ("views",), CAMERAS, rows({"cameras": ()})),
        _section("Points of the input views", ("views", "depth"), POINTS, rows(_POINT_CLOUDS)),
        _section("Uniformity and cost", ("views",), costs, rows({"scene": ()}) + papers_row(paper.UNIFORMITY, cost)),
        _section("Scenes (solid; held-out views at true poses)", ("scene", "views"), SCENE, scenes),
    ]
    return "\n".join([_heading(settings), *sections])


def _heading(settings: Mapping[str, Any]) -> str:
    nearest, farthest = settings["depth_range"]
    shown = {
        "weights": settings["weights"],
        "model": settings["model"],
        "backbone": f"{settings['backend']['name']}, weights {settings['backend']['weights'][:12]}",
        "data": f"{settings['data']}, {settings['scenes']} scenes, views {settings['index']}",
        "images": f"{settings['size'][0]}x{settings['size'][1]}",
        "depth": f"alignment {settings['alignment']}, true depths from {nearest or 0} to {farthest or 'any'}",
        "CV": f"k = {settings['neighbors']}",
        "LPIPS": settings["lpips"],
        "points": ", ".join(f"{key} {value}" for key, value in settings["points"].items()),
        "device": settings["device"],
    }
    lines = [f"# Evaluation: {settings['name']}", "", *(f"- {name}: {value}" for name, value in shown.items())]
    lines += [
        "- protocols: `novel`: held-out views at cameras predicted by a joint pass; `gt_pose`: held-out views at true "
        "cameras; `context`: the input views again",
        "- depth and normals are of rendered pixels only; coverage is the share of true pixels that were rendered",
    ]
    if settings.get("refinement"):
        lines.append(
            f"- rows `refined`: Gaussians and cameras optimised on the input views, {settings['refinement']} steps; "
            "not feed-forward"
        )
    if settings["paper"]:
        lines.append(
            f"- rows `paper` are the paper's own results on {settings['paper']}; its views are not published, so they "
            "are others than ours, and the k of its CV is unknown"
        )
    if settings["paper_obstacle"]:
        lines.append(f"- the paper's rows are left out: {settings['paper_obstacle']}")
    return "\n".join([*lines, ""])


def _section(title: str, keys: Sequence[str], shown: Mapping[str, Metric], rows: Rows) -> str:
    """A table of the rows that have any of the metrics; ``n/a`` if there are none."""
    body = [
        [*key, *(number(figures.get(name), metric.decimals) for name, metric in shown.items())]
        for key, figures in rows
        if any(figures.get(name) is not None for name in shown)
    ]
    head = [*keys, *(metric.label for metric in shown.values())]
    return f"## {title}\n\n{markdown_table(head, body, len(keys)) if body else 'n/a'}\n"


def _below(figures: Figures, path: str) -> Figures:
    return {name.removeprefix(f"{path}/"): value for name, value in figures.items() if name.startswith(f"{path}/")}
