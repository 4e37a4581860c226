"""Learning-rate schedule, parameter groups, Muon for matrices and AdamW for all else."""

import copy
from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from vg2gt.training.module import cosine_with_warmup, parameter_groups
from vg2gt.training.muon import MuonAdamW, orthogonalized


class Parts(nn.Module):
    """A head with a linear layer, a convolution and a norm, and a coarse part."""

    def __init__(self) -> None:
        super().__init__()
        self.coarse = nn.Linear(6, 4)
        self.fine = nn.ModuleList([nn.Linear(4, 5), nn.Conv2d(1, 3, 3), nn.LayerNorm(5)])
        self.single = nn.Linear(4, 1, bias=False)

    def parameters_named(self, *names: str) -> list[Tensor]:
        """Copies of parameters."""
        named = dict(self.named_parameters())
        return [named[name].detach().clone() for name in names]


MUONS = ("fine.0.weight", "fine.1.weight")


def give_gradients(modules: Iterable[nn.Module], seed: int) -> None:
    """The same gradients to all modules."""
    for module in modules:
        generator = torch.Generator().manual_seed(seed)
        for parameter in module.parameters():
            parameter.grad = torch.randn(parameter.shape, generator=generator)


def optimizer_of(module: nn.Module, **options: Any) -> MuonAdamW:
    """With its coarse part left to AdamW."""
    return MuonAdamW(parameter_groups(module), adamw=["coarse"], **options)


@pytest.mark.parametrize("shape", [(4, 9), (9, 4), (6, 6)])
def test_orthogonalized_has_the_singular_vectors_and_nearly_unit_values(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    matrices = [torch.randn(shape, dtype=torch.float64), 1e-4 * torch.randn(shape, dtype=torch.float64)]
    for matrix, found in zip(matrices, orthogonalized(matrices), strict=True):
        u, _, vh = torch.linalg.svd(matrix, full_matrices=False)
        inside = u.mT @ found @ vh.mT
        values = inside.diagonal()
        assert values.min() > 0.65
        assert values.max() < 1.25
        torch.testing.assert_close(inside, torch.diag(values), rtol=0, atol=1e-9)


def test_matrices_move_by_their_orthogonalised_momentum() -> None:
    """The formulas, spelt out once more, for two steps."""
    torch.manual_seed(2)
    module = Parts()
    optimizer = optimizer_of(module, lr=3e-2, momentum=0.9, weight_decay=0.1)
    expected = dict(zip(MUONS, module.parameters_named(*MUONS), strict=True))
    momentum = {name: torch.zeros_like(value) for name, value in expected.items()}
    for step in range(2):
        give_gradients([module], step)
        for name, parameter in module.named_parameters():
            if name in MUONS:
                momentum[name] = 0.9 * momentum[name] + 0.1 * parameter.grad
                ahead = (0.1 * parameter.grad + 0.9 * momentum[name]).flatten(1)
                update = orthogonalized([ahead])[0].view_as(parameter)
                rows, columns = ahead.shape
                expected[name] = (1 - 3e-2 * 0.1) * expected[name] - 3e-2 * 0.2 * max(rows, columns) ** 0.5 * update
        optimizer.step()
    for name, value in zip(MUONS, module.parameters_named(*MUONS), strict=True):
        torch.testing.assert_close(value, expected[name])


def test_all_else_is_adamws() -> None:
    """Vectors, a matrix of one row, and the parts that are named."""
    torch.manual_seed(3)
    module = Parts()
    other = copy.deepcopy(module)
    optimizer = optimizer_of(module, lr=1e-3, weight_decay=0.1)
    adamw = torch.optim.AdamW(parameter_groups(other), lr=1e-3, betas=(0.9, 0.99), weight_decay=0.1)
    for step in range(3):
        give_gradients((module, other), step)
        optimizer.step()
        adamw.step()
    for (name, parameter), same in zip(module.named_parameters(), other.parameters(), strict=True):
        if name in MUONS:
            assert not torch.allclose(parameter, same)
        else:
            torch.testing.assert_close(parameter, same, rtol=1e-6, atol=1e-7)


def test_without_gradients_nothing_moves_and_gradients_stay() -> None:
    torch.manual_seed(4)
    module = Parts()
    optimizer = optimizer_of(module)
    before = copy.deepcopy(module.state_dict())
    optimizer.step()
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items())
    give_gradients([module], 0)
    given = [parameter.grad.clone() for parameter in module.parameters() if parameter.grad is not None]
    optimizer.step()
    for parameter, gradient in zip(module.parameters(), given, strict=True):
        assert torch.equal(parameter.grad, gradient)


def test_numbers_out_of_range_are_named() -> None:
    for option, value, named in (("momentum", 1.0, "momentum"), ("momentum", -0.1, "momentum"), ("lr", -1.0, "rate")):
        with pytest.raises(ValueError, match=named):
            MuonAdamW([nn.Parameter(torch.zeros(1))], **{option: value})


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
