"""Split files: places stay together, parts are divided by themselves, and the data module accepts the lists."""

import shutil
from functools import partial

import pytest

from vg2gt.cli.data import splits as main
from vg2gt.data import DataError, Mixture, RGBDFolder, SyntheticScenes
from vg2gt.data.sources.files import read_split
from vg2gt.data.splits import split_scenes

from .conftest import module_of


class Floors(SyntheticScenes):
    """Every three scenes are recordings of one place."""

    def place(self, scene: str) -> str:
        return f"floor-{int(scene[-6:]) // 3}"


def test_recordings_of_a_place_stay_together_and_one_place_cannot_be_divided():
    source = Floors(60)
    train, val = split_scenes(source, 0.25, seed=3)
    assert sorted(train + val) == list(source.scenes)
    assert not {source.place(scene) for scene in train} & {source.place(scene) for scene in val}
    assert (len(val), split_scenes(source, 0.25, seed=3)) == (15, (train, val))
    assert split_scenes(source, 0.25, seed=4) != (train, val)
    with pytest.raises(DataError, match="single place"):
        split_scenes(Floors(3), 0.5)
    with pytest.raises(ValueError, match="fraction"):
        split_scenes(Floors(30), 1.0)
    with pytest.raises(DataError, match=r"a mixture is split part by part: .* one of a, b"):
        split_scenes(Mixture({"a": source, "b": source}, {"a": 1, "b": 1}), 0.5)


def test_the_command_writes_lists_that_the_data_module_takes(rooms, write_recording, tmp_path, capsys):
    folder = write_recording("home/kitchen")
    for name in ("hall", "attic", "cellar"):
        shutil.copytree(folder, tmp_path / "home" / name)
    arguments = ["data=rgbd", f"data.root={tmp_path / 'home'}", "data.holdout=null", "--fraction=0.5"]
    main([*arguments, f"--out={tmp_path / 'lists'}"])
    assert "val.txt: 2 scenes" in capsys.readouterr().out
    lists = [str(tmp_path / "lists" / name) for name in ("train.txt", "val.txt")]
    assert sorted(name for path in lists for name in read_split(path)) == ["attic", "cellar", "hall", "kitchen"]
    train, val = (partial(RGBDFolder, scenes=path, holdout=None) for path in lists)
    module_of(rooms, train=train, val=val, root=str(tmp_path / "home")).setup()
    main([*arguments, f"--out={tmp_path / 'lists'}"])  # the same again
    with pytest.raises(SystemExit, match="holds another split"):
        main([*arguments, f"--out={tmp_path / 'lists'}", "--seed=1"])
