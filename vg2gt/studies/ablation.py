"""The paper's ablations on our data: ``vg2gt ablate [seeds=N] [steps=N] [any override of train.yaml ...]``.

As in the paper (appendix, Model Evaluation), no variant is trained from scratch. For every seed, each variant and the
full model itself continue one full model for ``steps`` steps on the same batches. If the number of splits changes, the
last layer is reinitialised; a control also continues the full model with a reinitialised last layer. Finished runs are
not repeated, interrupted ones resume. ``protocol=PRESET`` scores like ``vg2gt evaluate evaluation=PRESET``.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from vg2gt.config import compose
from vg2gt.evaluation.paper import tables
from vg2gt.evaluation.run import evaluate, view_counts
from vg2gt.evaluation.tables import Metric, columns, markdown_table
from vg2gt.io.files import write_json, write_text
from vg2gt.studies.study import (
    Estimate,
    Metrics,
    compose_run,
    final_checkpoint,
    paired_difference,
    quoted,
    run_once,
    seeds_row,
    seeds_table,
    summarize,
    write_part,
)

log = logging.getLogger(__name__)

OWN_KEYS = ("name", "seeds", "full_steps", "steps", "lr", "variants", "splits", "init_from")
OWN_KEYS += ("protocol", "protocol_overrides")
SETTLED_KEYS = ("seed", "ckpt", "overwrite", "output_dir", "ablation", "trainer.max_steps")
CONTINUATION_SEED = 1000  # added to the seed: continuations do not repeat the full model's first batches
FULL, CONTROL = "full", "new_last_layer"
LAST_LAYER = "model.gaussians.out."

LABELS = {
    "rasterized": "3DGS",
    "wo_depth": "w/o Depth",
    "wo_coarse": "w/o Coarse",
    "wo_enhance": "w/o Enhance",
    "wo_split": "w/o Split",
    FULL: "VG²GT (full)",
    CONTROL: "full, last layer new",
}
PAPER_COLUMNS = columns(
    *("psnr", "ssim", "lpips", "rmse", "abs_rel", "delta_1.25", "delta_1.05"),
    decimals={"delta_1.25": 4, "delta_1.05": 4},
)
OUR_COLUMNS = columns("abs_rel_rasterized", "decoded_abs_rel", "normal_mean", "cv", "gaussians")
# The paper's tables and rows that correspond to ours (Replica).
PAPER_ABLATION, PAPER_SPLIT, PAPER_DATA = "tbl_ablation", "tbl_split", "replica"
PAPER_FULL = "VG2GT (full)"
# Paths of metrics in an evaluation: GT_POSE, except those in PATHS.
GT_POSE = "rendered/gt_pose/solid/"
PATHS = {
    "abs_rel_rasterized": "rendered/gt_pose/rasterized/abs_rel",
    "decoded_abs_rel": "decoded/after/abs_rel",
    **{name: f"scene/{name}" for name in ("cv", "gaussians")},
}


@dataclass(frozen=True)
class Continuation:
    """A run that continues the full model: its name, overrides, and whether its last layer is reinitialised."""

    name: str
    overrides: tuple[str, ...] = ()
    new_last_layer: bool = False


def continuations(variants: Sequence[str], splits: Sequence[int], full_splits: int) -> list[Continuation]:
    """Returns the runs of both tables, each once: ``splits=1`` is w/o Split, ``full_splits`` is the full model."""
    runs = [Continuation(FULL), *(Continuation(name, (f"ablation={name}",)) for name in variants)]
    for count in splits:
        if count != full_splits and not (count == 1 and "wo_split" in variants):
            runs.append(Continuation(f"splits={count}", (f"model.gaussians.splits={count}",)))
    if any(run.name == "wo_split" or run.name.startswith("splits=") for run in runs):
        runs.append(Continuation(CONTROL, new_last_layer=True))
    return runs


@dataclass
class Ablation:
    """Runs the study and writes its tables.

    Attributes:
        folder: output folder of all runs and tables.
        overrides: overrides of ``train.yaml`` for all runs.
        seeds: number of seeds.
        full_steps: training steps of the full model.
        steps: training steps of each continuation.
        lr: initial learning rate of each continuation.
        variants: options of the group ``ablation``.
        splits: numbers of Gaussians per voxel to compare.
        init_from: initial weights of the full models.
        protocol: preset of the group ``evaluation`` on which runs are scored; None: by the training's own evaluation.
        protocol_overrides: overrides of ``evaluate.yaml`` for the protocol; one number of views.
        diverged: continuations without a result.

    Raises:
        ValueError: if a count is not an integer or too small, or the protocol has several numbers of views.
    """

    folder: Path
    overrides: Sequence[str]
    seeds: int
    full_steps: int
    steps: int
    lr: float
    variants: Sequence[str]
    splits: Sequence[int]
    init_from: str | None = None
    protocol: str | None = None
    protocol_overrides: Sequence[str] = ()
    diverged: list[str] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        counts = {name: getattr(self, name) for name in ("seeds", "full_steps", "steps")}
        for name, count in (*counts.items(), *(("splits", count) for count in self.splits)):
            least = 0 if name.endswith("steps") else 1
            if not isinstance(count, int) or count < least:
                raise ValueError(f"{name}={count}: a study takes whole numbers from {least} on")
        if self.protocol is not None:
            self._on_protocol(self.folder)
        self.full_splits = int(compose_run(self.overrides, self.folder).model.gaussians.splits)
        self.runs = continuations(self.variants, self.splits, self.full_splits)
        self.results: dict[str, dict[int, Metrics]] = {run.name: {} for run in self.runs}

    def run(self) -> None:
        """Runs all unfinished runs; FloatingPointError if a full model diverges. Other divergences are recorded."""
        total, number = self.seeds * (1 + len(self.runs)), 0
        for seed in range(self.seeds):
            home = self.folder / f"seed-{seed}"
            number += 1
            print(f"[{number}/{total}] seed {seed}: the full model, {self.full_steps} steps", flush=True)
            begin = [f"init_from={quoted(Path(self.init_from))}"] if self.init_from else []
            overrides = [*self.overrides, *begin, f"seed={seed}", f"trainer.max_steps={self.full_steps}"]
            run_once(overrides, home / "start", scored=self.protocol is None)
            start = final_checkpoint(home / "start", self.full_steps)
            for run in self.runs:
                number += 1
                print(f"[{number}/{total}] seed {seed}: {_label(run.name)}, {self.steps} steps more", flush=True)
                try:
                    self.results[run.name][seed] = self._go_on(run, seed, start, home)
                except FloatingPointError as error:
                    self.diverged.append(f"{_label(run.name)}, seed {seed}")
                    log.error("%s diverged: %s", self.diverged[-1], error)
                self.write()

    def _go_on(self, run: Continuation, seed: int, start: Path, home: Path) -> Metrics:
        if run.new_last_layer:
            cut = home / "start" / "without_last_layer.ckpt"
            start = write_part(start, cut, lambda name: not name.startswith(LAST_LAYER))
        overrides = [*self.overrides, *run.overrides, f"seed={CONTINUATION_SEED + seed}"]
        overrides += [f"trainer.max_steps={self.steps}", f"optimizer.lr={self.lr}", f"init_from={quoted(start)}"]
        folder = home / run.name.replace("=", "-")
        metrics = run_once(overrides, folder, scored=self.protocol is None)
        return metrics if self.protocol is None else _figures(evaluate(self._on_protocol(folder)))

    def _on_protocol(self, folder: Path) -> DictConfig:
        """Composes the configuration that evaluates the run in ``folder`` on the protocol."""
        settled = ("name=protocol", f"ckpt={quoted(folder)}", f"output_dir={quoted(folder / str(self.protocol))}")
        config = compose("evaluate", f"evaluation={self.protocol}", "views=10", *self.protocol_overrides, *settled)
        if len(view_counts(config.views)) > 1:
            raise ValueError(
                f"protocol_overrides: views={config.views}, but a study has one row a run: give one number"
            )
        return config

    def write(self) -> None:
        """Writes ``metrics.json`` and ``metrics.md``."""
        content = {
            "seeds": self.seeds,
            "full_steps": self.full_steps,
            "steps": self.steps,
            "lr": self.lr,
            "overrides": list(self.overrides),
            "init_from": self.init_from,
            "protocol": [self.protocol, *self.protocol_overrides],
            "diverged": self.diverged,
            "runs": {name: {str(seed): m for seed, m in runs.items()} for name, runs in self.results.items()},
            "summary": summarize(self.results, FULL),
            "paper": {table: tables()[table][PAPER_DATA] for table in (PAPER_ABLATION, PAPER_SPLIT)},
        }
        write_json(self.folder / "metrics.json", content)
        write_text(self.folder / "metrics.md", self.report())

    def report(self) -> str:
        """Both tables as Markdown, the paper's rows next to ours, and the differences to the full model."""
        splits = {f"splits={count}": self._row_of(count) for count in self.splits}
        parts = [
            "# Ablations",
            self._protocol(),
            "## Components",
            _beside_paper(self.results, {name: name for name in (*self.variants, FULL)}),
            "## Splits",
            _beside_paper(self.results, splits | ({CONTROL: CONTROL} if CONTROL in self.results else {})),
            "## More figures of the same runs",
            seeds_table({_label(name): runs for name, runs in self.results.items()}, OUR_COLUMNS),
            "## Differences to the full model, seed by seed",
            _differences(self.results, FULL),
        ]
        if CONTROL in self.results:
            parts += [
                "## Differences to the full model with a new last layer, seed by seed",
                _differences({name: self.results[name] for name in self._new_layers()}, CONTROL),
            ]
        return "\n\n".join(parts) + "\n"

    def _new_layers(self) -> list[str]:
        """Names of the runs that start with a reinitialised last layer."""
        return [CONTROL, *(name for name in self.results if name == "wo_split" or name.startswith("splits="))]

    def _row_of(self, count: int) -> str:
        if count == self.full_splits:
            return FULL
        return "wo_split" if count == 1 and "wo_split" in self.variants else f"splits={count}"

    def _protocol(self) -> str:
        done = min((len(runs) for runs in self.results.values()), default=0)
        diverged = f" Diverged: {'; '.join(self.diverged)}." if self.diverged else ""
        begin = f" from {self.init_from}" if self.init_from else ""
        scenes = ", depth aligned by one median scale per scene"
        if self.protocol is not None:
            scenes = f", as in vg2gt evaluate evaluation={self.protocol} {' '.join(self.protocol_overrides)}".rstrip()
        return (
            f"Full model {self.full_steps} steps{begin}, then every row (the full model as well) {self.steps} steps "
            f"more from it, at a learning rate of {self.lr:g}, with the same batches. "
            f"{done} of {self.seeds} seeds complete;{diverged} mean ± 95 % confidence interval over "
            "seeds (Student's t; none for one seed). Seeds differ in weights and training batches; all see the same "
            "held-out scenes, so the intervals say nothing of other scenes. Every difference is judged by itself: "
            "of twenty true zeros one is called better or worse. Views never trained on, at ground-truth "
            f"poses{scenes}; depth rendered as stochastic solids, whatever the training rendered (the 3DGS row too: "
            "its own rasterised depth is given below). Where the number of splits differs from the full model's, the "
            "last layer is new; the control shows what that alone costs, and is what these rows are compared "
            "with in the last table. The paper's rows are Replica, 10 views, 30000 more steps, and LPIPS of VGG; "
            "compare orders, not values. LPIPS is measured on a protocol only, where its weights are there."
        )


def _figures(report: Mapping[str, Any]) -> Metrics:
    """The metrics of an evaluation's report that the tables show, by their names in training."""
    ((_, views),) = report["views"].items()
    found = {name: views["mean"].get(PATHS.get(name, GT_POSE + name)) for name in (*PAPER_COLUMNS, *OUR_COLUMNS)}
    return {name: value for name, value in found.items() if value is not None}


def _label(name: str) -> str:
    return LABELS.get(name, name)


def _paper_row(name: str) -> Mapping[str, float] | None:
    """The paper's row that corresponds to a run; None if there is none."""
    if name.startswith("splits="):
        row = "w/o split" if name == "splits=1" else name.replace("splits", "split")
        return tables()[PAPER_SPLIT][PAPER_DATA].get(row)
    return tables()[PAPER_ABLATION][PAPER_DATA].get(PAPER_FULL if name == FULL else _label(name))


def _beside_paper(results: Mapping[str, Mapping[int, Metrics]], rows: Mapping[str, str]) -> str:
    """Our rows, each followed by the paper's; ``rows`` maps names of rows to names of runs."""
    lines = []
    for name, run in rows.items():
        lines.append([_label(name), *seeds_row(results[run], PAPER_COLUMNS)])
        if paper := _paper_row(name):
            lines.append(["*paper*", *(f"*{paper[metric]:g}*" for metric in PAPER_COLUMNS)])
    return markdown_table(["", *(metric.label for metric in PAPER_COLUMNS.values())], lines)


def _differences(results: Mapping[str, Mapping[int, Metrics]], reference: str) -> str:
    """Each run minus the reference, for metrics that all runs have; says whether the interval excludes zero."""
    every = [metrics for runs in results.values() for metrics in runs.values()]
    shown = {name: m for name, m in (PAPER_COLUMNS | OUR_COLUMNS).items() if all(name in metrics for metrics in every)}
    rows = [
        [_label(name), *(_verdict(paired_difference(runs, results[reference], key), m) for key, m in shown.items())]
        for name, runs in results.items()
        if name != reference
    ]
    return markdown_table([f"minus {_label(reference)}", *(metric.label for metric in shown.values())], rows)


def _verdict(change: Estimate, metric: Metric) -> str:
    shown = change.shown(metric.decimals, sign=True)
    if metric.larger_is_better is None or not math.isfinite(change.margin):
        return shown
    if change.mean == change.margin == 0:
        return "identical"
    if abs(change.mean) <= change.margin:
        return f"{shown} (not told apart)"
    return f"{shown} ({'better' if (change.mean > 0) == metric.larger_is_better else 'worse'})"


def common_overrides(overrides: Sequence[str]) -> list[str]:
    """Returns the overrides that apply to every training; ValueError if one sets a key that the study decides."""
    kept = []
    for override in overrides:
        key = override.split("=")[0].lstrip("+~")
        if key in SETTLED_KEYS:
            raise ValueError(f"{key} is decided by the study; its own keys are {', '.join(OWN_KEYS)}")
        if key not in OWN_KEYS:
            kept.append(override)
    return kept


def run_study(config: DictConfig) -> None:
    """Runs the study of ``ablate.yaml`` and prints its tables; SystemExit if a continuation diverged."""
    study = _study(config)
    study.run()
    print(study.report())
    print(f"metrics: {study.folder / 'metrics.json'}")
    if study.diverged:
        raise SystemExit(f"diverged, not in the tables: {'; '.join(study.diverged)}")


def _study(config: DictConfig) -> Ablation:
    if "gaussians" not in config.model or "splits" not in config.model.gaussians:
        raise ValueError("ablations need a model with splits: model=tiny or model=vg2gt")
    if config.trainer.devices != 1:
        raise ValueError(
            f"trainer.devices={config.trainer.devices}: a study runs its trainings one after another on one device"
        )
    return Ablation(
        Path(config.output_dir),
        common_overrides(HydraConfig.get().overrides.task),
        config.seeds,
        config.full_steps,
        config.steps,
        config.lr,
        list(config.variants),
        list(config.splits),
        config.init_from,
        config.protocol,
        list(config.protocol_overrides),
    )
