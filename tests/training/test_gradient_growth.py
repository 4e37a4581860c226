"""A training whose gradients grow is told, once for every factor of ten."""

import logging

import pytest

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
