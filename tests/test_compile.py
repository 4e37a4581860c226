"""``torch.compile`` takes the networks whole: no graph breaks inside a module whose shapes are known."""

from types import ModuleType

import pytest
import torch

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
    known = ("serialization.py serial_keys", "ptv3.py ", "point_mlp.py _windows")
    assert found.reasons
    assert all(reason.startswith((*known, "sparse_conv.py", "grid.py")) for reason in found.reasons), found.reasons
