"""Runs killed at any moment go on with the same command and end as the uninterrupted run, bit for bit."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.reliability import crash_harness as harness
from tests.reliability.crash_harness import TRAIN, Moment

MOMENTS = (
    harness.in_first_evaluation,
    harness.while_a_checkpoint_is_written,
    harness.in_validation,
    harness.in_last_evaluation,
    harness.while_the_report_is_written,
)
FEW = (harness.while_a_checkpoint_is_written, harness.in_last_evaluation)


@pytest.mark.parametrize("moments", [FEW, pytest.param(MOMENTS, marks=pytest.mark.slow)], ids=["few", "all"])
def test_killed_run_equals_uninterrupted(moments: Sequence[Moment], tmp_path: Path, cache: Path, whole: Path) -> None:
    """Killed at one moment after another; and stays as it is when it is started once more, as a queue may do."""
    folder = tmp_path / "run"
    arguments = harness.training(folder, cache)
    for moment in moments:
        attempt = harness.start(TRAIN, arguments, folder)
        assert attempt.wait_for(moment), attempt.said()[-4000:]
        attempt.kill()
        harness.check_files(folder)
    for _ in range(2):
        harness.finish(TRAIN, arguments, folder)
        harness.assert_same(whole, folder)
