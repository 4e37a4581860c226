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

_OWN_KEYS = ("name", "seeds", "full_steps", "steps", "lr", "variants", "splits", "init_from")
_OWN_KEYS += ("protocol", "protocol_overrides")
_SETTLED_KEYS = ("seed", "ckpt", "overwrite", "output_dir", "ablation", "trainer.max_steps")
_CONTINUATION_SEED = 1000  # added to the seed: continuations do not repeat the full model's first batches
FULL, CONTROL = "full", "new_last_layer"
_LAST_LAYER = "model.gaussians.out."

_LABELS = {
    "rasterized": "3DGS",
    "wo_depth": "w/o Depth",
    "wo_coarse": "w/o Coarse",
    "wo_enhance": "w/o Enhance",
    "wo_split": "w/o Split",
    FULL: "VG²GT (full)",
    CONTROL: "full, last layer new",
}
_PAPER_COLUMNS = columns(
    *("psnr", "ssim", "lpips", "rmse", "abs_rel", "delta_1.25", "delta_1.05"),
    decimals={"delta_1.25": 4, "delta_1.05": 4},
)
_OUR_COLUMNS = columns("abs_rel_rasterized", "decoded_abs_rel", "normal_mean", "cv", "gaussians")
# The paper's tables and rows that correspond to ours (Replica).
_PAPER_ABLATION, _PAPER_SPLIT, _PAPER_DATA = "tbl_ablation", "tbl_split", "replica"
# Paths of metrics in an evaluation: _GT_POSE, except those in _PATHS.
_GT_POSE = "rendered/gt_pose/solid/"
_CONTEXT_COLUMNS = {f"context/{name}": metric for name, metric in _PAPER_COLUMNS.items()}
_PATHS = {
    **{name: f"rendered/context/solid/{name.removeprefix('context/')}" for name in _CONTEXT_COLUMNS},
    "abs_rel_rasterized": "rendered/gt_pose/rasterized/abs_rel",
    "decoded_abs_rel": "decoded/after/abs_rel",
    **{name: f"scene/{name}" for name in ("cv", "gaussians")},
}


def continuations(variants: Sequence[str], splits: Sequence[int], full_splits: int) -> dict[str, tuple[str, ...]]:
    """Returns the overrides of every run of both tables, by name.

    ``splits=1`` is w/o Split, ``full_splits`` the full model; where one has another number, there is a :data:`CONTROL`.
    """
    runs: dict[str, tuple[str, ...]] = {FULL: (), **{name: (f"ablation={name}",) for name in variants}}
    for count in splits:
        if count != full_splits and not (count == 1 and "wo_split" in variants):
            runs[f"splits={count}"] = (f"model.gaussians.splits={count}",)
    return runs | ({CONTROL: ()} if any(map(_has_new_layer, runs)) else {})


def _has_new_layer(name: str) -> bool:
    """Whether a run starts with a reinitialised last layer, by its name."""
    return name in (CONTROL, "wo_split") or name.startswith("splits=")


class Ablation:
    """Runs the study and writes its tables.

    Args:
        config: configuration of ``ablate.yaml``, which explains its keys.
        overrides: overrides of ``train.yaml`` for all runs.

    Attributes:
        folder: output folder of all runs and tables.
        results: metrics by run and seed.
        diverged: continuations without a result.

    Raises:
        ValueError: if a count is not an integer or too small, or the protocol has several numbers of views.
    """

    def __init__(self, config: DictConfig, overrides: Sequence[str]) -> None:
        self.config, self.overrides = config, list(overrides)
        for name, least in (("seeds", 1), ("full_steps", 0), ("steps", 0)):
            if not isinstance(config[name], int) or config[name] < least:
                raise ValueError(f"{name}={config[name]}: a study takes whole numbers from {least} on")
        self.folder = Path(config.output_dir)
        if config.protocol is not None:
            self._on_protocol(self.folder)
        self.full_splits = int(config.model.gaussians.splits)
        self.runs = continuations(config.variants, config.splits, self.full_splits)
        self.results: dict[str, dict[int, Metrics]] = {name: {} for name in self.runs}
        self.diverged: list[str] = []

    def run(self) -> None:
        """Runs all unfinished runs; FloatingPointError if a full model diverges. Other divergences are recorded."""
        config = self.config
        scored = config.protocol is None
        for seed in range(config.seeds):
            home = self.folder / f"seed-{seed}"
            print(f"[seed {seed + 1}/{config.seeds}] the full model, {config.full_steps} steps", flush=True)
            begin = [f"init_from={quoted(Path(config.init_from))}"] if config.init_from else []
            overrides = [*self.overrides, *begin, f"seed={seed}", f"trainer.max_steps={config.full_steps}"]
            run_once(overrides, home / "start", scored)
            start = final_checkpoint(home / "start", config.full_steps)
            for name in self.runs:
                print(f"[seed {seed + 1}/{config.seeds}] {_label(name)}, {config.steps} steps more", flush=True)
                try:
                    self.results[name][seed] = self._go_on(name, seed, start, home)
                except FloatingPointError as error:
                    self.diverged.append(f"{_label(name)}, seed {seed}")
                    log.error("%s diverged: %s", self.diverged[-1], error)
                self.write()

    def _go_on(self, name: str, seed: int, start: Path, home: Path) -> Metrics:
        if name == CONTROL:
            cut = home / "start" / "without_last_layer.ckpt"
            start = write_part(start, cut, lambda tensor: not tensor.startswith(_LAST_LAYER))
        overrides = [*self.overrides, *self.runs[name], f"seed={_CONTINUATION_SEED + seed}"]
        overrides += [f"trainer.max_steps={self.config.steps}", f"optimizer.lr={self.config.lr}"]
        folder = home / name.replace("=", "-")
        metrics = run_once([*overrides, f"init_from={quoted(start)}"], folder, self.config.protocol is None)
        return metrics if self.config.protocol is None else _figures(evaluate(self._on_protocol(folder)))

    def _on_protocol(self, folder: Path) -> DictConfig:
        """Composes the configuration that evaluates the run in ``folder`` on the protocol."""
        name = self.config.protocol
        settled = ("name=protocol", f"ckpt={quoted(folder)}", f"output_dir={quoted(folder / name)}")
        config = compose("evaluate", f"evaluation={name}", "views=10", *self.config.protocol_overrides, *settled)
        if len(view_counts(config.views)) > 1:
            raise ValueError(
                f"protocol_overrides: views={config.views}, but a study has one row a run: give one number"
            )
        return config

    def write(self) -> None:
        """Writes ``metrics.json`` and ``metrics.md``."""
        config = self.config
        content = {
            **{name: config[name] for name in ("seeds", "full_steps", "steps", "lr", "init_from")},
            "overrides": self.overrides,
            "protocol": [config.protocol, *config.protocol_overrides],
            "diverged": self.diverged,
            "runs": {name: {str(seed): m for seed, m in runs.items()} for name, runs in self.results.items()},
            "summary": summarize(self.results, FULL),
            "paper": {table: tables()[table][_PAPER_DATA] for table in (_PAPER_ABLATION, _PAPER_SPLIT)},
        }
        write_json(self.folder / "metrics.json", content)
        write_text(self.folder / "metrics.md", self.report())

    def report(self) -> str:
        """Both tables as Markdown, the paper's rows next to ours, and the differences to the full model."""
        splits = {f"splits={count}": self._run_of(count) for count in self.config.splits}
        splits |= {CONTROL: CONTROL} if CONTROL in self.results else {}
        parts = [
            "# Ablations",
            self._protocol(),
            "## Components",
            _beside_paper(self.results, {name: name for name in (*self.config.variants, FULL)}),
            "## Splits",
            _beside_paper(self.results, splits),
            "## More figures of the same runs",
            seeds_table({_label(name): runs for name, runs in self.results.items()}, _OUR_COLUMNS),
            "## Differences to the full model, seed by seed",
            _differences(self.results, FULL),
        ]
        if CONTROL in self.results:
            parts += [
                "## Differences to the full model with a new last layer, seed by seed",
                _differences({name: runs for name, runs in self.results.items() if _has_new_layer(name)}, CONTROL),
            ]
        return "\n\n".join(parts) + "\n"

    def _run_of(self, count: int) -> str:
        """The name of the run with a number of splits."""
        if count == self.full_splits:
            return FULL
        return f"splits={count}" if f"splits={count}" in self.runs else "wo_split"

    def _protocol(self) -> str:
        """What the tables show, for their reader."""
        config = self.config
        done = min(map(len, self.results.values()))
        diverged = f" Diverged: {'; '.join(self.diverged)}." if self.diverged else ""
        begin = f" from {config.init_from}" if config.init_from else ""
        scenes = ", depth aligned by one median scale per scene"
        if config.protocol is not None:
            overrides = " ".join(config.protocol_overrides)
            scenes = f", as in vg2gt evaluate evaluation={config.protocol} {overrides}".rstrip()
            scenes += "; rows with context: the input views again, as the authors' code reports"
        return (
            f"Full model {config.full_steps} steps{begin}, then every row {config.steps} steps more from it, at a "
            f"learning rate of {config.lr:g}, with the same batches. {done} of {config.seeds} seeds complete;"
            f"{diverged} mean ± 95 % confidence interval over seeds (Student's t). Seeds differ in weights and "
            "batches, not in the held-out scenes; every difference is judged by itself. Views never trained on, at "
            f"ground-truth poses{scenes}; depth rendered as stochastic solids, that of the 3DGS row too. A changed "
            "number of splits makes the last layer new; the control shows what that alone costs. The paper's rows are "
            "Replica, 10 views, 30000 more steps: compare orders, not values. LPIPS is measured on a protocol only."
        )


def _figures(report: Mapping[str, Any]) -> Metrics:
    """The metrics of an evaluation's report that the tables show, by their names in training."""
    ((_, views),) = report["views"].items()
    names = (*_PAPER_COLUMNS, *_CONTEXT_COLUMNS, *_OUR_COLUMNS)
    found = {name: views["mean"].get(_PATHS.get(name, _GT_POSE + name)) for name in names}
    return {name: value for name, value in found.items() if value is not None}


def _label(name: str) -> str:
    return _LABELS.get(name, name)


def _beside_paper(results: Mapping[str, Mapping[int, Metrics]], rows: Mapping[str, str]) -> str:
    """Our rows, on a protocol also of the input views, each followed by the paper's; ``rows``: names to runs."""
    ablation, split = (tables()[table][_PAPER_DATA] for table in (_PAPER_ABLATION, _PAPER_SPLIT))
    lines = []
    for name, run in rows.items():
        lines.append([_label(name), *seeds_row(results[run], _PAPER_COLUMNS)])
        if any("context/psnr" in metrics for metrics in results[run].values()):
            lines.append([f"{_label(name)}, context", *seeds_row(results[run], _CONTEXT_COLUMNS)])
        theirs = {FULL: "VG2GT (full)", "splits=1": "w/o split"}.get(name, _label(name).replace("splits", "split"))
        paper = (split if name.startswith("splits=") else ablation).get(theirs)
        if paper:
            lines.append(["*paper*", *(f"*{paper[metric]:g}*" for metric in _PAPER_COLUMNS)])
    return markdown_table(["", *(metric.label for metric in _PAPER_COLUMNS.values())], lines)


def _differences(results: Mapping[str, Mapping[int, Metrics]], reference: str) -> str:
    """Each run minus the reference, for metrics that all runs have; says whether the interval excludes zero."""
    every = [metrics for runs in results.values() for metrics in runs.values()]
    shown = {
        name: m for name, m in (_PAPER_COLUMNS | _OUR_COLUMNS).items() if all(name in metrics for metrics in every)
    }
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
    keys = [override.split("=")[0].lstrip("+~") for override in overrides]
    if settled := [key for key in keys if key in _SETTLED_KEYS]:
        raise ValueError(f"{settled[0]} is decided by the study; its own keys are {', '.join(_OWN_KEYS)}")
    return [override for override, key in zip(overrides, keys, strict=True) if key not in _OWN_KEYS]


def run_study(config: DictConfig) -> None:
    """Runs the study of ``ablate.yaml`` and prints its tables.

    Raises:
        ValueError: if the model has no splits, or an option is wrong.
        SystemExit: if a continuation diverged.
    """
    if "splits" not in (config.model.get("gaussians") or {}) or config.trainer.devices != 1:
        raise ValueError("ablations need a model with splits (model=tiny or model=vg2gt) and trainer.devices=1")
    study = Ablation(config, common_overrides(HydraConfig.get().overrides.task))
    study.run()
    print(study.report())
    print(f"metrics: {study.folder / 'metrics.json'}")
    if study.diverged:
        raise SystemExit(f"diverged, not in the tables: {'; '.join(study.diverged)}")
