"""Unusual combinations are named, usual ones are not."""

from pathlib import Path

import pytest

from vg2gt.config import compose
from vg2gt.training.notices import notices


def said(tmp_path: Path, *overrides: str) -> list[str]:
    return notices(compose("train", f"output_dir={tmp_path}", *overrides))


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["backend=da3_small"],
        ["backend=da3_giant", "debug=fast_dev_run"],
        ["model=pixel_aligned"],
        ["model=pointcloud"],
        ["ablation=wo_coarse"],
        ["experiment=finetune"],
        ["experiment=finetune", "backend=da3_giant", "data=scannet"],
        ["experiment=paper", "data=synthetic"],
        ["experiment=paper_counts", "data=synthetic"],
    ],
)
def test_usual_runs_are_not_commented(overrides: list[str], tmp_path: Path) -> None:
    assert said(tmp_path, *overrides) == []


@pytest.mark.parametrize(
    ("overrides", "parts"),
    [
        (
            ["backend=da3_giant", "model=vg2gt"],
            ["backend=da3_giant and a model of the paper's", "max_steps=320, optimizer.lr=0.004, loss=quickstart of"],
        ),
        (["backend=da3_nested", "loss=paper", "optimizer.lr=1e-4"], ["backend=da3_nested with trainer.max_steps=320"]),
        (["backend=vggt_1b", "trainer.max_steps=9000", "loss=paper"], ["backend=vggt_1b with optimizer.lr=0.004 of"]),
        (["model=vg2gt", "optimizer=adamw", "loss=paper"], ["max_steps=320, optimizer.lr=0.001 of the quick run"]),
        (["model=vg2gt", "trainer.max_steps=9000", "optimizer.lr=1e-4"], ["widths with loss=quickstart of"]),
        (["model.fine.min_footprint=0"], ["voxel_size=0.002", "the median depth is 1", "experiment=paper_counts"]),
        (["model.scale.source=focal"], ["model.scale.source=focal", "backends.oracle.OracleBackend", "normalize"]),
    ],
)
def test_unusual_runs_are_named_in_a_line(overrides: list[str], parts: list[str], tmp_path: Path) -> None:
    (line,) = said(tmp_path, *overrides)
    assert all(part in line for part in parts), line
    assert "\n" not in line
