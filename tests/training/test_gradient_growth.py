"""A training whose gradients grow is told, once for every factor of ten."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.reliability.steps import first_batches, fit, named, tiny_run
from vg2gt.training.faults import GROWTH, MEDIAN_OF, GradientGrowth


def warnings_of(norms: list[float], caplog: pytest.LogCaptureFixture) -> list[str]:
    growth = GradientGrowth()
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        for step, norm in enumerate(norms):
            growth.see(norm, step)
    return [record.getMessage() for record in caplog.records]


def test_growing_norms_are_told(caplog: pytest.LogCaptureFixture) -> None:
    norms = [1.0] * MEDIAN_OF + [11.0] * 3 * MEDIAN_OF + [500.0] * 2 * MEDIAN_OF
    first, second = warnings_of(norms, caplog)
    assert first.startswith(f"step {2 * MEDIAN_OF - 1}: gradient norms have grown from 1 to 11")
    assert "from 11 to 500" in second


def test_single_steps_and_slow_growth_are_no_alarm(caplog: pytest.LogCaptureFixture) -> None:
    spikes = [1000.0 if step % 3 == 2 else 1.0 for step in range(10 * MEDIAN_OF)]
    assert not warnings_of(spikes, caplog)
    assert not warnings_of([1 + (GROWTH - 2) * step / 1000 for step in range(1000)], caplog)


def test_a_run_is_watched_in_the_steps_it_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tiny_run(tmp_path, tmp_path)
    seen: list[tuple[float, int]] = []
    monkeypatch.setattr(run.module._growth, "see", lambda norm, step, warn: seen.append((norm, step)) or warn)
    (good,) = first_batches(run, 1)
    bad = replace(good, images=torch.full_like(good.images, torch.nan))
    fit(run, [good, named(bad, "bad"), good])
    assert [step for _, step in seen] == [0, 2]
    assert all(0 < norm < 1e3 for norm, _ in seen)
