"""Records: mapping over tensors, scene selection, views."""

import torch

from vg2gt.types import Gaussians, Voxels


def test_gaussians_of_a_scene_are_its_rows() -> None:
    batch = torch.tensor([0, 0, 2, 2, 2])
    rows = torch.arange(5.0)
    gaussians = Gaussians(
        rows[:, None].expand(5, 3), torch.ones(5, 4), torch.ones(5, 3), rows, torch.ones(5, 1, 3), batch
    )
    assert (gaussians.scene(0).opacities.tolist(), len(gaussians.scene(1))) == ([0, 1], 0)
    assert (gaussians.scene(2).opacities.tolist(), gaussians.scene(2).batch.tolist()) == ([2, 3, 4], [0, 0, 0])


def test_voxel_centers_use_their_scenes_size() -> None:
    grid = torch.tensor([[0, 0, 0], [-1, 2, 0]])
    ones = torch.ones(2)
    voxels = Voxels(
        torch.ones(2, 1),
        torch.ones(2, 3),
        grid,
        torch.tensor([0, 1]),
        ones,
        ones,
        torch.zeros(2, 3),
        torch.tensor([0.5, 2.0]),
    )
    assert voxels.centers.tolist() == [[0.25, 0.25, 0.25], [-1.0, 5.0, 1.0]]
