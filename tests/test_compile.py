"""``torch.compile`` takes the networks whole: no graph breaks inside a module whose shapes are known."""

from types import ModuleType

import pytest
import torch
from torch import Tensor, nn

WHOLE = ["dense head", "depth head (DPT)", "PTv3 block", "PointMLP stage", "Gaussian head"]


@pytest.fixture
def breaks(benchmark_script) -> ModuleType:
    torch.manual_seed(0)
    return benchmark_script("compile_breaks")


@pytest.mark.parametrize("name", WHOLE)
def test_a_network_is_one_graph(name: str, breaks: ModuleType) -> None:
    assert breaks.explain(name, breaks.cases()[name]()) == breaks.Breaks(name, 1, ())


@pytest.mark.parametrize("name", [pytest.param("PTv3", marks=pytest.mark.slow), "PointMLP"])
def test_networks_that_list_voxels_break_at_their_numbers_only(name: str, breaks: ModuleType) -> None:
    found = breaks.explain(name, breaks.cases()[name]())
    known = ("serialization.py serial_keys", "ptv3.py __init__", "ptv3.py forward", "point_mlp.py _windows")
    assert found.reasons
    assert all(reason.startswith((*known, "sparse_conv.py", "grid.py")) for reason in found.reasons), found.reasons


@pytest.mark.slow
def test_a_compiled_network_computes_the_same(breaks: ModuleType) -> None:
    assert breaks.compiled_error("PointMLP stage") < 1e-5


def test_breaks_are_counted(breaks: ModuleType) -> None:
    class Reads(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x.exp() * x.sum().item()

    found = breaks.explain("reads", breaks.Case(Reads(), (torch.ones(3),)))
    assert found.graphs == 2
    assert [reason.split(":")[0] for reason in found.reasons] == ["test_compile.py forward"]
