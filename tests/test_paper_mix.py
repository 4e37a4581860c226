"""The paper's experiment on a miniature of its three datasets."""

import shutil
from pathlib import Path

import pytest
from omegaconf import DictConfig

from tests.data.sources import layout_kitti
from tests.data.sources.layout_infinigen import LAYOUTS as INFINIGEN
from tests.data.sources.layout_scannet import write_export
from tests.data.sources.layouts import room
from vg2gt.config import compose
from vg2gt.training.loop import build, train

TINY = [
    *("backend=oracle", "model=tiny", "trainer=default", "trainer.accelerator=cpu", "trainer.devices=1"),
    *("trainer.precision=32-true", "trainer.max_steps=2", "trainer.enable_progress_bar=false"),
    *("++trainer.log_every_n_steps=1", "callbacks.progress_bar=null", "training.render_views=1"),
    *("data.image_size=[28,56]", "data.max_views=4", "data.max_images=12", "data.eval_context=3"),
    *("data.eval_target=1", "data.scannet_every=1"),
]


@pytest.fixture(scope="module")
def miniature(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One drive, scan and video to train on, others to evaluate."""
    root, frames = tmp_path_factory.mktemp("miniature"), room(8)
    INFINIGEN["infinigen"].write(root / "infinigen", frames)
    layout_kitti.write(root / "kitti", frames)
    layout_kitti.write(root / "other", frames)
    drive = "2011_09_26_drive_0002_sync"
    shutil.move(root / "other" / layout_kitti.DATE / layout_kitti.DRIVE, root / "kitti" / layout_kitti.DATE / drive)
    shutil.move(root / "other" / "train" / layout_kitti.DRIVE, root / "kitti" / "val" / drive)
    for number, part in ((7, "train"), (8, "val")):
        write_export(root / "scannet", frames, f"scene000{number}_00")
        (root / "scannet" / f"scannetv2_{part}.txt").write_text(f"scene000{number}_00\n")
    return root


def _config(out: Path, miniature: Path, *overrides: str) -> DictConfig:
    roots = [f"data.{part}_root={miniature / part}" for part in ("infinigen", "kitti", "scannet")]
    fixed = ["experiment=paper", f"output_dir={out}", f"data.index_cache={out / 'cache'}"]
    return compose("train", *fixed, *TINY, *roots, *overrides)


def test_two_steps_on_the_three_layouts(tmp_path: Path, miniature: Path) -> None:
    run = build(_config(tmp_path / "a", miniature))
    drawn = [name for batch in run.datamodule.train_dataloader() for name in batch.scene]
    assert {name.partition("/")[0] for name in drawn} == {"infinigen", "kitti", "scannet"}
    report = train(_config(tmp_path / "b", miniature, "data.workers=1"))
    assert report["steps"] == 2
    assert 0 < report["trained"]["abs_rel"] < 1


def test_a_missing_root_is_named(tmp_path: Path, miniature: Path) -> None:
    config = _config(tmp_path, miniature, "data.kitti_root=null")
    with pytest.raises(FileNotFoundError, match=r"data\.kitti_root is not set"):
        build(config).datamodule.setup("fit")
    config.data.weights.kitti = 0
    build(config).datamodule.setup("fit")
