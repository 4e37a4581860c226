"""Tanks and Temples: a real trajectory file, the way to the scan, unregistered images, intrinsics."""

import pytest

from examples.data_sets.tanks_and_temples import TanksAndTemples
from vg2gt.data import DataError
from vg2gt.io import read_colmap, write_colmap

from .layout_tanks_and_temples import LAYOUTS, write
from .layouts import room

read = LAYOUTS["tanks_and_temples"].read


def test_unregistered_images_are_counted_and_intrinsics_come_from_the_model_or_the_argument(tmp_path, caplog):
    write(tmp_path, room(3))
    folder = tmp_path / "Barn"
    source = TanksAndTemples(str(tmp_path), intrinsics=[30, 31, 19, 14], depth=None)
    for each in (read(tmp_path), source):
        assert tuple(each.frames("Barn")) == (1, 2, 3)
        assert "1 of 4 frames without a pose are left out" in caplog.text
        caplog.clear()
    assert source.scene_index("Barn").intrinsics[0].tolist() == [[30, 0, 19], [0, 31, 14], [0, 0, 1]]
    model = read_colmap(folder / "sparse")
    model.image(2).name = "other.png"
    write_colmap(folder / "sparse", model)
    assert tuple(read(tmp_path).frames("Barn")) == (1, 3)
    for path in (folder / "sparse").iterdir():
        path.unlink()
    with pytest.raises(DataError, match=r"Barn .* has no intrinsics"):
        read(tmp_path).frames("Barn")
    with pytest.raises(ValueError, match=r"must be \[fx, fy, cx, cy\]"):
        TanksAndTemples(str(tmp_path), intrinsics=[30.0])
