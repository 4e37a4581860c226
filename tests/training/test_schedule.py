"""Learning-rate schedule and parameter groups."""

from itertools import pairwise

import pytest
from torch import nn

from vg2gt.training.module import cosine_with_warmup, parameter_groups


def test_papers_schedule_goes_from_initial_to_final_rate() -> None:
    factor = cosine_with_warmup(420_000, 0, 1e-8 / 3e-6)
    assert factor(0) * 3e-6 == pytest.approx(3e-6)
    assert factor(210_000) * 3e-6 == pytest.approx((3e-6 + 1e-8) / 2)
    assert factor(420_000) * 3e-6 == pytest.approx(1e-8)
    assert factor(500_000) == factor(420_000)


def test_warmup_rises_then_falls() -> None:
    factor = cosine_with_warmup(100, 10, 0.0)
    rates = [factor(step) for step in range(101)]
    assert rates[0] > 0
    assert all(a < b for a, b in pairwise(rates[:11]))
    assert max(rates) == rates[10] == 1
    assert all(a > b for a, b in pairwise(rates[10:]))


def test_only_matrices_decay_and_frozen_parameters_are_left_out() -> None:
    module = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 2))
    module[2].requires_grad_(False)
    decay, rest = parameter_groups(module)
    assert [name for name, _ in decay["params"]] == ["0.weight"]
    assert [name for name, _ in rest["params"]] == ["0.bias", "1.weight", "1.bias"]
    assert rest["weight_decay"] == 0.0
