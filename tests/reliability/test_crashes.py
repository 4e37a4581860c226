"""Runs killed at any moment go on with the same command and end as the uninterrupted run, bit for bit."""

from pathlib import Path

from tests.reliability import crash_harness as harness
from tests.reliability.crash_harness import TRAIN

MOMENTS = (
    harness.in_first_evaluation,
    harness.while_a_checkpoint_is_written,
    harness.in_validation,
    harness.in_last_evaluation,
    harness.while_the_report_is_written,
)


def test_killed_run_equals_uninterrupted(tmp_path: Path, cache: Path, whole: Path) -> None:
    """Killed at one moment after another; and stays as it is when it is started once more, as a queue may do."""
    folder = tmp_path / "run"
    arguments = harness.training(folder, cache)
    for moment in MOMENTS:
        attempt = harness.start(TRAIN, arguments, folder)
        assert attempt.wait_for(moment), attempt.said()[-4000:]
        attempt.kill()
        harness.check_files(folder)
    for _ in range(2):
        harness.finish(TRAIN, arguments, folder)
        harness.assert_same(whole, folder)
