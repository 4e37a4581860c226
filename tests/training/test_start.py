"""Where a run starts: what a resumed one may change, what it keeps of its past, and initial weights."""

import logging
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from tests.training_helpers import small_config, write_run
from vg2gt.config import compose_groups
from vg2gt.data import DataError, SyntheticScenes
from vg2gt.data.views import SceneSample
from vg2gt.evaluation.checks import refuse_training_views
from vg2gt.runs.load import build_model
from vg2gt.training.loop import build
from vg2gt.training.start import load_start, name_differences, prepare_folder


@pytest.fixture
def model() -> Any:
    groups = compose_groups("backend=oracle", "model=tiny")
    return build_model({"backend": groups.backend, "model": groups.model}, 0, torch.device("cpu"))


def test_a_resumed_run_keeps_what_its_optimiser_holds(tmp_path: Path, cache: Path, caplog) -> None:
    backbone = ["backend=da3_tiny", "optimizer=adamw"]
    old = small_config(tmp_path / "old", cache, *backbone)
    OmegaConf.save(OmegaConf.create(OmegaConf.to_container(old, resolve=True)), tmp_path / "config.yaml")
    checkpoint = tmp_path / "checkpoints" / "step-2.ckpt"
    for override, said in (
        ("optimizer.weight_decay=0.1", r"optimizer\.weight_decay=0\.1 differs from 0\.05"),
        ("~optimizer.betas", r"optimizer\.betas=\[0\.9, 0\.999\] differs from \[0\.9, 0\.95\]"),
        ("backend.freeze=false", r"backend\.freeze=False differs from True.*Keep the old value.*init_from="),
        ("training.backend_lr_factor=1", r"training\.backend_lr_factor=1 differs from 0\.1"),
    ):
        for folder in (tmp_path, tmp_path / "new"):  # in place, or continued elsewhere
            with pytest.raises(ValueError, match=said):
                name_differences(small_config(folder, cache, *backbone, override), checkpoint)
    with caplog.at_level(logging.WARNING):  # the same optimiser on a GPU, another schedule
        name_differences(
            small_config(tmp_path, cache, *backbone, "+optimizer.fused=true", "training.final_lr=1e-4"), checkpoint
        )
    assert "optimizer.fused, training.final_lr" in caplog.text


def test_a_run_of_a_version_that_wrote_more_keys_is_resumed(tmp_path: Path, cache: Path) -> None:
    keys = ["+optimizer.momentum=0.8", "+optimizer.adamw=[coarse]", "+training.max_skipped=20"]
    old = small_config(tmp_path / "old", cache, *keys)
    OmegaConf.save(OmegaConf.create(OmegaConf.to_container(old, resolve=True)), tmp_path / "config.yaml")
    checkpoint = tmp_path / "checkpoints" / "step-2.ckpt"
    name_differences(small_config(tmp_path, cache), checkpoint)
    with pytest.raises(ValueError, match=r"optimizer\.momentum=0\.9 differs from 0\.8"):
        name_differences(small_config(tmp_path, cache, "+optimizer.momentum=0.9"), checkpoint)


def test_scenes_of_every_start_stay_known(tmp_path: Path, cache: Path, model) -> None:
    """A run on rooms from 0, resumed on rooms from 500, is not evaluated on either."""
    folder = write_run(tmp_path / "run", model)
    checkpoint = folder / "checkpoints" / "step-7.ckpt"

    def start(first: int, *overrides: str) -> None:
        config = small_config(folder, cache, f"data.train.first_seed={first}", "data.train_scenes=1", *overrides)
        prepare_folder(config, checkpoint)

    def refused(first: int) -> bool:
        rooms = SyntheticScenes(1, first_seed=first, num_frames=6, size=(28, 56), cache_dir=str(cache))
        try:
            refuse_training_views(checkpoint, rooms, [SceneSample(rooms.scenes[0], (0,), (1,))])
        except DataError:
            return True
        return False

    (folder / "config.yaml").unlink()
    start(0)
    before = (folder / "config.yaml").read_text()
    start(0, "ckpt=last")
    assert not list(folder.glob("config-*.yaml"))
    start(500, "ckpt=last")
    assert (folder / "config-1.yaml").read_text() == before.replace("ckpt: null", "ckpt: last")
    start(900, "ckpt=last")
    assert sorted(path.name for path in folder.glob("config*")) == ["config-1.yaml", "config-2.yaml", "config.yaml"]
    assert [refused(first) for first in (0, 500, 900, 700)] == [True, True, True, False]
    # initial weights count as well, also with a ckpt= of another run
    third = write_run(tmp_path / "third", model)
    prepare_folder(small_config(third, cache, "data.train.first_seed=700", "data.train_scenes=1"), None)
    shutil.copy(checkpoint, third / "checkpoints")  # a new start has deleted its own
    start(900, f"init_from={folder}", f"ckpt={third}")
    start(900, "ckpt=last")
    assert refused(700)
    # a run that replaces this one has no such past
    prepare_folder(small_config(folder, cache), None)
    assert not list(folder.glob("config-*.yaml"))


def test_initial_weights_are_a_file_or_a_runs_folder(tmp_path: Path, cache: Path, model) -> None:
    folder = write_run(tmp_path / "run", model, 0.25)
    expected = model.get_parameter("gaussians.out.bias") + 0.25
    for start in (folder, folder / "checkpoints" / "step-7.ckpt"):
        config = small_config(tmp_path / "new", cache, f"init_from={start}")
        module = build(config).module
        load_start(module, config, None)
        assert torch.equal(module.model.get_parameter("gaussians.out.bias"), expected)
