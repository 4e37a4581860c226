"""Statistics over seeds, against scipy and by hand."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from vg2gt.evaluation.tables import columns
from vg2gt.runs.checkpoints import read_checkpoint, write_checkpoint
from vg2gt.studies.study import (
    compose_run,
    estimate,
    over_seeds,
    paired_difference,
    quoted,
    seeds_table,
    write_part,
)


def test_estimate_is_the_textbook_interval() -> None:
    values = [0.31, 0.28, 0.35, 0.30]
    found = estimate(values)
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    assert found.mean == pytest.approx(np.mean(values))
    assert found.mean - found.margin == pytest.approx(low)
    assert found.mean + found.margin == pytest.approx(high)


def test_differences_are_taken_seed_by_seed() -> None:
    """What seeds share cancels: a small difference shows although the seeds lie far apart."""
    full = {0: {"psnr": 20.0}, 1: {"psnr": 30.0}, 2: {"psnr": 25.0}, 7: {"psnr": 1.0}}
    variant = {2: {"psnr": 24.5}, 0: {"psnr": 19.4}, 1: {"psnr": 29.6}}
    change = paired_difference(variant, full, "psnr")
    assert change.mean == pytest.approx(-0.5)
    assert change.margin < 0.3
    assert over_seeds(variant, "psnr").margin > 10
    assert math.isnan(paired_difference(variant, full, "lpips").mean)


def test_one_row_per_run() -> None:
    runs = {"full": {0: {"psnr": 20.0}, 1: {"psnr": 30.0}}, "other": {0: {"psnr": 19.0}, 1: {}}}
    table = seeds_table(runs, columns("psnr", decimals={"psnr": 1}))
    assert table.splitlines()[1:] == ["| ----- | ----------: |", "| full  | 25.0 ± 63.5 |", "| other |         n/a |"]


def test_a_part_of_a_checkpoint_leaves_the_rest_anew(tmp_path: Path) -> None:
    start = tmp_path / "start.ckpt"
    write_checkpoint({"state_dict": {"a.x": torch.ones(2), "b.x": torch.zeros(1)}, "global_step": 5}, start)
    part = read_checkpoint(write_part(start, tmp_path / "part.ckpt", lambda name: name.startswith("a.")))
    assert {name: tensor.tolist() for name, tensor in part["state_dict"].items()} == {"a.x": [1.0, 1.0]}


def test_paths_survive_the_override_grammar(tmp_path: Path) -> None:
    folder = tmp_path / "it's a, {run}=[1] \\ of $two"
    assert compose_run([f"name={quoted(folder)}"], folder).output_dir == str(folder)
