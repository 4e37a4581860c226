"""The report of an evaluation as Markdown, readable in a terminal too."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from vg2gt.evaluation import paper
from vg2gt.evaluation.evaluator import MODES, PROTOCOLS

# figure -> (heading, decimals, share: printed as it is)
DEPTH = {
    "abs_rel": ("abs_rel", 4),
    "mae": ("MAE", 4),
    "rmse": ("RMSE", 4),
    "delta_1.25": ("d<1.25", 3),
    "delta_1.05": ("d<1.05", 3),
    "delta_1.03": ("d<1.03", 3),
    "coverage": ("coverage", 4),
    "delta_1.05_holes": ("d<1.05, holes fail", 3),
}
IMAGES = {"psnr": ("PSNR [dB]", 2), "ssim": ("SSIM", 3), "lpips": ("LPIPS", 3)}
NORMALS = {
    "normal_mean": ("mean [deg]", 2),
    "normal_median": ("median [deg]", 2),
    "normal_acc_10": ("acc@10", 3),
    "normal_acc_30": ("acc@30", 3),
    "normal_cosine": ("cosine", 3),
}
CAMERAS = {f"rra_{t}": (f"RRA@{t}", 3) for t in (5, 15, 30)}
CAMERAS |= {f"rta_{t}": (f"RTA@{t}", 3) for t in (5, 15, 30)}
CAMERAS |= {f"auc_{t}": (f"AUC@{t}", 3) for t in (3, 5, 15, 30)}
POINTS = {
    "accuracy": ("accuracy", 4),
    "completeness": ("completeness", 4),
    "chamfer": ("chamfer", 4),
    "precision": ("precision", 3),
    "recall": ("recall", 3),
    "f_score": ("F-score", 3),
}
COST = {
    "cv": ("CV", 3),
    "gaussians": ("Gaussians", 0),
    "gaussians_per_pixel": ("per input pixel", 3),
    "reconstruct_seconds": ("reconstruct [s]", 3),
    "head_seconds": ("of it Gaussian head [s]", 3),
    "render_seconds": ("render [s/view]", 4),
    "peak_memory_mib": ("peak memory [MiB]", 0),
}
SCENE = {
    "rendered/gt_pose/solid/psnr": ("PSNR [dB]", 2),
    "rendered/gt_pose/solid/ssim": ("SSIM", 3),
    "rendered/gt_pose/solid/abs_rel": ("abs_rel", 4),
    "rendered/gt_pose/solid/delta_1.05": ("d<1.05", 3),
    "rendered/gt_pose/solid/coverage": ("coverage", 4),
    "rendered/gt_pose/solid/normal_mean": ("normals [deg]", 2),
    "rendered/context/solid/psnr": ("PSNR of inputs [dB]", 2),
    "rendered/context/solid/abs_rel": ("abs_rel of inputs", 4),
    "decoded/after/abs_rel": ("decoded abs_rel", 4),
    "scene/cv": ("CV", 3),
    "scene/gaussians": ("Gaussians", 0),
}

Columns = Mapping[str, tuple[str, int]]
Scores = Mapping[str, float | None]
Rows = list[tuple[list[str], Scores]]


def markdown(report: Mapping[str, Any]) -> str:
    """The report: how it was measured, a table a kind of figure, then the scenes.

    Args:
        report: the content of ``metrics.json`` (:func:`vg2gt.evaluation.run.evaluate`).
    """
    settings = report["settings"]
    means = {int(views): result["mean"] for views, result in report["views"].items()}
    beside = settings["paper"]
    sections = [_heading(settings)]
    rendered = ["views", "protocol", "rendering"]
    sections += [
        _section("Rendered depth", rendered, DEPTH, _rendered(means, paper.DEPTH, beside)),
        _section("Images", rendered, _image_columns(settings), _rendered(means, paper.IMAGES, beside)),
        _section("Rendered normals", rendered, NORMALS, _normals(means, beside)),
        _section("Decoded depth of the input views", ["views", "enhancement"], DEPTH, _decoded(means, beside)),
        _section("Cameras of the input views", ["views"], CAMERAS, _plain(means, "cameras")),
        _section("Points of the input views", ["views", "depth"], POINTS, _points(means)),
        _section("Uniformity and cost", ["views"], COST, _cost(means, beside)),
        _section("Scenes (solid; held-out views at true poses)", ["scene", "views"], SCENE, _scenes(report)),
    ]
    return "\n".join(section for section in sections if section)


def _heading(settings: Mapping[str, Any]) -> str:
    lines = [f"# Evaluation: {settings['name']}", ""]
    shown = {
        "weights": settings["weights"],
        "model": settings["model"],
        "backbone": f"{settings['backend']['name']}, weights {settings['backend']['weights'][:12]}",
        "data": f"{settings['data']}, {settings['scenes']} scenes, views {settings['index']}",
        "images": f"{settings['size'][0]}x{settings['size'][1]}, {settings['crop']}",
        "depth": f"alignment {settings['alignment']}, {_range(settings['depth_range'])}",
        "CV": f"k = {settings['neighbors']}",
        "LPIPS": settings["lpips"],
        "points": ", ".join(f"{key} {_length(value)}" for key, value in settings["points"].items()),
        "device": settings["device"],
    }
    lines += [f"- {name}: {value}" for name, value in shown.items()]
    lines += [
        "- protocols: `novel`: held-out views at cameras predicted by a joint pass; `gt_pose`: held-out views at true "
        "cameras; `context`: the input views again",
        "- depth and normals are of rendered pixels only; coverage is the share of true pixels that were rendered",
    ]
    if settings["paper"]:
        lines.append(
            f"- rows `paper` are the paper's own results on {settings['paper']}; its views are not published, so they "
            "are others than ours, and the k of its CV is unknown"
        )
    if settings["paper_obstacle"]:
        lines.append(f"- the paper's rows are left out: {settings['paper_obstacle']}")
    return "\n".join([*lines, ""])


def _range(bounds: Sequence[float | None]) -> str:
    nearest, farthest = bounds
    if nearest is None and farthest is None:
        return "of any true depth"
    return f"of true depths from {nearest or 0} to {'any' if farthest is None else farthest}"


def _length(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"


def _section(title: str, keys: Sequence[str], columns: Columns, rows: Rows) -> str:
    """A table of the columns that have a figure; nothing where none has."""
    rows = [(key, scores) for key, scores in rows if any(scores.get(name) is not None for name in columns)]
    if not rows:
        return f"## {title}\n\nn/a\n"
    head = [*keys, *(heading for heading, _ in columns.values())]
    body = [
        [*key, *(_number(scores.get(name), decimals) for name, (_, decimals) in columns.items())]
        for key, scores in rows
    ]
    return f"## {title}\n\n{_table(head, body, len(keys))}\n"


def _table(head: Sequence[str], body: Sequence[Sequence[str]], text_columns: int) -> str:
    widths = [max(len(row[i]) for row in [head, *body]) for i in range(len(head))]

    def line(cells: Sequence[str]) -> str:
        padded = [
            cell.ljust(width) if i < text_columns else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        return "| " + " | ".join(padded) + " |"

    rule = ["-" * width if i < text_columns else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
    return "\n".join([line(head), line(rule), *map(line, body)])


def _number(value: float | None, decimals: int) -> str:
    return "n/a" if value is None else f"{value:.{decimals}f}"


def _image_columns(settings: Mapping[str, Any]) -> Columns:
    """LPIPS without weights says so in its heading."""
    if settings["lpips"].startswith("n/a"):
        return {**IMAGES, "lpips": (f"LPIPS {settings['lpips']}", 3)}
    return IMAGES


def _by_views(means: Mapping[int, Scores], rows: Callable[[int, Scores], Iterator[tuple[list[str], Scores]]]) -> Rows:
    return [row for views, scores in sorted(means.items()) for row in rows(views, scores)]


def _rendered(means: Mapping[int, Scores], table: str, dataset: str | None) -> Rows:
    def rows(views: int, scores: Scores) -> Iterator[tuple[list[str], Scores]]:
        for protocol in PROTOCOLS:
            for mode in MODES:
                yield [str(views), protocol, mode], _below(scores, f"rendered/{protocol}/{mode}")
        for mode, figures in paper.rows_by_views(table, dataset, views) if dataset else ():
            yield [str(views), f"paper, {table}", mode], figures

    return _by_views(means, rows)


def _normals(means: Mapping[int, Scores], dataset: str | None) -> Rows:
    rows = _rendered(means, paper.NORMALS, None)
    return rows + _paper_row(paper.NORMALS, dataset, ["-", f"paper, {paper.NORMALS}", "solid"])


def _decoded(means: Mapping[int, Scores], dataset: str | None) -> Rows:
    def rows(views: int, scores: Scores) -> Iterator[tuple[list[str], Scores]]:
        for when in ("before", "after"):
            yield [str(views), when], _below(scores, f"decoded/{when}")

    table = paper.DECODED
    before = _paper_row(table, dataset, ["-", f"before (DA3): paper, {table}"], "DA3")
    return _by_views(means, rows) + before + _paper_row(table, dataset, ["-", f"after: paper, {table}"])


def _cost(means: Mapping[int, Scores], dataset: str | None) -> Rows:
    return _plain(means, "scene") + _paper_row(paper.UNIFORMITY, dataset, [f"paper, {paper.UNIFORMITY}"])


def _points(means: Mapping[int, Scores]) -> Rows:
    def rows(views: int, scores: Scores) -> Iterator[tuple[list[str], Scores]]:
        for depth in ("rendered", "decoded"):
            yield [str(views), depth], _below(scores, f"points/{depth}")

    return _by_views(means, rows)


def _plain(means: Mapping[int, Scores], path: str) -> Rows:
    return [([str(views)], _below(scores, path)) for views, scores in sorted(means.items())]


def _scenes(report: Mapping[str, Any]) -> Rows:
    ordered = sorted(report["views"].items(), key=lambda item: int(item[0]))
    return [([scene, views], scores) for views, result in ordered for scene, scores in result["scenes"].items()]


def _paper_row(table: str, dataset: str | None, key: list[str], method: str = paper.OURS) -> Rows:
    figures = paper.row(table, dataset, method) if dataset else None
    return [(key, figures)] if figures else []


def _below(scores: Scores, path: str) -> Scores:
    return {name.removeprefix(f"{path}/"): value for name, value in scores.items() if name.startswith(f"{path}/")}
