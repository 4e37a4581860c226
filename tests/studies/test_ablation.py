"""The ablation study at the size of a test: a full model of two steps, continuations of one."""

import json
import math
import re
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

import vg2gt.studies.ablation
import vg2gt.studies.study
from tests.commands import printed
from tests.training_helpers import SMALL
from vg2gt.config import compose
from vg2gt.evaluation.tables import METRICS
from vg2gt.runs.checkpoints import newest, read_checkpoint, write_checkpoint
from vg2gt.studies.ablation import CONTROL, FULL, Ablation, _verdict, common_overrides, continuations
from vg2gt.studies.study import _refuse_other_start, estimate, over_seeds, paired_difference

QUIET = [override for override in SMALL if not override.startswith("trainer.max_steps")]


def study(folder: Path, cache: Path, *overrides: str, common: Sequence[str] = QUIET, **own: object) -> Ablation:
    """A study of one variant, of one seed; ``own`` are keys of ``ablate.yaml``."""
    keys = {"seeds": 1, "full_steps": 2, "steps": 1, "lr": 1e-4, "variants": "[wo_split]", "splits": "[1,2]"} | own
    given = [*common, *([f"data.cache_dir={cache}"] if common is QUIET else []), *overrides]
    own_keys = [f"{key}={value}" for key, value in keys.items()]
    return Ablation(compose("ablate", f"output_dir={folder}", *own_keys, *given), given)


def unpadded(report: str) -> str:
    """Tables whose cells have one space at their sides."""
    return re.sub(" +", " ", report)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """What :func:`study` does, by the command."""
    folder = tmp_path_factory.mktemp("ablation")
    short = ["name=short", "seeds=1", "full_steps=2", "steps=1", "lr=1e-4", "variants=[wo_split]", "splits=[1,2]"]
    assert "w/o Split" in printed(shlex.join(["vg2gt", "ablate", *short, *QUIET, f"data.cache_dir={cache}"]), folder)
    return folder / "outputs" / "short"


@pytest.fixture
def folder(tmp_path: Path, finished: Path) -> Path:
    """A copy of the finished study that a test may change."""
    return shutil.copytree(finished, tmp_path / "copy")


def test_every_row_is_run_once() -> None:
    names = list(continuations(["wo_depth", "wo_split"], [1, 2, 3, 4], full_splits=2))
    assert names == [FULL, "wo_depth", "wo_split", "splits=3", "splits=4", CONTROL]
    assert list(continuations([], [1, 2], full_splits=4)) == [FULL, "splits=1", "splits=2", CONTROL]
    assert list(continuations(["wo_depth"], [2], full_splits=2)) == [FULL, "wo_depth"]


def test_results_and_tables(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert set(metrics["runs"]) == {FULL, "wo_split", CONTROL}
    assert all(set(runs) == {"0"} for runs in metrics["runs"].values())
    full, variant = (metrics["runs"][name]["0"] for name in (FULL, "wo_split"))
    assert variant["gaussians"] < 0.7 * full["gaussians"]
    difference = metrics["summary"]["wo_split"]["abs_rel"]["difference"]
    assert difference == pytest.approx(variant["abs_rel"] - full["abs_rel"])
    report = unpadded((finished / "metrics.md").read_text())
    assert "| w/o Split |" in report
    assert "| *paper* | *28.19* | *0.865* |" in report
    assert "| splits=2 |" in report
    assert "1 of 1 seeds complete" in report
    assert "n/a" in report  # LPIPS where it was not measured


def test_all_continue_from_the_same_full_model(finished: Path) -> None:
    """The full model trains as long as every variant, and only a new last layer starts from scratch."""
    home = finished / "seed-0"
    start = read_checkpoint(newest(home / "start" / "checkpoints"))
    assert start["global_step"] == 2
    layer = "model.gaussians.out.weight"
    untrained = json.loads((home / "full" / "untrained.json").read_text())
    assert untrained == json.loads((home / "start" / "metrics.json").read_text())["trained"]
    for name in (FULL, "wo_split", CONTROL):
        end = read_checkpoint(newest(home / name / "checkpoints"))
        assert end["global_step"] == 1
        hidden = "model.gaussians.hidden.weight"
        moved = (end["state_dict"][hidden] - start["state_dict"][hidden]).abs().max()
        assert 0 < float(moved) < 5e-3
        if name == CONTROL:
            assert float((end["state_dict"][layer] - start["state_dict"][layer]).abs().max()) > 0.02


def test_finished_runs_are_not_repeated(finished: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vg2gt.studies.study, "train", lambda config: pytest.fail(f"trained {config.output_dir}"))
    again = study(finished, cache)
    again.run()
    assert {name: set(runs) for name, runs in again.results.items()} == {name: {0} for name in again.results}


def test_interrupted_run_goes_on(folder: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was saved is used: the result equals the uninterrupted one's."""
    before = json.loads((folder / "seed-0" / "start" / "metrics.json").read_text())
    (folder / "seed-0" / "start" / "metrics.json").unlink()
    trained: list[str] = []
    train = vg2gt.studies.study.train

    def watched(config):
        trained.append(f"{Path(config.output_dir).name} ckpt={config.ckpt}")
        return train(config)

    monkeypatch.setattr(vg2gt.studies.study, "train", watched)
    study(folder, cache).run()
    assert trained == ["start ckpt=auto"]
    assert json.loads((folder / "seed-0" / "start" / "metrics.json").read_text()) == before


def test_other_settings_are_refused(finished: Path, cache: Path) -> None:
    with pytest.raises(ValueError, match=r"trainer\.max_steps.*choose another name="):
        study(finished, cache, steps=3).run()
    with pytest.raises(ValueError, match=r"start holds a run with other settings \(loss\.enhance\.weight\)"):
        study(finished, cache, "loss.enhance.weight=2").run()


def test_runs_from_other_weights_are_refused(tmp_path: Path) -> None:
    weights = tmp_path / "a.ckpt"
    for _ in range(2):
        write_checkpoint({"state_dict": {"a": torch.zeros(1)}}, weights)
        _refuse_other_start(str(weights), tmp_path)
    write_checkpoint({"state_dict": {"a": torch.ones(1)}}, weights)
    with pytest.raises(ValueError, match=r"from other weights than .*choose another name="):
        _refuse_other_start(str(weights), tmp_path)


def test_a_full_model_whose_end_is_lost_is_refused(folder: Path, cache: Path) -> None:
    """Its last checkpoint is damaged: variants must not go on from an earlier one."""
    newest(folder / "seed-0" / "start" / "checkpoints").write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"step-2\.ckpt is damaged"):
        study(folder, cache).run()


def test_one_that_diverges_does_not_stop_the_others(folder: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(folder / "seed-0" / "wo_split")

    def diverge(config):
        raise FloatingPointError(f"20 steps in a row in {config.output_dir}")

    monkeypatch.setattr(vg2gt.studies.study, "train", diverge)
    again = study(folder, cache)
    again.run()
    assert again.diverged == ["w/o Split, seed 0"]
    assert {name for name, runs in again.results.items() if runs} == {FULL, CONTROL}
    report = unpadded((folder / "metrics.md").read_text())
    assert "Diverged: w/o Split, seed 0." in report
    assert re.search(r"\| w/o Split \| n/a \|", report)


def test_splits_are_compared_with_the_control(tmp_path: Path, cache: Path) -> None:
    """A new last layer costs 1 dB here; two fewer splits cost nothing beyond that."""
    some = study(tmp_path, cache)
    for seed in range(3):
        psnr = {FULL: 27.0 + seed, "wo_split": 26.0 + seed + 0.01 * (seed - 1), CONTROL: 26.0 + seed}
        some.results |= {name: some.results[name] | {seed: {"psnr": value}} for name, value in psnr.items()}
    _, against_full, against_control = unpadded(some.report()).rsplit("## Differences", 2)
    assert "| w/o Split | -1.00 ± 0.02 (worse) |" in against_full
    assert "| w/o Split | +0.00 ± 0.02 (not told apart) |" in against_control
    assert "| VG²GT (full) |" not in against_control


def test_verdicts() -> None:
    full = {seed: {"psnr": 25.0 + seed, "abs_rel": 0.02, "gaussians": 10.0} for seed in range(3)}
    other = {seed: {"psnr": 24.0 + seed + 0.01 * seed, "abs_rel": 0.02, "gaussians": 5.0 + seed} for seed in range(3)}
    far = {seed: {"abs_rel": 0.02 + 0.01 * (seed - 1)} for seed in range(3)}

    def verdict(runs: dict[int, dict[str, float]], name: str) -> str:
        return _verdict(paired_difference(runs, full, name), METRICS[name])

    assert (verdict(other, "psnr"), verdict(other, "abs_rel")) == ("-0.99 ± 0.02 (worse)", "identical")
    assert verdict(other, "gaussians") == "-4 ± 2"
    assert verdict(far, "abs_rel").endswith("(not told apart)")
    assert verdict({0: {"psnr": 27.0}}, "psnr") == "+2.00"


def test_given_weights_on_a_protocol(finished: Path, tmp_path: Path, cache: Path, monkeypatch) -> None:
    """Without a step of training: every variant of the given weights is scored as ``vg2gt evaluate`` scores it."""
    monkeypatch.setattr(vg2gt.studies.study, "train", lambda config: pytest.fail(f"trained {config.output_dir}"))
    given = newest(finished / "seed-0" / "start" / "checkpoints")
    scenes = ["views=2", "data.image_size=[28,56]", "data.eval_scenes=1", "data.num_frames=8"]
    scenes += [f"data.cache_dir={cache}", "evaluation.selection.index=null"]
    own = {"full_steps": 0, "steps": 0, "splits": "[2]", "init_from": given, "protocol": "synthetic"}
    bare = [override for override in QUIET if not override.startswith("data.")]
    bare += ["data=replica", "data.root=/nowhere"]  # the training's data is not needed
    some = study(tmp_path, cache, common=bare, **own, protocol_overrides=scenes)
    some.run()
    for run in (FULL, "wo_split"):
        report = json.loads((tmp_path / "seed-0" / run / "synthetic" / "metrics.json").read_text())
        mean = report["views"]["2"]["mean"]
        assert some.results[run][0]["psnr"] == mean["rendered/gt_pose/solid/psnr"]
        assert some.results[run][0]["context/psnr"] == mean["rendered/context/solid/psnr"]
        assert some.results[run][0]["gaussians"] == mean["scene/gaussians"]
        weights = read_checkpoint(newest(tmp_path / "seed-0" / run / "checkpoints"))["state_dict"]
        kept = read_checkpoint(given)["state_dict"]
        assert torch.equal(weights["model.gaussians.hidden.weight"], kept["model.gaussians.hidden.weight"])
    assert some.results["wo_split"][0]["gaussians"] < 0.7 * some.results[FULL][0]["gaussians"]
    assert "as in vg2gt evaluate evaluation=synthetic views=2" in some.report()
    shown = some.results["wo_split"][0]["context/psnr"]
    assert f"| w/o Split, context | {shown:.2f} |" in unpadded(some.report())
    assert f"Full model 0 steps from {given}, then every row" in some.report()
    with pytest.raises(ValueError, match=r"protocol_overrides: views=\[3, 10\].*give one number"):
        study(tmp_path, cache, **own, protocol_overrides=["views=[3,10]"])


def test_what_the_study_decides_cannot_be_overridden() -> None:
    given = ["seeds=2", "backend=da3_small", "+data.x=1", "init_from=some.ckpt"]
    assert common_overrides(given) == ["backend=da3_small", "+data.x=1"]
    with pytest.raises(ValueError, match=r"trainer\.max_steps is decided by the study"):
        common_overrides(["trainer.max_steps=7"])


def test_numbers_are_checked_first(tmp_path: Path, cache: Path) -> None:
    for name, value in (("seeds", 0), ("seeds", "abc"), ("steps", 1.5), ("full_steps", -1)):
        with pytest.raises(ValueError, match=f"{name}=.*: a study takes whole numbers from [01] on"):
            study(tmp_path, cache, **{name: value})


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
