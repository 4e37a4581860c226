"""The hinge between the geometry before and after enhancement."""

import pytest
import torch

from vg2gt.losses import EnhancementLoss, GeometryLoss, VG2GTLoss
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


def test_only_the_loss_after_enhancement_is_trained() -> None:
    before, after = task(0.0, 1.0, 0.0), task(0.0, 2.0, 0.0)
    EnhancementLoss()(before, after).backward()
    assert before.reg.grad is None
    assert after.reg.grad == 1


def hinge_gradient(made, change: float, form: str) -> tuple[float, float]:
    """Value and gradient of the hinge alone where a token coordinate bends the decoded depth by ``change``."""
    shape = torch.linspace(-1, 1, 32, dtype=torch.float64)
    truth = made.prediction.geometry.depth
    token = torch.tensor(change, dtype=torch.float64, requires_grad=True)
    made = made.with_initial(truth * torch.exp(0.1 * shape)).with_depth(truth * torch.exp((0.1 + token) * shape))
    loss = VG2GTLoss(geometry=GeometryLoss(depth=0, point=0), enhance=EnhancementLoss(form=form))
    report = loss(made.prediction, made.batch)
    report.total.backward()
    return float(report.total.detach()), float(token.grad)


def test_a_harmful_token_change_is_pushed_back_and_a_helpful_one_left_alone(sample) -> None:
    made = sample()
    harm, gradient = hinge_gradient(made, 0.05, "improve")
    assert harm > 0
    assert gradient > 0  # descent lowers the harmful change
    assert hinge_gradient(made, -0.05, "improve") == (0, 0)


def test_the_printed_form_punishes_improvement(sample) -> None:
    made = sample()
    value, gradient = hinge_gradient(made, -0.05, "paper_literal")
    assert value > 0
    assert gradient < 0  # descent undoes the helpful change
    assert hinge_gradient(made, 0.05, "paper_literal") == (0, 0)


def test_unknown_options_are_refused() -> None:
    with pytest.raises(ValueError, match=r"loss\.enhance\.form.*'printed'"):
        EnhancementLoss(form="printed")
    with pytest.raises(ValueError, match=r"loss\.enhance\.on.*'conf'"):
        EnhancementLoss(on="conf")
