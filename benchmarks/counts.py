"""Quality against the number of Gaussians: ``python benchmarks/counts.py [steps=N] [seeds=N] [overrides]``.

Two comparisons beside those of ``baselines.py``, whose trainings and metrics in ``outputs/<name>`` it takes over.

*Equal counts*: without its coarse module VG²GT has more Gaussians, because views that disagree do not share voxels.
Here that model's cells are widened until it has as many as the full one, and it is trained again, for every seed. The
widening needs no training: without the coarse module the voxels follow from the frozen depth alone.

*The curve*: VG²GT with one, two and four Gaussians a voxel and with cells of several sizes, first seed, and the
baselines as points.

``coarse=`` as in ``baselines.py``. Finished trainings are not repeated, interrupted ones go on. Writes runs,
``counts.json``, ``counts.md`` and ``counts.png`` (extra: eval) into ``outputs/<name>``; name=baselines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from baselines import COLUMNS, MODELS, REFERENCE, Model, Results, coarse_start
from common import machine, settings

from vg2gt.evaluation.tables import METRICS, columns
from vg2gt.io.files import read_json, write_json, write_text
from vg2gt.studies.study import Metrics, compose_run, run_once, seeds_table, summarize
from vg2gt.training.loop import build

DEFAULTS = {"name": "baselines", "steps": "400", "seeds": "1", "coarse": ""}
FOOTPRINT = "model.fine.min_footprint"
WITHOUT = "VG²GT w/o coarse"
CLOSE = 0.01  # of the wanted number, where the search for a cell ends
MAX_DIFFERENCE = 0.05  # of the trained numbers, above which they are not called equal
# Gaussians a voxel, and cells in pixels at the median depth; VG²GT as it comes and at 2 px stand in baselines.py.
CURVE: dict[int, dict[float, Model]] = {
    splits: {
        pixels: Model(
            f"splits-{splits}-{pixels:g}px", (f"model.gaussians.splits={splits}", f"{FOOTPRINT}={pixels}"), coarse=True
        )
        for pixels in cells
    }
    for splits, cells in {1: (2.02, 3.1), 2: (4.5,), 4: (3.1, 4.5)}.items()
}
CURVE[2] = {2.02: MODELS["VG²GT, 2 px"], 3.1: MODELS[REFERENCE], **CURVE[2]}
SHOWN = {name: COLUMNS[name] for name in ("psnr", "ssim", "rmse", "abs_rel", "normal_mean")} | columns(
    "edge_abs_rel", "edge_psnr", "cv", "gaussians"
)
TICKS = (10, 20, 50, 100, 200)  # thousand Gaussians
PANELS = ("psnr", "ssim", "abs_rel", "normal_mean")


def footprint_for(wanted: float, count: Callable[[float], float], start: float) -> float:
    """The edge of the cells, in pixels, with which a model has as many Gaussians as wanted, within one per cent.

    Args:
        wanted: number of Gaussians.
        count: number of Gaussians by edge; falls about as a power of it.
        start: an edge to begin with.

    Raises:
        ValueError: if eight trials do not find it.
    """
    edge, power, before = start, 1.5, None
    for _ in range(8):
        found = count(edge)
        if abs(found / wanted - 1) <= CLOSE:
            return edge
        if before is not None and before[0] != edge and before[1] != found:
            power = -math.log(found / before[1]) / math.log(edge / before[0])
        before = (edge, found)
        edge = round(edge * (found / wanted) ** (1 / power), 3)
    last, found = before or (start, math.nan)
    raise ValueError(f"no edge gives {wanted:.0f} Gaussians within {CLOSE:.0%}: {last:g} px gives {found:.0f}")


def counter(overrides: list[str], folder: Path) -> tuple[Callable[[float], float], float]:
    """Mean number of an untrained model's Gaussians in the evaluation's scenes, by its cells; and its own cells."""
    run = build(compose_run(overrides, folder))
    run.datamodule.setup("validate")
    model: Any = run.module.eval().model

    @torch.no_grad()
    def count(edge: float) -> float:
        model.fine.min_footprint = edge
        contexts = [batch.to(run.module.device).context for batch in run.datamodule.val_dataloader()]
        numbers = [len(model(context.images, context.hints).gaussians) for context in contexts]
        return sum(numbers) / len(numbers)

    return count, float(model.fine.min_footprint)


def as_many(reference: Mapping[int, Metrics], overrides: list[str], home: Path) -> tuple[str, Model]:
    """The model without its coarse module with as many Gaussians as the full one has in the mean of its seeds."""
    without = MODELS[WITHOUT]
    wanted = sum(metrics["gaussians"] for metrics in reference.values()) / len(reference)
    count, start = counter([*overrides, *without.overrides], home / "untrained")
    edge = footprint_for(wanted, count, start)
    folder = f"{without.folder}-{edge:g}px"
    return f"{WITHOUT}, {edge:g} px", Model(folder, (*without.overrides, f"{FOOTPRINT}={edge}"))


def points_of(home: Path) -> dict[str, Metrics]:
    """What ``baselines.py`` measured with the first seed; nothing where it did not run."""
    path = home / "metrics.json"
    runs = read_json(path)["runs"] if path.is_file() else {}
    on_curve = {name for name, model in MODELS.items() if model in CURVE[2].values()}
    return {name: seeds["0"] for name, seeds in runs.items() if name not in on_curve and "0" in seeds}


def plot(curve: Mapping[str, Mapping[str, Metrics]], points: Mapping[str, Metrics], path: Path) -> Path | None:
    """One panel a metric over the number of Gaussians: a line for each number a voxel; None without matplotlib."""
    try:
        from matplotlib import pyplot  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    figure, panels = pyplot.subplots(1, len(PANELS), figsize=(3.6 * len(PANELS), 3.4))
    for panel, name in zip(panels, PANELS, strict=True):
        for splits, cells in curve.items():
            ordered = sorted(cells.values(), key=lambda metrics: metrics["gaussians"])
            thousands = [metrics["gaussians"] / 1e3 for metrics in ordered]
            panel.plot(thousands, [metrics[name] for metrics in ordered], "o-", label=f"VG²GT, {splits} a voxel")
        for (label, metrics), mark in zip(points.items(), "sD^vPX", strict=False):
            panel.plot([metrics["gaussians"] / 1e3], [metrics[name]], mark, color="0.3", label=label)
        panel.set(title=METRICS[name].label, xlabel="thousand Gaussians a scene", xscale="log")
        panel.minorticks_off()
        panel.set_xticks(TICKS, map(str, TICKS))
    panels[0].legend(fontsize=7)
    figure.tight_layout()
    temporary = path.with_name(f".{path.name}.tmp.png")
    figure.savefig(temporary, dpi=110)
    pyplot.close(figure)
    temporary.replace(path)
    return path


def report(equal: Results, curve: Mapping[str, Mapping[str, Metrics]], options: Mapping[str, str]) -> str:
    """Both tables as Markdown."""
    full, same = (
        sum(run["gaussians"] for run in runs.values()) / len(runs)
        for name, runs in equal.items()
        if name != WITHOUT and runs
    )
    verdict = "equal" if abs(same / full - 1) <= MAX_DIFFERENCE else "NOT EQUAL"
    rows = {f"{splits} a voxel, {px} px": {0: m} for splits, cells in curve.items() for px, m in cells.items()}
    return "\n\n".join(
        [
            "# Quality against the number of Gaussians",
            f"{options['steps']} training steps each, {options['seeds']} seed(s) (mean ± 95 % confidence interval).",
            f"## At {verdict} counts ({same / full - 1:+.1%})",
            seeds_table(equal, SHOWN),
            "## VG²GT by Gaussians a voxel and cell, first seed",
            seeds_table(rows, SHOWN),
            "",
        ]
    )


def main() -> None:
    """Trains whatever is not trained, measures and writes."""
    options, overrides = settings(__doc__, DEFAULTS)
    home = Path("outputs").resolve() / options["name"]
    begin = coarse_start(options["coarse"], home)

    def trained(model: Model, seed: int) -> Metrics:
        print(f"seed {seed}: {model.folder}", flush=True)
        own = [f"seed={seed}", f"trainer.max_steps={options['steps']}", *(begin if model.coarse else ())]
        return run_once([*overrides, *own, *model.overrides], home / f"seed-{seed}" / model.folder)

    seeds = range(int(options["seeds"]))
    equal: Results = {name: {seed: trained(MODELS[name], seed) for seed in seeds} for name in (REFERENCE, WITHOUT)}
    name, widened = as_many(equal[REFERENCE], overrides, home)
    equal[name] = {seed: trained(widened, seed) for seed in seeds}
    curve = {
        str(splits): {f"{pixels:g}": trained(model, 0) for pixels, model in sorted(cells.items())}
        for splits, cells in CURVE.items()
    }
    content = {
        "options": options,
        "overrides": overrides,
        "machine": machine(),
        "equal": equal,
        "summary": summarize(equal, REFERENCE),
        "curve": curve,
    }
    write_json(home / "counts.json", content)
    write_text(home / "counts.md", report(equal, curve, options))
    picture = plot(curve, points_of(home), home / "counts.png")
    print(report(equal, curve, options))
    print(f"metrics: {home / 'counts.json'}; picture: {picture or 'none without matplotlib'}")


if __name__ == "__main__":
    main()
