"""Runs killed at any moment go on with the same command and end as the uninterrupted run, bit for bit."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.reliability import crash_harness as harness
from tests.reliability.crash_harness import TRAIN, Moment


@dataclass(frozen=True)
class Case:
    """One run and the moments at which it is killed, one process a moment."""

    kind: str
    moments: Sequence[Moment]
    overrides: Sequence[str] = ()
    warm: bool = True


def random_moments(count: int, seed: int, longest: float = 3.0) -> list[Moment]:
    return [harness.after_seconds(seconds) for seconds in np.random.default_rng(seed).uniform(0, longest, count)]


QUICK = Case("one of each", (harness.in_first_evaluation, harness.while_a_checkpoint_is_written, harness.in_validation))
CASES = [
    Case("at random", random_moments(6, seed=0)),
    Case("at random, started as a user does", random_moments(3, seed=1), warm=False),
    Case("at random, a loader process", random_moments(4, seed=2), ("data.workers=1",)),
    Case("while a checkpoint is written", (harness.while_a_checkpoint_is_written,) * 3),
    Case("between a checkpoint and its row", (harness.after_a_checkpoint,) * 3),
    Case("in an evaluation while training", (harness.in_validation,) * 2),
    Case("in the evaluation before", (harness.in_first_evaluation,) * 2),
    Case("in the evaluation after", (harness.in_last_evaluation,) * 2),
    Case("while the report is written", (harness.while_the_report_is_written,) * 2),
]


def survive(case: Case, folder: Path, cache: Path) -> int:
    """Kills the run at every moment, then lets it finish; returns the kills that came before its end."""
    arguments, kills = harness.training(folder, cache, *case.overrides), 0
    for moment in case.moments:
        attempt = harness.start(TRAIN, arguments, folder, case.warm)
        if attempt.wait_for(moment):
            attempt.kill()
            kills += attempt.status() == -9
        assert attempt.status() in (0, -9), attempt.said()[-4000:]
        harness.check_files(folder)
    harness.finish(TRAIN, arguments, folder, case.warm)
    return kills


def test_killed_run_equals_uninterrupted(tmp_path: Path, cache: Path, whole: Path) -> None:
    """And stays as it is when it is started once more, as a queue may do."""
    folder = tmp_path / "run"
    assert survive(QUICK, folder, cache) == len(QUICK.moments)
    harness.assert_same(whole, folder)
    harness.finish(TRAIN, harness.training(folder, cache), folder)
    harness.assert_same(whole, folder)


def test_a_damaged_last_checkpoint_is_set_aside(tmp_path: Path, cache: Path, whole: Path) -> None:
    """The run resumes from the previous one, reports it, and ends with the same weights."""
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    newest = folder / "checkpoints" / f"step-{harness.STEPS}.ckpt"
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 1
    newest.write_bytes(content)
    (folder / "metrics.json").unlink()
    harness.finish(TRAIN, harness.training(folder, cache), folder)
    aside = newest.with_name(f"{newest.name}.damaged")
    assert aside.read_bytes() == bytes(content)
    aside.unlink()
    harness.assert_same(whole, folder)
    said = folder.with_name("run.out").read_text()
    assert "trying the previous checkpoint" in said
    assert "continuing from step-4.ckpt" in said


@pytest.mark.slow
def test_twenty_kills(tmp_path: Path, cache: Path, whole: Path) -> None:
    kills: dict[str, int] = {}
    for number, case in enumerate(CASES):
        folder = tmp_path / f"run-{number}"
        kills[case.kind] = survive(case, folder, cache)
        harness.assert_same(whole, folder)
        print(f"{kills[case.kind]} kills survived: {case.kind}", flush=True)
    print(f"{sum(kills.values())} kills survived, every result equal bit for bit")
    assert sum(kills.values()) >= 20
    assert all(kills.values()), kills
