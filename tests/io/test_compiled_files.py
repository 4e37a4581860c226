"""Compiled kernels survive damage, full disks and other processes."""

import errno
import os
from pathlib import Path
from typing import Any

import numba
import pytest
from numba.core.dispatcher import Dispatcher

from vg2gt.io import files
from vg2gt.io.compiled_files import KernelCache


def add_one(x):
    return x + 1


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Makes the kernel as another process would."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))  # pyright: ignore[reportPrivateImportUsage]
    monkeypatch.setattr(files, "_unwritable", set())

    def make() -> Dispatcher:
        made: Any = numba.njit(add_one)
        made._cache = KernelCache(add_one)
        return made

    return make


def kept(folder: Path) -> list[Path]:
    """All files below the folder, whatever they are named."""
    return [path for path in folder.rglob("*") if path.is_file()]


def test_a_kernel_is_compiled_once_for_its_arguments(tmp_path: Path, kernel) -> None:
    assert kernel()(1) == 2
    again = kernel()
    assert (again(1), again(1.5)) == (2, 2.5)
    assert (sum(again.stats.cache_hits.values()), sum(again.stats.cache_misses.values())) == (1, 1)
    assert len(kept(tmp_path)) == 2


def test_processes_that_compile_at_once_keep_their_own_code(tmp_path: Path, kernel) -> None:
    """One begins before the other has kept anything, and ends after it."""
    first, second = kernel(), kernel()
    save, waiting = second._cache.save_overload, []
    second._cache.save_overload = lambda *arguments: waiting.append(arguments)
    assert second(1.5) == 2.5
    assert first(1) == 2
    save(*waiting[0])
    third = kernel()
    assert (third(1), third(1.5)) == (2, 2.5)
    assert not third.stats.cache_misses
    assert len(kept(tmp_path)) == 2


@pytest.mark.parametrize("damage", ["empty", "half", "other"])
def test_a_damaged_file_is_written_again(damage: str, tmp_path: Path, kernel, caplog: pytest.LogCaptureFixture) -> None:
    kernel()(1)
    (file,) = kept(tmp_path)
    whole = file.read_bytes()
    changed = whole[:-100] + bytes([whole[-100] ^ 1]) + whole[-99:]
    file.write_bytes({"empty": b"", "half": whole[: len(whole) // 2], "other": changed}[damage])
    assert kernel()(1) == 2
    assert str(file) in caplog.text
    caplog.clear()
    last = kernel()
    assert last(1) == 2
    assert not last.stats.cache_misses
    assert not caplog.records


@pytest.mark.skipif(os.name != "posix", reason="files have no owner in the sense of POSIX")
def test_code_of_another_user_is_not_run(
    tmp_path: Path, kernel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kernel()(1)
    (file,) = kept(tmp_path)
    if os.geteuid() == 0:
        os.chown(file, 1000, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: file.stat().st_uid + 1)
    last = kernel()
    assert last(1) == 2
    assert not last.stats.cache_hits
    assert f"{file} belongs to another user" in caplog.text


def test_what_another_version_wrote_is_compiled_again(
    kernel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kernel()(1)
    last = kernel()
    monkeypatch.setattr(last._cache._impl, "rebuild", lambda context, payload: payload[1000])
    assert last(1) == 2
    assert "compiled again" in caplog.text


def test_a_full_disk_is_told_once_and_the_work_goes_on(
    tmp_path: Path, kernel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(path: Path, content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    made = kernel()
    assert (made(1), made(1.5), made(True)) == (2, 2.5, 2)
    assert [record.getMessage().count("No space left on device") for record in caplog.records] == [1]
    assert not kept(tmp_path)


def test_forgetting_removes_this_kernel_alone(tmp_path: Path, kernel) -> None:
    made = kernel()
    assert (made(1), made(1.5)) == (2, 2.5)
    other = kept(tmp_path)[0].with_name("other.1.nbc")
    other.touch()
    made._cache.flush()
    assert kept(tmp_path) == [other]
