"""The hinge between the geometry before and after enhancement."""

import pytest
import torch

from vg2gt.losses import EnhancementLoss
from vg2gt.losses.geometry import TaskLoss


def task(conf: float, reg: float, grad: float) -> TaskLoss:
    return TaskLoss(*(torch.tensor(x, requires_grad=True) for x in (conf, reg, grad)))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 0.5),
        ({"on": "reg"}, 0.0),
        ({"on": "reg", "margin": 0.3}, 0.1),
        ({"form": "paper_literal"}, 0.0),
        ({"form": "paper_literal", "on": "reg"}, 0.2),
    ],
)
def test_values_by_hand(options: dict, expected: float) -> None:
    before, after = task(1.0, 0.5, 0.2), task(1.6, 0.3, 0.3)  # totals 1.7 and 2.2
    assert float(EnhancementLoss(**options)(before, after).detach()) == pytest.approx(expected)
    EnhancementLoss()(before, after).backward()  # only the loss after enhancement is trained
    assert before.reg.grad is None
    assert after.reg.grad == 1


def test_unknown_options_are_refused() -> None:
    with pytest.raises(ValueError, match=r"loss\.enhance\.form.*'printed'"):
        EnhancementLoss(form="printed")
    with pytest.raises(ValueError, match=r"loss\.enhance\.on.*'conf'"):
        EnhancementLoss(on="conf")
