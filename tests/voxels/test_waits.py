"""How often the host waits for a GPU in the voxel modules, counted on the CPU."""

from types import ModuleType

import pytest
import torch

from vg2gt.method import grid, knn, sparse_conv
from vg2gt.method.additions import point_moments, voxel_normals


@pytest.fixture
def gpu_waits(benchmark_script) -> ModuleType:
    return benchmark_script("gpu_waits")


def test_what_waits_is_counted(gpu_waits: ModuleType) -> None:
    x = torch.arange(6)
    for waits, act in (
        (1, lambda: x.max().item()),
        (1, lambda: bool(x.any())),
        (1, lambda: x.tolist()),
        (1, lambda: x[0].tolist()),
        (1, lambda: x[x > 2]),
        (1, lambda: x.nonzero()),
        (2, lambda: x.bincount()),
        (1, lambda: x.repeat_interleave(x)),
        (1, lambda: x.unique_consecutive()),
        (2, lambda: torch.segment_reduce(x.float(), "sum", lengths=x[2:3] * 3)),
        (0, lambda: torch.segment_reduce(x.float(), "sum", lengths=x[2:3] * 3, unsafe=True)),
        (0, lambda: x.repeat_interleave(x, output_size=15)),
        (0, lambda: x[x.flip(0)]),
        (0, lambda: x.clone().masked_fill_(x > 2, 0).sort()),
        (0, lambda: torch.searchsorted(x, x)),
    ):
        with gpu_waits.Waits() as counted:
            act()
        assert counted.total == waits


def test_places_are_named(gpu_waits: ModuleType) -> None:
    from vg2gt.method.grid import plan_voxels

    batch = torch.zeros(5, dtype=torch.int64)
    with gpu_waits.Waits() as waits:
        plan_voxels(torch.rand(5, 3) * 2, batch, torch.ones(5, dtype=torch.bool))
    assert waits.places == {"method/grid.py plan_voxels": 2, "method/grid.py mixed_radix_keys": 1}


def test_the_modules_wait_for_shapes_and_for_two_warnings_only(
    gpu_waits, make_room, make_coarse, make_fine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As often for three scenes as for one, but for the footprint's medians."""
    for scenes in (1, 3):
        monkeypatch.setattr(grid, "_warned_of_sparse", set())  # what was warned of is not looked at again
        for module in (knn, voxel_normals, point_moments):
            monkeypatch.setattr(module, "compilable", lambda *_: False)  # as on a GPU
        monkeypatch.setattr(sparse_conv, "one_by_one", lambda device: False)
        tokens, geometry, images = make_room(scenes)
        coarse, fine = make_coarse(gate=True), make_fine(moments=True, normal_kernel=3)
        with gpu_waits.Waits() as waits:
            coarse(tokens, geometry)
            fine(tokens, geometry, images).features.sum().backward()
        plan = {"method/grid.py plan_voxels": 2 * 2, "method/grid.py mixed_radix_keys": 2 + 4}
        warnings = {"method/grid.py warn_if_sparse": 2, "method/fine.py _Points.__init__": 1}
        levels = {"method/ptv3.py Level.__init__": 3, "method/ptv3.py GridPool.forward": 2}
        assert waits.places == {
            **plan,
            **warnings,
            **levels,
            "method/coarse.py PatchPoints.__init__": 1,
            "method/sparse_conv.py neighbor_table": 3,
            "method/serialization.py serial_keys": 2,
            "method/additions/voxel_normals.py _pairs": 1,
            "kernels/cell_search.py _search": 2,
            "kernels/cell_search.py _nearest": 1,
            "method/additions/surface_evidence.py disagreement": 2,
            "method/fine.py _scene_medians": 1,
            "method/grid.py pool_mean_of_chunks": -(-3 * scenes // 8),  # once for eight views
            "method/point_mlp.py PointMLP._windows": 1,
        }
        fine = make_fine(min_footprint=1.0)
        with gpu_waits.Waits() as footprint, torch.no_grad():
            fine(tokens, geometry, images)
        assert footprint.places["method/grid.py scene_voxel_size"] == scenes
