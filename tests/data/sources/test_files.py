"""What all loaders of files share: lists of scenes, and the memory that indices take."""

import logging

import pytest

from tests.io.test_colmap import small_model
from vg2gt.data import DataError, RGBDFolder, SyntheticScenes
from vg2gt.data.sources import files
from vg2gt.data.sources.colmap_model import COLMAP
from vg2gt.io import write_colmap

from .layout_rgbd import write_recording
from .layouts import room


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("dataset")
    for name in ("a", "b", "c"):
        write_recording(root, room(2), name)
    return root


def test_a_list_in_a_file_may_name_scenes_that_are_not_there(dataset, tmp_path, caplog):
    path = tmp_path / "train.txt"
    path.write_text("# of the whole dataset\nc\nnot_copied\na\n")
    with caplog.at_level(logging.WARNING):
        assert RGBDFolder(str(dataset), scenes=str(path)).scenes == ("c", "a")
    assert f"skipped 1 of the 3 scenes listed in {path}: not found" in caplog.text
    path.write_text("not_copied\n")
    with pytest.raises(DataError, match="no such scene: not_copied; available: a, b, c"):
        RGBDFolder(str(dataset), scenes=str(path))
    with pytest.raises(DataError, match="no such scene: not_copied"):
        RGBDFolder(str(dataset), scenes=["a", "not_copied"])
    absent = r"the scene list .*absent\.txt does not exist.*data\.train\.scenes=null data\.val\.scenes=null"
    with pytest.raises(FileNotFoundError, match=absent):
        RGBDFolder(str(dataset), scenes=str(tmp_path / "absent.txt"))
    path.write_text("a\nb\na\n")
    with pytest.raises(DataError, match="names a twice"):
        RGBDFolder(str(dataset), scenes=str(path))
    assert RGBDFolder([str(dataset / name) for name in "ba"]).scenes == ("b", "a")
    with pytest.raises(DataError, match="two scenes are called a"):
        RGBDFolder([str(dataset / name) for name in "aa"])


def test_few_indices_stay_in_memory_and_the_rest_come_from_the_cache(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_INDICES_IN_MEMORY", 1)
    source = RGBDFolder(str(dataset), index_cache=str(tmp_path))
    ids = {scene: source.frames(scene) for scene in source.scenes}
    assert len(source._indices) == 1
    monkeypatch.setattr(RGBDFolder, "index", lambda *_: pytest.fail("the dataset is indexed again"))
    for scene in source.scenes:
        assert source.load(scene, ids[scene]).depth.shape[0] == 2
        assert source.frames(scene) == ids[scene] == (10, 11)


def test_a_cache_that_cannot_be_written_is_told_once(dataset, tmp_path, caplog):
    (tmp_path / "cache").write_text("a file where the folder should be")
    with caplog.at_level(logging.WARNING):
        source = RGBDFolder(str(dataset), index_cache=str(tmp_path / "cache"))
        assert [source.frames(scene) for scene in source.scenes] == [(10, 11)] * 3
        rooms = SyntheticScenes(2, num_frames=1, size=(14, 14), cache_dir=str(tmp_path / "cache"))
        assert rooms.load("room-000000", [0]).depth.shape == (1, 14, 14)
    assert sum("is disabled, because" in record.getMessage() for record in caplog.records) == 1


def test_a_part_of_a_scene_is_no_scene(tmp_path) -> None:
    for place in ("garden", "garden/dense", "house/room"):
        for name in ("images", "sparse/0"):
            (tmp_path / place / name).mkdir(parents=True, exist_ok=True)
        write_colmap(tmp_path / place / "sparse" / "0", small_model())
    assert list(COLMAP(str(tmp_path)).scenes) == ["garden", "house/room"]


def test_every_second_frame(dataset):
    assert RGBDFolder(str(dataset), every=2).frames("a") == (10,)
    with pytest.raises(ValueError, match="every must be at least 1"):
        RGBDFolder(str(dataset), every=0)
    with pytest.raises(ValueError, match="holdout must be at least 2"):
        RGBDFolder(str(dataset), holdout=1)
