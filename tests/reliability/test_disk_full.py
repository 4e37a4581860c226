"""A full disk ends a run with one error that names the file; what was there before stays, and the run goes on."""

import re
import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.reliability import crash_harness as harness
from tests.reliability.crash_harness import TRAIN, Attempt
from vg2gt.io.files import read_json, write_json
from vg2gt.runs.checkpoints import newest_valid


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


def assert_goes_on(whole: Path, folder: Path, cache: Path) -> None:
    harness.finish(TRAIN, harness.training(folder, cache), folder)
    harness.assert_same(whole, folder)


def test_a_json_file_that_does_not_fit(tmp_path: Path) -> None:
    path = write_json(tmp_path / "metrics.json", {"psnr": 20.0})
    with (
        largest_file(1000),
        pytest.raises(OSError, match=r"metrics\.json could not be written: File too large"),
    ):
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
    assert re.search(
        r"OSError: checkpoint .*step-\d\.ckpt could not be written .*earlier checkpoints are intact", said[0]
    )
    assert "Traceback" not in attempt.said()
    assert not list(folder.rglob("*.tmp"))
    assert newest_valid(folder / "checkpoints") == checkpoints(folder)[-1]
    assert_goes_on(whole, folder, cache)


# ----------------------------------------------------------------------------------------- a file system of our own


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 MiB; needs the right to mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"needs the right to mount a file system: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(disk: Path) -> Path:
    """Leaves no byte free."""
    filler = disk / "filler"
    with suppress(OSError), open(filler, "wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    return filler


def in_the_first_step(attempt: Attempt) -> bool:
    """The first row of the training is there."""
    return "train/" in attempt.log()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("moment", "named"),
    [
        (harness.in_first_evaluation, r"(metrics\.csv|untrained\.json|step-2\.ckpt)"),
        (in_the_first_step, r"step-\d\.ckpt"),
        (harness.after_a_checkpoint, r"step-\d\.ckpt"),
        (harness.in_last_evaluation, r"(metrics\.csv|metrics\.json|metrics\.md|preview\.png)"),
    ],
)
def test_full_file_system(small_disk: Path, cache: Path, whole: Path, moment: harness.Moment, named: str) -> None:
    folder = small_disk / "run"
    attempt = harness.start(TRAIN, harness.training(folder, cache), folder)
    assert attempt.wait_for(moment)
    filler = fill(small_disk)
    status = attempt.wait()
    kept = [path.name for path in checkpoints(folder)]
    filler.unlink()
    print(f"{moment}: status {status}, checkpoints {kept}: {attempt.said()[-300:]}")
    assert status == 1
    assert_goes_on(whole, folder, cache)
    assert re.search(named, attempt.said())
