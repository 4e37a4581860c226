"""A full disk ends a run with one error that names the file; existing files stay, and the run can resume."""

import re
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.reliability import crash_harness as harness
from tests.reliability.crash_harness import TRAIN
from vg2gt.io.files import read_json, write_json
from vg2gt.runs.checkpoints import newest


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """The kernel refuses to let this process's files grow beyond ``size`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def checkpoints(folder: Path) -> list[Path]:
    return sorted((folder / "checkpoints").glob("*.ckpt"))


def test_a_json_file_that_does_not_fit(tmp_path: Path) -> None:
    path = write_json(tmp_path / "metrics.json", {"psnr": 20.0})
    with largest_file(1000), pytest.raises(OSError, match=r"metrics\.json could not be written: File too large"):
        write_json(path, list(range(1000)))
    assert read_json(path) == {"psnr": 20.0}
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.json"]


def test_training_ends_and_goes_on(tmp_path: Path, cache: Path, whole: Path) -> None:
    """The second checkpoint does not fit: the limit is set on the running process after the first."""
    folder = tmp_path / "run"
    attempt = harness.start(TRAIN, harness.training(folder, cache), folder)
    assert attempt.wait_for(harness.after_a_checkpoint)
    limit = checkpoints(folder)[0].stat().st_size // 2
    resource.prlimit(attempt.process.pid, resource.RLIMIT_FSIZE, (limit, limit))
    status = attempt.wait()
    said = [line for line in attempt.said().splitlines() if "could not be written" in line]
    assert status == 1
    assert len(said) == 1, attempt.said()
    expected = r"OSError: checkpoint .*step-\d\.ckpt could not be written .*earlier checkpoints are intact"
    assert re.search(expected, said[0])
    assert "Traceback" not in attempt.said()
    assert not list(folder.rglob("*.tmp"))
    assert newest(folder / "checkpoints") == checkpoints(folder)[-1]
    harness.finish(TRAIN, harness.training(folder, cache), folder)
    harness.assert_same(whole, folder)
