"""Small files are written whole or not at all."""

from pathlib import Path

import pytest

from vg2gt.io.files import replacing, write_bytes


def test_failure_keeps_the_old_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bytes(tmp_path / "x", b"old")

    def fail(*args: object) -> None:
        raise OSError("disk")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk"):
        write_bytes(path, b"new")
    assert (path.read_bytes(), len(list(tmp_path.iterdir()))) == (b"old", 1)


def test_writers_with_one_process_number_have_their_own_temporary_names(tmp_path, monkeypatch):
    """Two containers on one folder."""
    monkeypatch.setattr("os.getpid", lambda: 7)
    with replacing(tmp_path / "x") as one, replacing(tmp_path / "x") as other:
        assert one != other
        one.write_bytes(b"one")
        other.write_bytes(b"other")
    assert (tmp_path / "x").read_bytes() == b"one"  # whoever ends last
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
