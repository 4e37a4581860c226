from pathlib import Path

import pytest

from vg2gt.data.views import SceneSample
from vg2gt.evaluation.run import ResultStore, mean_metrics

VIEWS = SceneSample("kitchen/seq-01", (1, 2), (3,))


def test_scores_come_back_for_the_same_frames_only(tmp_path: Path) -> None:
    store = ResultStore(tmp_path, {"a": 1})
    assert store.read(VIEWS) is None
    store.write(VIEWS, {"psnr": 20.5, "abs_rel": None})
    again = ResultStore(tmp_path, {"a": 1})
    assert again.read(VIEWS) == {"psnr": 20.5, "abs_rel": None}
    assert again.read(SceneSample(VIEWS.scene, (1, 2), (4,))) is None
    assert again.read(SceneSample(VIEWS.scene, (1, 2, 5), (3,))) is None


def test_means_leave_out_what_is_missing_and_times_are_medians() -> None:
    scenes = {
        "a": {"psnr": 20.0, "abs_rel": None, "scene/head_seconds": 9.0},
        "b": {"psnr": 30.0, "abs_rel": 0.2, "scene/head_seconds": 1.0},
        "c": {"psnr": 40.0, "abs_rel": 0.4, "scene/head_seconds": 2.0, "lpips": None},
    }
    means = mean_metrics(scenes)
    assert means["psnr"] == 30
    assert means["abs_rel"] == pytest.approx(0.3)
    assert means["scene/head_seconds"] == 2
    assert means["lpips"] is None
    del scenes["c"]  # the first of two compiled: it says nothing of the rest
    assert mean_metrics(scenes)["scene/head_seconds"] == 1


def test_an_interrupted_replacement_leaves_no_report_of_before(tmp_path: Path) -> None:
    ResultStore(tmp_path, {"a": 1})
    for name in ("metrics.json", "metrics.md"):
        (tmp_path / name).write_text("of before")
    ResultStore(tmp_path, {"a": 2}, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["identity.json"]
