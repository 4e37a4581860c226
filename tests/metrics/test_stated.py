import math

import pytest
import torch

from vg2gt.metrics import ause, stated_error_metrics


def test_coverage_and_width() -> None:
    error = torch.tensor([0.01, 0.02, 0.03, 0.04])
    bounds = torch.tensor([[0.02] * 4, [0.02, 0.01, 0.05, 0.05]])
    found = stated_error_metrics(error, bounds, (0.5, 0.9))
    assert (found["held_50"], found["held_90"]) == (0.5, 0.75)
    assert found["width_90"] == pytest.approx(0.0325)
    assert math.isnan(stated_error_metrics(torch.zeros(0), torch.zeros(1, 0), (0.9,))["ause"])  # nothing to score


def test_the_order_that_leaves_the_smallest_errors_has_no_area() -> None:
    error = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    assert ause(error, 3 * error) == pytest.approx(0, abs=1e-9)
    shuffled = ause(error, torch.rand(1000, generator=torch.Generator().manual_seed(1)))
    assert 0.2 < shuffled < ause(error, -error)
    # Uniform errors left out at random keep their mean, left out by size the largest goes down: 1 - (1 - mean(share)).
    assert shuffled == pytest.approx(0.475, abs=0.05)
