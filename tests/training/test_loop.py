"""Whole runs: every ablation, backends, resume, bad input."""

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.commands import shell
from tests.training_helpers import SMALL, full_model, small_config
from vg2gt.data import DataError, Frames, SyntheticScenes
from vg2gt.runs.checkpoints import newest, read_checkpoint
from vg2gt.runs.lock import only_process_in
from vg2gt.training.loop import Run, build, evaluate, train


@pytest.fixture(scope="module")
def full_run(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    folder = tmp_path_factory.mktemp("full")
    train(small_config(folder, cache))
    return folder


VARIANTS = [f"ablation={name}" for name in ("rasterized", "wo_coarse", "wo_split")]
VARIANTS += ["loss=release", "backend=vggt_tiny", "backend=da3_tiny"]


@pytest.mark.parametrize("override", VARIANTS)
def test_fast_dev_run(tmp_path: Path, cache: Path, override: str) -> None:
    report = train(small_config(tmp_path, cache, "trainer.fast_dev_run=true", override))
    assert {"psnr", "abs_rel", "decoded_abs_rel"} <= set(report["trained"])
    assert all(value == value for value in report["trained"].values())
    if override == "ablation=wo_coarse":
        assert report["trained"]["decoded_abs_rel"] == report["trained"]["decoded_abs_rel_before"]


def changed_by(run: Run, module: torch.nn.Module) -> set[str]:
    """Trains, and names what has changed in a module."""
    before = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    run.trainer.fit(run.module, datamodule=run.datamodule)
    return {name for name, tensor in module.state_dict().items() if not torch.equal(tensor, before[name])}


def test_onnx_backend_trains(tmp_path: Path, cache: Path, onnx_bundle: Path) -> None:
    run = build(
        small_config(tmp_path, cache, "trainer.fast_dev_run=true", "backend=onnx", f"backend.path={onnx_bundle}")
    )
    assert changed_by(run, full_model(run).coarse)


def test_a_run_writes_its_results(full_run: Path) -> None:
    metrics = json.loads((full_run / "metrics.json").read_text())
    assert (metrics["steps"], metrics["untrained"].keys()) == (4, metrics["trained"].keys())
    assert "PSNR" in (full_run / "metrics.md").read_text()
    assert (full_run / "preview.png").stat().st_size > 1000
    path = newest(full_run / "checkpoints")
    assert path.name == "step-4.ckpt"
    checkpoint = read_checkpoint(path)
    assert checkpoint["backend"]["name"] == "oracle"
    assert checkpoint["state_dict"]
    assert not [key for key in checkpoint["state_dict"] if ".backend." in key]  # the trained part only


def test_only_the_trained_part_changes(tmp_path: Path, cache: Path) -> None:
    run = build(small_config(tmp_path, cache, "trainer.max_steps=2"))
    changed = changed_by(run, run.module)
    assert any(name.startswith("model.gaussians") for name in changed)
    assert any(name.startswith("model.coarse") for name in changed)
    assert not any(name.startswith("model.backend") for name in changed)
    assert not run.module.model.backend.training


def test_a_run_never_restarts_silently(full_run: Path, cache: Path, tmp_path: Path) -> None:
    with pytest.raises(FileExistsError, match="ckpt=last"):
        train(small_config(full_run, cache))
    with pytest.raises(FileNotFoundError, match="no checkpoint in"):
        train(small_config(tmp_path, cache, "ckpt=last"))
    with pytest.raises(FileNotFoundError, match="nowhere"):
        train(small_config(tmp_path, cache, "ckpt=nowhere.ckpt"))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "step-2.ckpt").write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"step-2\.ckpt is damaged"):
        train(small_config(tmp_path, cache, "ckpt=auto"))
    assert (tmp_path / "checkpoints" / "step-2.ckpt").read_bytes() == b"damaged"


@pytest.fixture
def copied(full_run: Path, tmp_path: Path) -> Path:
    """A finished run of four steps, to be spoilt."""
    return shutil.copytree(full_run, tmp_path / "copied")


def everything_in(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


REFUSED: list[tuple[list[str], str | None]] = [
    (["trainer.fast_dev_run=true", "+model.gaussians.max_offset=3"], None),
    (["trainer.fast_dev_run=true", "ckpt=last", "+backend.seed=1"], "trained on backbone"),
    (["ckpt=last", "+backend.taps=1"], r"step-4\.ckpt was trained with backend\.taps=4, but this run uses 1"),
    (["ckpt=last", "model.gaussians.splits=4"], r"first mismatch: model\.gaussians\.out"),
    (["ckpt=last", "optimizer=adamw"], r"optimizer\._target_=torch\.optim\.AdamW differs from vg2gt\.training\.muon"),
    (["ckpt=last", "optimizer.lr=0.001"], r"optimizer\.lr=0\.001 differs from 0\.004.*optimiser's state.*init_from="),
    (["ckpt=last", "training.part=coarse"], r"training\.part=coarse differs from all"),
    (["ckpt=auto", "trainer.max_steps=3"], r"step-4\.ckpt is at step 4, beyond trainer\.max_steps=3; nothing"),
    *(
        (["overwrite=true", override], message)
        for override, message in {
            "data.workers=-1": r"data\.workers=-1 must be at least 0",
            "data.eval_samples=0": r"data\.eval_samples=0 must be at least 1",
            "+trainer.limit_val_batches=40": r"limit_val_batches=40 counts per device.*use data\.eval_samples",
            "data.eval_scenes=0": r"data\.eval_scenes=0 must be at least 1",
            "optimizer.lr=-1": r"optimizer: Invalid learning rate: -1",
            "optimizer.lr=0": r"optimizer\.lr=0.*a positive number",
            "loss.geometry=null": r"loss\.geometry=null does not turn anything off",
            "+loss.geometry.quantile=0": "greater than 0 and at most 1",
            "training.render_views=0": r"training\.render_views=0.*at least 1, or null for all",
            "+trainer.accumulate_grad_batches=2": "accumulate",
            "+trainer.gradient_clip_algorithm=value": "use norm",
            "init_from=nowhere.ckpt": r"init_from=nowhere\.ckpt: no such checkpoint or run",
        }.items()
    ),
]


@pytest.mark.parametrize(
    ("overrides", "message"), REFUSED, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_trials_and_refused_starts_change_nothing(copied, cache, overrides, message):
    before = everything_in(copied)
    config = small_config(copied, cache, *overrides)
    if message is None:
        train(config)
    else:
        with pytest.raises(Exception, match=message):
            train(config)
    assert everything_in(copied) == before


def test_a_folder_is_one_processs_at_a_time(copied: Path, cache: Path) -> None:
    held = "with only_process_in(sys.argv[1]): print('held', flush=1); input()"
    command = [sys.executable, "-c", f"import sys; from vg2gt.runs.lock import *\n{held}", str(copied)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(BlockingIOError, match="copied is in use by another process"):
            train(small_config(copied, cache, "ckpt=auto"))
        other.kill()
    assert (copied / ".lock").exists()  # of a process that was killed: it holds nothing
    with only_process_in(copied):
        pass
    assert not (copied / ".lock").exists()


def test_a_resumed_run_names_what_changed(copied: Path, cache: Path, caplog) -> None:
    report = train(small_config(copied, cache, "ckpt=last", "trainer.max_steps=5", "loss.enhance.weight=2"))
    assert report["steps"] == 5
    warning = next(r.getMessage() for r in caplog.records if "differs from the interrupted" in r.getMessage())
    assert "loss.enhance.weight" in warning
    assert "trainer.max_steps" in warning
    with pytest.raises(FileExistsError, match="not the newest checkpoint"):
        train(small_config(copied, cache, f"ckpt={copied / 'checkpoints' / 'step-2.ckpt'}"))


def test_wo_split_starts_from_a_full_model(full_run: Path, cache: Path, tmp_path: Path, caplog) -> None:
    checkpoint = newest(full_run / "checkpoints")
    config = small_config(tmp_path, cache, "ablation=wo_split", f"init_from={checkpoint}", "trainer.max_steps=1")
    assert train(config)["steps"] == 1
    fresh = next(record.getMessage() for record in caplog.records if "re-initialised" in record.getMessage())
    assert fresh == "re-initialised layers: model.gaussians.out"


class WithoutDepth(SyntheticScenes):
    """Posed photographs: rooms without depth."""

    has_depth = False

    def load(self, scene: str, frame_ids: Any) -> Frames:
        frames = super().load(scene, frame_ids)
        frames.depth.zero_()
        return frames


class WithoutCameras(SyntheticScenes):
    """Photographs of rooms."""

    has_cameras = False


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("WithoutDepth", "oracle needs the data's depth, and WithoutDepth has none"),
        ("WithoutCameras", "WithoutCameras has no cameras"),
    ],
)
def test_data_that_cannot_be_trained_on_is_refused_before_anything_is_measured(tmp_path, cache, source, said):
    with pytest.raises(DataError, match=said):
        train(small_config(tmp_path, cache, f"data.train._target_={__name__}.{source}"))
    assert not list(tmp_path.iterdir())


def test_posed_photographs_without_depth_are_trained_on(tmp_path: Path, cache: Path) -> None:
    both = [f"data.{part}._target_={__name__}.WithoutDepth" for part in ("train", "val")]
    run = build(small_config(tmp_path, cache, "backend=da3_tiny", "trainer.max_steps=2", *both))
    assert any(name.startswith("gaussians") for name in changed_by(run, run.module.model))
    logged = {name: float(value) for name, value in run.trainer.callback_metrics.items()}
    assert logged["train/scenes_without_depth"] == 1
    assert logged["train/skipped_steps"] == logged["train/depth_gt"] == logged["train/enhance_depth"] == 0
    assert logged["train/color_l1"] > 0
    metrics = evaluate(run)
    assert metrics["psnr"] > 5
    assert "abs_rel" not in metrics


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_other_loggers_get_curves(name, tmp_path, cache, monkeypatch, capsys):
    pytest.importorskip(name)
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    train(small_config(tmp_path, cache, f"logger={name}", "trainer.max_steps=1"))
    assert f"curves: {tmp_path}" in capsys.readouterr().out
    written = [path for pattern in ("*.tfevents.*", "run-*.wandb") for path in tmp_path.rglob(pattern)]
    content = b"".join(path.read_bytes() for path in written if not path.is_symlink())
    assert b"train/grad_norm" in content


@pytest.mark.slow
def test_two_processes_from_the_console_script(tmp_path: Path, cache: Path) -> None:
    overrides = [*SMALL, f"data.cache_dir={cache}", "trainer=ddp", "trainer.max_steps=2", "name=two"]
    shell(shlex.join(["vg2gt", "train", *overrides]), tmp_path)
    assert json.loads((tmp_path / "outputs" / "two" / "metrics.json").read_text())["steps"] == 2
