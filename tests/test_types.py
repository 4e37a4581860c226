"""Records: mapping over tensors, scene selection, views."""

import pytest
import torch

from vg2gt.types import Batch, Cameras, Gaussians, Hints, Tokens, Voxels


def cameras(scenes: int, views: int) -> Cameras:
    poses = torch.eye(4).repeat(scenes, views, 1, 1)
    return Cameras(poses, torch.eye(3).repeat(scenes, views, 1, 1), (4, 6))


def test_map_reaches_nested_records_tuples_and_mappings() -> None:
    tokens = Tokens((torch.zeros(1), torch.zeros(2)), torch.zeros(3), (1, 1), (14, 14), {"depth": torch.zeros(4)})
    mapped = tokens.map(lambda tensor: tensor + 1)
    assert all(bool((tensor == 1).all()) for tensor in (*mapped.patch, mapped.camera, mapped.state["depth"]))
    assert mapped.grid == (1, 1)


def test_hints_map_their_depth_range_and_keep_what_is_unknown() -> None:
    doubled = Hints(depth_range=torch.tensor([[0.5, 4.0]])).map(lambda tensor: 2 * tensor)
    assert doubled.depth_range.tolist() == [[1, 8]]
    assert doubled.depth is None


def test_batch_splits_context_and_target() -> None:
    batch = Batch(
        torch.arange(2 * 5).reshape(2, 5, 1, 1, 1).expand(2, 5, 3, 4, 6),
        torch.zeros(2, 5, 4, 6),
        cameras(2, 5),
        torch.ones(2, dtype=torch.bool),
        torch.arange(10).reshape(2, 5),
        ("a", "b"),
        3,
    )
    assert batch.context.frame_ids.tolist() == [[0, 1, 2], [5, 6, 7]]
    assert batch.target.frame_ids.tolist() == [[3, 4], [8, 9]]
    second = batch.single(1)
    assert second.scene == ("b",)
    assert second.num_context == 3
    assert second.target.images[0, :, 0, 0, 0].tolist() == [8, 9]


def test_pinning_reaches_every_tensor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: tensor + 1)  # needs a GPU
    pinned = cameras(1, 2).pin_memory()
    assert torch.equal(pinned.world_to_camera, cameras(1, 2).world_to_camera + 1)
    assert torch.equal(pinned.intrinsics, cameras(1, 2).intrinsics + 1)


def test_gaussians_of_a_scene_are_its_rows() -> None:
    batch = torch.tensor([0, 0, 2, 2, 2])
    rows = torch.arange(5.0)
    gaussians = Gaussians(
        rows[:, None].expand(5, 3), torch.ones(5, 4), torch.ones(5, 3), rows, torch.ones(5, 1, 3), batch
    )
    assert gaussians.scene(0).opacities.tolist() == [0, 1]
    assert len(gaussians.scene(1)) == 0
    assert gaussians.scene(2).opacities.tolist() == [2, 3, 4]
    assert gaussians.scene(2).batch.tolist() == [0, 0, 0]


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
