"""Runs of a study: each is trained once, resumed if interrupted, and compared over seeds."""

from __future__ import annotations

import gc
import hashlib
import logging
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from scipy.stats import t as student

from vg2gt.config import compose, flatten
from vg2gt.evaluation.tables import Metric, markdown_table, number
from vg2gt.io.files import read_json, write_json, write_text
from vg2gt.runs.checkpoints import checkpoint_path, read_checkpoint, write_checkpoint
from vg2gt.runs.untrusted import read_run_config
from vg2gt.training.loop import build, evaluate, train
from vg2gt.training.start import load_start

log = logging.getLogger(__name__)

Metrics = dict[str, float]
INTERRUPTED = 143
# Settings that must be equal for two runs to be the same; folders and logging may differ.
_COMPARED = ("backend", "model", "data", "loss", "renderer", "optimizer", "training", "seed")
_COMPARED_KEYS = ("trainer.max_steps", "trainer.precision", "trainer.gradient_clip_val")
_NOT_COMPARED = ("data.workers", "data.memory_mb", "data.cache_dir")


def compose_run(overrides: Sequence[str], folder: Path) -> DictConfig:
    """Composes the configuration of a training in ``folder``."""
    return compose("train", *overrides, f"output_dir={quoted(folder)}")


def run_once(overrides: Sequence[str], folder: Path, scored: bool = True) -> Metrics:
    """Trains and evaluates one run unless ``folder`` already holds its result; an interrupted run resumes.

    Args:
        overrides: overrides of ``train.yaml``; a run of 0 steps is only evaluated.
        folder: folder of this run.
        scored: whether a run of 0 steps is evaluated, which needs its data.

    Raises:
        ValueError: if the folder holds the run of another configuration, or from other weights.
        SystemExit: if the training was asked to stop (SIGTERM); the same call resumes it.
    """
    config = compose_run(overrides, folder)
    OmegaConf.update(config, "training.rasterized_depth", True, force_add=True)  # studies report it
    _refuse_other_run(config, folder)
    _refuse_other_start(config.init_from, folder)
    result = folder / "metrics.json"
    if result.is_file():
        return read_json(result)["trained"]
    config.ckpt = "auto"
    report = train(config) if config.trainer.max_steps else _without_steps(config, folder, scored)
    gc.collect()  # trainer, module and data are in reference cycles that keep a run's frames in memory
    if not report:
        log.warning("interrupted in %s; run the same command again to resume", folder)
        raise SystemExit(INTERRUPTED)
    return report["trained"]


def _without_steps(config: DictConfig, folder: Path, scored: bool) -> dict[str, Any]:
    """Writes the result of a run of 0 steps: the initial model's metrics, and a checkpoint if it has trained parts."""
    write_text(folder / "config.yaml", OmegaConf.to_yaml(config, resolve=True))
    run = build(config)
    load_start(run.module, config, None)
    metrics = evaluate(run) if scored else {}
    if run.module.model.trained_parameters():
        checkpoint: dict[str, Any] = {"global_step": 0}
        run.module.on_save_checkpoint(checkpoint)
        write_checkpoint(checkpoint, folder / "checkpoints" / "step-0.ckpt")
    report = {"untrained": metrics, "trained": metrics, "steps": 0}
    write_json(folder / "metrics.json", report)
    return report


def _refuse_other_run(config: DictConfig, folder: Path) -> None:
    """Raises ValueError if the folder holds a run with other settings."""
    path = folder / "config.yaml"
    if not path.is_file():
        return
    before, now = (flatten(OmegaConf.to_container(c, resolve=True)) for c in (read_run_config(path), config))
    other = [
        key
        for key in sorted(before.keys() | now.keys())
        if (key.split(".")[0] in _COMPARED or key in _COMPARED_KEYS) and key not in _NOT_COMPARED
        if before.get(key) != now.get(key)
    ]
    if other:
        raise ValueError(
            f"{folder} holds a run with other settings ({', '.join(other)}): choose another name=, repeat the "
            "settings, or delete the whole study"
        )


def _refuse_other_start(init_from: str | None, folder: Path) -> None:
    """Raises ValueError if the folder holds a run that began from other weights; notes their hash if it is new."""
    if init_from is None or not Path(init_from).exists():
        return
    path = checkpoint_path(init_from, "init_from")
    assert path is not None
    digest, noted = hashlib.sha256(path.read_bytes()).hexdigest(), folder / "init_from.sha256"
    if noted.is_file() and noted.read_text().strip() != digest:
        read_checkpoint(path)  # raises if it is damaged
        raise ValueError(f"{folder} holds a run from other weights than {init_from}: choose another name=")
    write_text(noted, digest + "\n")


def final_checkpoint(folder: Path, steps: int) -> Path:
    """Returns the last checkpoint of a finished run of ``steps`` steps."""
    return folder / "checkpoints" / f"step-{steps}.ckpt"


def write_part(start: Path, path: Path, keep: Callable[[str], bool]) -> Path:
    """Writes a checkpoint for ``init_from`` with the tensors whose names ``keep`` accepts; replaces ``path``."""
    state = read_checkpoint(start)["state_dict"]
    write_checkpoint({"state_dict": {name: tensor for name, tensor in state.items() if keep(name)}}, path)
    return path


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds, and half the width of its 95 % confidence interval (Student's t); NaN for a single value."""

    mean: float
    margin: float

    def shown(self, decimals: int, sign: bool = False) -> str:
        """``mean ± margin``; the margin is left out if it is not finite."""
        text = number(self.mean, decimals, sign)
        return f"{text} ± {self.margin:.{decimals}f}" if math.isfinite(self.margin) else text


def estimate(values: Sequence[float]) -> Estimate:
    """Mean and 95 % confidence interval of independent values; NaN without values."""
    if len(values) < 2:
        return Estimate(values[0] if values else math.nan, math.nan)
    margin = student.ppf(0.975, len(values) - 1) * statistics.stdev(values) / math.sqrt(len(values))
    return Estimate(statistics.fmean(values), float(margin))


def over_seeds(runs: Mapping[int, Metrics], metric: str) -> Estimate:
    """Estimates one metric over the seeds; NaN if any run lacks it."""
    return estimate([run[metric] for run in runs.values()] if all(metric in run for run in runs.values()) else [])


def paired_difference(runs: Mapping[int, Metrics], reference: Mapping[int, Metrics], metric: str) -> Estimate:
    """Estimates ``runs - reference`` of one metric, paired by seed, so that effects of the seed cancel."""
    seeds = [s for s in runs if s in reference and metric in runs[s] and metric in reference[s]]
    return estimate([runs[s][metric] - reference[s][metric] for s in seeds])


def summarize(results: Mapping[str, Mapping[int, Metrics]], reference: str) -> dict[str, dict[str, dict[str, float]]]:
    """Returns the finite values of the tables: ``{run: {metric: {mean, ci95, difference, difference_ci95}}}``."""
    summary: dict[str, dict[str, dict[str, float]]] = {}
    for name, runs in results.items():
        for metric in sorted(set.intersection(*map(set, runs.values()))) if runs else ():
            value, change = over_seeds(runs, metric), paired_difference(runs, results.get(reference, {}), metric)
            figures = {"mean": value.mean, "ci95": value.margin}
            figures |= {"difference": change.mean, "difference_ci95": change.margin}
            finite = {key: figure for key, figure in figures.items() if math.isfinite(figure)}
            summary.setdefault(name, {})[metric] = finite
    return summary


def seeds_table(results: Mapping[str, Mapping[int, Metrics]], shown: Mapping[str, Metric]) -> str:
    """Formats a Markdown table of means over the seeds, one row per run."""
    return markdown_table(
        ["", *(metric.label for metric in shown.values())],
        [[name, *seeds_row(runs, shown)] for name, runs in results.items()],
    )


def seeds_row(runs: Mapping[int, Metrics], shown: Mapping[str, Metric]) -> list[str]:
    """Formats the means of one run over its seeds as table cells."""
    return [over_seeds(runs, name).shown(metric.decimals) for name, metric in shown.items()]


def quoted(path: Path) -> str:
    """Quotes a path as a value in a Hydra override."""
    return "'" + str(path).replace("'", "\\'") + "'"
