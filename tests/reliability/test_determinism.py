"""The same seed gives the same weights, bit for bit, whatever loads the data."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.reliability.steps import tiny_run
from tests.reliability.two_ranks import weights

DROP = "model.coarse.ptv3.drop_path=0.3"  # makes the global generator part of the weights


@pytest.fixture(autouse=True)
def _settings() -> Iterator[None]:
    """Leaves torch as it was: the trainer sets these for the whole process."""
    threads = torch.get_num_threads()
    yield
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(threads)


def trained_weights(folder: Path, cache: Path, *overrides: str, threads: int = 1, steps: int = 3) -> Tensor:
    torch.set_num_threads(threads)
    torch.rand(threads)  # the state of the global generator before a run must not matter
    options = [DROP, "+trainer.deterministic=true", f"trainer.max_steps={steps}", "data.train_scenes=4"]
    run = tiny_run(folder, cache, *options, *overrides)
    before = weights(run).clone()
    run.trainer.fit(run.module, datamodule=run.datamodule)
    assert torch.are_deterministic_algorithms_enabled()
    assert not torch.equal(before, weights(run))
    return weights(run)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Tensor:
    return trained_weights(tmp_path_factory.mktemp("first"), cache)


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_two_runs_are_bit_equal_with_any_number_of_workers(first, tmp_path, cache, workers):
    assert torch.equal(trained_weights(tmp_path, cache, f"data.workers={workers}"), first)


def test_another_seed_gives_other_weights(first: Tensor, tmp_path: Path, cache: Path) -> None:
    assert not torch.equal(trained_weights(tmp_path, cache, "seed=1"), first)


@pytest.mark.slow
def test_thirty_steps_are_bit_equal(tmp_path: Path, cache: Path) -> None:
    """With several scenes a step, held-out views, and frames read by workers."""
    runs = [
        trained_weights(tmp_path / str(workers), cache, "data.max_images=4", f"data.workers={workers}", steps=30)
        for workers in (0, 0, 1, 2)
    ]
    assert all(torch.equal(run, runs[0]) for run in runs[1:])
