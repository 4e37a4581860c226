"""Archives that would fill memory, lead elsewhere, or claim more than they hold."""

import io
import logging
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.safety.conftest import SIZE
from vg2gt.data import DataError, SyntheticScenes
from vg2gt.io.arrays import load_npy
from vg2gt.io.errors import FormatError
from vg2gt.io.npz import load_npz, read_npz
from vg2gt.io.tensors import read_tensors, read_torch
from vg2gt.runs.checkpoints import read_checkpoint


def deflated_zeros(name: str, size: int, header: bytes = b"") -> bytes:
    """A zip file of ``size`` zeros, a thousandth as large."""
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(name, "w", force_zip64=True) as file,
    ):
        file.write(header)
        block = bytes(1 << 20)
        for _ in range(size >> 20):
            file.write(block)
    return buffer.getvalue()


def npy_header(shape: tuple[int, ...], kind: str = "<f4") -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": kind, "fortran_order": False, "shape": shape})
    return buffer.getvalue()


@pytest.fixture(scope="module")
def bomb() -> bytes:
    return deflated_zeros("depth.npy", 300 << 20, npy_header((75 << 20,)))


def test_array_bombs(tmp_path: Path, bomb: bytes) -> None:
    assert len(bomb) < 1 << 20
    path = tmp_path / "bomb.npz"
    path.write_bytes(bomb)
    with pytest.raises(FormatError, match=r"unpack to 3145\d+ bytes, at most 268435456"):
        read_npz(path, ("depth",))
    with pytest.raises(DataError, match=r"bomb\.npz of scene s: .*unpack to"):
        load_npz(path, "s", ("depth",))


@pytest.mark.parametrize("count", [1 << 60, 1 << 50, 1 << 38])
def test_arrays_that_claim_more_than_they_hold(tmp_path: Path, count: int) -> None:
    content = npy_header((count,)) + bytes(64)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("depth.npy", content)
    (tmp_path / "a.npz").write_bytes(buffer.getvalue())
    (tmp_path / "a.npy").write_bytes(npy_header((1 << 20, count >> 20)) + bytes(64))
    with pytest.raises(DataError, match=r"cannot read .*a\.npz"):
        load_npz(tmp_path / "a.npz", "s", ("depth",))
    with pytest.raises(DataError, match=r"cannot read .*a\.npy"):
        load_npy(tmp_path / "a.npy", "s", (2, 2))


def test_members_of_an_archive_are_never_written_to_disk(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    array = io.BytesIO()
    np.save(array, np.arange(3.0))
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in ("depth.npy", "../escaped.npy", "/tmp/escaped.npy", "..\\escaped.npy"):
            archive.writestr(name, array.getvalue())
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "a.npz").write_bytes(buffer.getvalue())
    assert read_npz(tmp_path / "inner" / "a.npz", ("depth",))["depth"].tolist() == [0, 1, 2]
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.npz", "inner"]


def rezipped(content: bytes, change: Callable[[str, bytes], tuple[str, bytes]], kind: int = 0) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(buffer, "w", kind) as new:
        for member in old.infolist():
            new.writestr(*change(member.filename, old.read(member)))
    return buffer.getvalue()


ZIPS: dict[str, Callable[[bytes], bytes]] = {
    "compressed": lambda content: rezipped(content, lambda n, c: (n, c), zipfile.ZIP_DEFLATED),
    "bomb": lambda content: rezipped(content, lambda n, c: (n, bytes(8 << 20) if "data/0" in n else c), 8),
    "parent folder": lambda content: rezipped(content, lambda n, c: ("../" + n, c)),
    "absolute": lambda content: rezipped(content, lambda n, c: ("/" + n, c)),
    "no pickle": lambda content: rezipped(content, lambda n, c: (n.replace("data.pkl", "data.txt"), c)),
    "short storage": lambda content: rezipped(content, lambda n, c: (n, c[:4] if "data/0" in n else c)),
    "truncated": lambda content: content[: len(content) // 2],
}  # fmt: skip


@pytest.mark.parametrize("name", ZIPS)
def test_zip_files_of_torch(tmp_path: Path, name: str) -> None:
    buffer = io.BytesIO()
    torch.save({"w": torch.arange(99.0)}, buffer)
    for file in ("model.pt", "step-1.ckpt"):
        (tmp_path / "inner").mkdir(exist_ok=True)
        (tmp_path / "inner" / file).write_bytes(ZIPS[name](buffer.getvalue()))
    read = {"model.pt": read_tensors, "step-1.ckpt": read_checkpoint}
    for file, reader in read.items():
        with pytest.raises(ValueError, match=file):
            reader(tmp_path / "inner" / file)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["inner", "model.pt", "step-1.ckpt"]


def test_a_tensor_longer_than_its_record_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """torch 2.6 makes such a tensor, with foreign memory at its end; later ones refuse."""
    buffer = io.BytesIO()
    shared = torch.arange(99.0)
    torch.save({"w": shared, "again": shared[3:], "deep": [(torch.zeros(5),)], "none": torch.zeros(0)}, buffer)
    (tmp_path / "good.pt").write_bytes(buffer.getvalue())
    whole = read_torch(tmp_path / "good.pt")
    assert torch.equal(whole["again"], shared[3:])
    (tmp_path / "short.pt").write_bytes(ZIPS["short storage"](buffer.getvalue()))
    monkeypatch.setattr(torch, "load", lambda *_, **__: whole)
    with pytest.raises(ValueError, match=r"short\.pt is damaged: a tensor of 396 bytes has a record of another length"):
        read_torch(tmp_path / "short.pt")


def test_a_bomb_in_the_cache_of_rooms(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One warning, and the room is made again."""
    source = SyntheticScenes(1, num_frames=1, size=SIZE, cache_dir=str(tmp_path))
    expected = source.load(source.scenes[0], [0])
    (path,) = tmp_path.rglob("*.npz")
    path.write_bytes(deflated_zeros("images.npy", 300 << 20, npy_header((300 << 20,), "|u1")))
    again = SyntheticScenes(1, num_frames=1, size=SIZE, cache_dir=str(tmp_path))
    with caplog.at_level(logging.WARNING):
        assert torch.equal(again.load(again.scenes[0], [0]).depth, expected.depth)
    assert len(caplog.records) == 1
    assert "is damaged" in caplog.text
