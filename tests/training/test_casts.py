"""Weights cast together equal autocast's own casts to the bit, in loss and gradients, with few copies."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from tests.training_helpers import NARROW
from vg2gt.training.module import VG2GTModule

MODELS = [
    pytest.param(("experiment=paper", "backend=oracle", *NARROW), id="paper"),
    pytest.param(("model=tiny",), id="tiny"),
    pytest.param(("model=tiny", "backend=da3_tiny", "backend.freeze=false"), id="trained backbone"),
]


class WeightCopies(TorchDispatchMode):
    """Counts single copies of weights to another dtype."""

    def __init__(self, weights: list[Tensor]) -> None:
        super().__init__()
        self.weights = {weight.data_ptr() for weight in weights}
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.overloadpacket.__name__ == "_to_copy":
            self.count += args[0].data_ptr() in self.weights
        return func(*args, **(kwargs or {}))


def step(module: VG2GTModule, batch) -> tuple[Tensor, dict[str, Tensor | None], int]:
    """Loss, gradients and single copies of weights in the forward pass of a step in bfloat16."""
    weights = dict(module.model.named_parameters())
    module.generator.manual_seed(0)
    torch.manual_seed(0)
    module.zero_grad(set_to_none=True)
    with WeightCopies(list(weights.values())) as copies, torch.autocast("cpu", torch.bfloat16):
        loss = module.training_step(batch, 0)
    loss.backward()
    return loss.detach(), {name: weight.grad for name, weight in weights.items()}, copies.count


@pytest.mark.parametrize("options", MODELS)
def test_casts_of_weights_equal_those_of_autocast(
    options: tuple[str, ...], benchmark_script: Callable, tmp_path: Path
) -> None:
    common = benchmark_script("common")
    run, batch = common.prepare(2, (28, 56), (*options, "data=synthetic"), torch.device("cpu"), tmp_path)
    module = run.module.train()
    common.whole_step(run)(batch)  # zero convolutions hide the gradients of the layers before them
    before = dict(module.model.named_parameters())
    loss, gradients, copies = step(module, batch)
    assert dict(module.model.named_parameters()) == before
    module.casts = lambda like: nullcontext()  # pyright: ignore[reportAttributeAccessIssue]
    expected, wanted, single = step(module, batch)
    assert torch.equal(loss, expected)
    assert sum(grad is not None for grad in wanted.values()) > 20
    for name, gradient in wanted.items():
        found = gradients[name]
        assert (found is None and gradient is None) or torch.equal(found, gradient), name
    assert copies <= 5 < 20 < single


def test_weights_return_after_an_error(benchmark_script: Callable, tmp_path: Path) -> None:
    common = benchmark_script("common")
    run, batch = common.prepare(2, (28, 56), ("data=synthetic",), torch.device("cpu"), tmp_path)
    module = run.module
    before = dict(module.named_parameters())
    cast = []

    def fail() -> None:
        with torch.autocast("cpu", torch.bfloat16), module.casts(batch.images):
            cast.append(module.model.gaussians.hidden.weight.dtype)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert cast == [torch.bfloat16]
    assert dict(module.named_parameters()) == before
