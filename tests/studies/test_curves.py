"""Curves of a run from its log."""

from pathlib import Path

import pytest

from vg2gt.studies.curves import labels, moving_average, plot_curves, read_curves


def write_log(folder: Path, version: int, text: str) -> None:
    path = folder / "logs" / f"version_{version}" / "metrics.csv"
    path.parent.mkdir(parents=True)
    path.write_text(text)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "mine"
    write_log(folder, 2, "epoch,step,loss,train/normal\n0,1,5.0,\n0,3,4.0,0.5\n")
    write_log(folder, 10, "epoch,step,loss,eval/psnr\n0,3,3.5,\n0,4,,27.0\n0,5,3.0,\n")
    return folder


def test_resumed_parts_are_joined(run: Path) -> None:
    curves = read_curves(run)
    assert (curves["loss"], curves["train/normal"]) == ({1: 5.0, 3: 3.5, 5: 3.0}, {3: 0.5})
    assert curves["eval/psnr"] == {4: 27.0}


def test_moving_average_passes_over_what_is_not_finite() -> None:
    assert moving_average([1.0, 3.0, float("nan"), 5.0], 2) == [1.0, 2.0, 3.0, 5.0]


def test_picture(run: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is in the extra eval")
    out = plot_curves([run], run / "curves.png")
    assert out.read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in run.iterdir()) == ["curves.png", "logs"]


def test_runs_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    """Otherwise one would silently take the other's place."""
    assert labels([tmp_path / "a" / "full", tmp_path / "b" / "full"]) == ["a/full", "b/full"]
    assert labels([tmp_path / "a" / "full", tmp_path / "b" / "start"]) == ["full", "start"]


def test_a_log_without_training_is_named(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is in the extra eval")
    write_log(tmp_path, 0, "epoch,step,eval/psnr\n0,0,20.0\n")
    with pytest.raises(ValueError, match="no training was logged"):
        plot_curves([tmp_path], tmp_path / "curves.png")


def test_missing_and_empty_logs_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="logger=csv"):
        read_curves(tmp_path)
    write_log(tmp_path, 0, "epoch,step,loss\n")
    with pytest.raises(ValueError, match="no values yet"):
        read_curves(tmp_path)
