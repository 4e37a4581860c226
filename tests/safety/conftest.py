"""Malicious files. Each would make the canary file if anything in it ran; no test may leave one behind."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.training_helpers import write_run
from vg2gt.data import SyntheticScenes
from vg2gt.runs.load import load_model

SIZE = (24, 32)


@dataclass
class Armed:
    """An object whose unpickling makes a file."""

    canary: Path

    def __reduce__(self):
        return os.system, (f"touch {self.canary}",)


@pytest.fixture
def canary(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "canary"
    yield path
    assert not path.exists(), "code in a malicious file was executed"


@pytest.fixture
def armed(canary: Path) -> Armed:
    return Armed(canary)


@pytest.fixture
def pickled_array(armed: Armed) -> np.ndarray:
    array = np.empty(1, object)
    array[0] = armed
    return array


@pytest.fixture(scope="session")
def model():
    return load_model(overrides=["backend=oracle", "backend.depth_noise=0"], device="cpu").model


@pytest.fixture(scope="session")
def harmless_run(model, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("harmless") / "run", model)


@pytest.fixture
def run_folder(harmless_run: Path, tmp_path: Path) -> Path:
    """A training run's folder, to be made malicious."""
    return Path(shutil.copytree(harmless_run, tmp_path / "run"))


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> SyntheticScenes:
    return SyntheticScenes(1, num_frames=3, size=SIZE, cache_dir=str(tmp_path_factory.mktemp("rooms")))
