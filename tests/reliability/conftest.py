"""Fixtures of the runs that are killed and of the disks that are full."""

from pathlib import Path

import pytest

from tests.reliability import crash_harness as harness


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cache of the rooms that all runs train on."""
    return tmp_path_factory.mktemp("rooms")


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory, rooms: Path) -> Path:
    """The uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    harness.finish(harness.TRAIN, harness.training(folder, rooms), folder)
    return folder
