"""Fixtures of the runs that are killed and of the disks that are full."""

from pathlib import Path

import pytest

from tests.reliability import crash_harness as harness
from tests.sharing import made_once


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
    """The uninterrupted run."""

    def run(folder: Path) -> None:
        # on some processors (Intel with AVX-512) the run that compiles the kernels differs in the last bits from others
        for name in ("compiling", "run"):
            harness.finish(harness.TRAIN, harness.training(folder / name, cache), folder / name)

    return made_once(tmp_path_factory, "whole", run) / "run"
