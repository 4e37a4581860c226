"""Whole evaluations of two small rooms."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from tests.evaluation.conftest import evaluate_overrides, without_cost
from tests.training_helpers import small_config
from vg2gt.cli.evaluate import run_name
from vg2gt.config import compose
from vg2gt.data.base import DataError
from vg2gt.evaluation.evaluator import SceneEvaluator
from vg2gt.evaluation.run import evaluate
from vg2gt.runs.checkpoints import read_checkpoint, write_checkpoint
from vg2gt.runs.load import SHIPPED
from vg2gt.runs.untrusted import read_run_config
from vg2gt.training.loop import train


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    folder = tmp_path_factory.mktemp("run") / "outputs" / "tiny"
    train(small_config(folder, cache, "trainer.max_steps=2"))
    return folder


def run(folder: Path, cache: Path, *overrides: str) -> dict[str, Any]:
    return evaluate(compose("evaluate", *evaluate_overrides(folder, cache, *overrides)))


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory, trained: Path, cache: Path) -> Path:
    folder = tmp_path_factory.mktemp("evaluated")
    run(folder, cache, f"ckpt={trained}")
    return folder


@pytest.fixture
def copied(tmp_path: Path, trained: Path) -> Path:
    """A copy of the trained run that a test may change."""
    return shutil.copytree(trained, tmp_path / "run")


@pytest.fixture
def joined(tmp_path: Path, evaluated: Path) -> Path:
    """A copy of the evaluation that a test may add to."""
    return shutil.copytree(evaluated, tmp_path / "copy")


def test_an_evaluation_writes_its_results(evaluated: Path, trained: Path) -> None:
    report = json.loads((evaluated / "metrics.json").read_text(), parse_constant=pytest.fail)
    result = report["views"]["2"]
    assert set(result["scenes"]) == {"room-1000000", "room-1000001"}
    values = [scores["rendered/gt_pose/solid/psnr"] for scores in result["scenes"].values()]
    assert result["mean"]["rendered/gt_pose/solid/psnr"] == pytest.approx(sum(values) / 2)
    assert report["settings"]["weights"] == f"{trained / 'checkpoints' / 'step-2.ckpt'} (step 2)"
    assert "## Rendered depth" in (evaluated / "metrics.md").read_text()
    config = OmegaConf.load(evaluated / "config.yaml")
    assert config.model._target_ == "vg2gt.model.VG2GT"
    assert config.backend._target_ == "backends.oracle.OracleBackend"


def test_the_untrained_head_says_so_and_scores_otherwise(tmp_path: Path, cache: Path, evaluated: Path, capsys) -> None:
    report = run(tmp_path, cache)
    assert report["settings"]["weights"] == "none: the head is untrained"
    assert "weights: none: the head is untrained" in capsys.readouterr().out
    mean = report["views"]["2"]["mean"]
    other = json.loads((evaluated / "metrics.json").read_text())["views"]["2"]["mean"]
    assert mean["rendered/gt_pose/solid/psnr"] != other["rendered/gt_pose/solid/psnr"]
    assert mean["decoded/before/abs_rel"] == pytest.approx(other["decoded/before/abs_rel"])


def test_an_interrupted_evaluation_goes_on(tmp_path, cache, trained, evaluated, monkeypatch):
    original, seen = SceneEvaluator.__call__, []

    def counted(self, batch):
        seen.append(batch.scene[0])
        if len(seen) == 2:
            raise InterruptedError("simulated crash")
        return original(self, batch)

    monkeypatch.setattr(SceneEvaluator, "__call__", counted)
    with pytest.raises(InterruptedError):
        run(tmp_path, cache, f"ckpt={trained}")
    assert not (tmp_path / "metrics.json").exists()
    report = run(tmp_path, cache, f"ckpt={trained}")
    assert seen == ["room-1000000", "room-1000001", "room-1000001"]
    whole = json.loads((evaluated / "metrics.json").read_text())
    for scene, scores in whole["views"]["2"]["scenes"].items():
        assert without_cost(report["views"]["2"]["scenes"][scene]) == without_cost(scores)


def test_more_scenes_views_and_pictures_join_other_settings_do_not(cache: Path, trained: Path, joined: Path) -> None:
    report = run(joined, cache, f"ckpt={trained}", "views=[1,2]", "data.eval_scenes=1", "evaluation.pictures=1")
    assert set(report["views"]) == {"1", "2"}
    assert sorted(p.name for p in (joined / "pictures").iterdir()) == ["room-1000000-1.png", "room-1000000-2.png"]
    assert "cameras/auc_5" not in report["views"]["1"]["mean"]
    with pytest.raises(FileExistsError, match=r"evaluation\.alignment \(median -> scene\)"):
        run(joined, cache, f"ckpt={trained}", "evaluation.alignment=scene")
    with pytest.raises(FileExistsError, match=r"checkpoint\.sha256"):
        run(joined, cache)
    identity = json.loads((joined / "identity.json").read_text())
    (joined / "identity.json").write_text(json.dumps(identity | {"device": "Some GPU"}))
    with pytest.raises(FileExistsError, match=r"device \(Some GPU -> cpu\)"):
        run(joined, cache, f"ckpt={trained}")
    run(joined, cache, f"ckpt={trained}", "data.eval_scenes=1", "overwrite=true")
    assert len(list((joined / "scenes" / "2").iterdir())) == 1


def test_refined_rows_stand_apart_and_the_papers_not_beside_other_data(tmp_path, cache, trained, joined) -> None:
    few = [f"ckpt={trained}", "data.eval_scenes=1", "views=[3]", "evaluation.table=replica"]
    report = run(tmp_path, cache, *few, "evaluation.refine=2")
    assert report["settings"]["paper"] is None
    mean = report["views"]["3"]["mean"]
    assert mean["refined/rendered/gt_pose/solid/psnr"] != mean["rendered/gt_pose/solid/psnr"]
    text = (tmp_path / "metrics.md").read_text()
    assert "optimised on the input views, 2 steps; not feed-forward" in text
    assert "| 3, refined | gt_pose " in text
    assert "refine [s]" in text
    assert "the paper's rows are left out: the data is read by SyntheticScenes" in text
    assert "tbl_" not in text
    with pytest.raises(FileExistsError, match=r"evaluation\.refine \(2 -> "):
        run(tmp_path, cache, *few, "evaluation.refine=3")
    # Where nothing is refined, options of refinement decide nothing.
    run(joined, cache, f"ckpt={trained}", "refine.rates.sh=1")
    assert "refined" not in (joined / "metrics.md").read_text()


def test_a_model_without_a_trained_part(tmp_path: Path, cache: Path) -> None:
    report = run(tmp_path, cache, "model=pointcloud", "data.eval_scenes=1")
    assert report["settings"]["weights"] == "none: the model has no trained part"
    assert report["views"]["2"]["mean"]["scene/gaussians_per_pixel"] == 1


def test_what_the_weights_or_those_before_were_trained_on_is_refused(tmp_path, cache, trained, copied, caplog):
    """Also a run on other rooms that began with ``init_from``, or went on in a new folder with ``ckpt``."""

    def trained_on(first_seed: int, **start: Path) -> None:
        config = read_run_config(trained / "config.yaml")
        config.data.train.first_seed = first_seed
        config.update({key: str(path) for key, path in start.items()})
        OmegaConf.save(config, copied / "config.yaml")

    begun = trained / "checkpoints" / "step-2.ckpt"
    for first_seed, start in ((0, {}), (500, {"init_from": begun}), (500, {"ckpt": trained})):
        trained_on(first_seed, **start)
        with pytest.raises(DataError, match="scene room-000000 is used for training and for evaluation"):
            run(tmp_path / "out", cache, f"ckpt={copied}", "data.val.first_seed=0")
    trained_on(500, ckpt=tmp_path / "gone.ckpt")
    run(tmp_path / "out", cache, f"ckpt={copied}", "data.eval_scenes=1")
    assert "cannot check whether" in caplog.text
    assert "gone.ckpt, which is not there" in caplog.text


def test_a_lone_checkpoint_is_not_checked_and_that_is_told(tmp_path: Path, cache: Path, trained: Path, caplog) -> None:
    shutil.copy(trained / "checkpoints" / "step-2.ckpt", tmp_path / "lone.ckpt")
    parts = read_run_config(trained / "config.yaml")
    config = compose("evaluate", *evaluate_overrides(tmp_path / "out", cache, "data.eval_scenes=1"))
    OmegaConf.set_struct(config, False)
    config.ckpt = str(tmp_path / "lone.ckpt")
    for part in ("model", "backend", "renderer"):
        config[part] = parts[part]
    evaluate(config)
    assert "cannot check whether the evaluated scenes were used for training" in caplog.text


def test_a_shipped_model_is_found_by_its_name(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Path | None] = []

    def resolve(config: object, checkpoint: Path | None) -> None:
        asked.append(checkpoint)
        raise InterruptedError

    monkeypatch.setattr("vg2gt.evaluation.run.resolve_parts", resolve)
    with pytest.raises(InterruptedError):
        run(tmp_path, cache, "ckpt=sweep-tiny")
    assert asked == [SHIPPED]


def test_what_is_missing_or_wrong_is_named(tmp_path: Path, cache: Path, trained: Path) -> None:
    with pytest.raises(FileNotFoundError, match="ckpt=nowhere: no such checkpoint or run"):
        run(tmp_path, cache, "ckpt=nowhere")
    lone = tmp_path / "lone.ckpt"
    old = read_checkpoint(trained / "checkpoints" / "step-2.ckpt")
    del old["config"]  # checkpoints of old did not know how their model was made
    write_checkpoint(old, lone)
    with pytest.raises(ValueError, match=r"stores no configuration: set model=, backend= and renderer="):
        run(tmp_path, cache, f"ckpt={lone}")
    for views in ("[]", "null", "2.5", "three", "[0]", "[true]"):
        with pytest.raises(ValueError, match="give numbers of input views"):
            run(tmp_path, cache, f"views={views}")
    (tmp_path / "empty" / "checkpoints").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=r"ckpt=.*empty: no such checkpoint or run.*null for none"):
        run(tmp_path, cache, f"ckpt={tmp_path / 'empty'}")
    for device in ("banana", "cuda:99"):
        with pytest.raises(ValueError, match=f"device={device} is not available"):
            run(tmp_path, cache, f"device={device}")
    with pytest.raises(FileNotFoundError, match=r"LPIPS weights not found at /nowhere/vgg\.pth"):
        run(tmp_path, cache, "evaluation.lpips=/nowhere/vgg.pth")
    with pytest.raises(DataError, match=r"has 32 frames .* views=33 needs 33"):
        run(tmp_path, cache, "views=[33]")


def test_what_is_not_an_evaluations_is_left_as_it_is(tmp_path, cache, trained, copied) -> None:
    for more in ([], ["overwrite=true"]):
        with pytest.raises(FileExistsError, match=r"holds metrics\.json, .*config\.yaml, which do not belong"):
            run(copied, cache, f"ckpt={copied}", "data.eval_scenes=1", *more)
    for name in ("config.yaml", "metrics.json", "metrics.md"):
        assert (copied / name).read_bytes() == (trained / name).read_bytes()
    (tmp_path / "out" / "scenes" / "own").mkdir(parents=True)
    with pytest.raises(FileExistsError, match="holds scenes, which do not belong"):
        run(tmp_path / "out", cache, "data.eval_scenes=1", "overwrite=true")
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name != ".lock"] == ["scenes"]


def test_the_folder_is_named_after_the_run() -> None:
    run_folder = "outputs/quickstart"
    names = {None: "untrained", run_folder: "quickstart", f"{run_folder}/checkpoints/step-400.ckpt": "quickstart"}
    names |= {"/data/outputs/wo_depth/": "wo_depth", "../other/mine.ckpt": "other", "mine.ckpt": "mine"}
    assert {ckpt: run_name(ckpt) for ckpt in names} == names
