"""How often the host waits for a GPU in the voxel modules, counted on the CPU."""

from types import ModuleType

import pytest
import torch

from vg2gt.method import grid, knn, sparse_conv
from vg2gt.method.additions import point_moments, voxel_normals


@pytest.fixture
def gpu_waits(benchmark_script) -> ModuleType:
    return benchmark_script("gpu_waits")


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
        plan = {"method/grid.py plan_voxels": 2 * 2, "method/grid.py mixed_radix_keys": 3}
        warnings = {"method/grid.py warn_if_sparse": 2, "method/fine.py _Points.__init__": 1}
        levels = {"method/ptv3.py PTv3.forward": 1, "method/ptv3.py make_levels": 1}  # whatever their number
        assert waits.places == {
            **plan,
            **warnings,
            **levels,
            "method/coarse.py PatchPoints.__init__": 1,
            "method/sparse_conv.py neighbor_tables": 1,
            "method/serialization.py serial_keys": 1,
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
