"""Small files are written whole or not at all."""

from pathlib import Path

import pytest

from vg2gt.io.files import read_json, write_bytes, write_json


def test_round_trip_makes_folders_and_leaves_no_temporary_file(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a" / "b.json", {"x": [1, 2.5, None]})
    assert read_json(path) == {"x": [1, 2.5, None]}
    assert [p.name for p in path.parent.iterdir()] == ["b.json"]


def test_failure_keeps_the_old_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bytes(tmp_path / "x", b"old")

    def fail(*args: object) -> None:
        raise OSError("disk")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk"):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_broken_json_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(ValueError, match=r"broken\.json"):
        read_json(tmp_path / "broken.json")
