"""Procedural rooms: exact geometry, determinism, the cache."""

import logging
from pathlib import Path

import numpy as np
import pytest
import torch

from vg2gt.data import SyntheticScenes
from vg2gt.data.synthetic.renderer import render_frame
from vg2gt.data.synthetic.rooms import SyntheticRoom
from vg2gt.geometry.cameras import invert_rigid, project, ray_directions, unproject
from vg2gt.types import Cameras

from .conftest import SIZE
from .warping import camera, depth_differences


def test_frames_follow_the_conventions(rooms):
    frames = rooms.load("room-000001", [4, 0])
    assert frames.images.shape == (2, 3, *SIZE)
    assert frames.images.dtype == frames.depth.dtype == torch.float32
    assert frames.images.min() >= 0
    assert frames.images.max() <= 1
    assert frames.depth.min() > 0.05
    assert frames.intrinsics[0, :2, 2].tolist() == [(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2]
    rotation = frames.world_to_camera[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), torch.eye(3).expand(2, 3, 3), atol=1e-6, rtol=0)


def test_points_of_one_frame_are_where_another_frame_sees_them():
    """Points seen by frame 0 are cast again from frame 1, through the very position where they project."""
    room = SyntheticRoom(3, 8, (56, 112))
    first = room.render([0], 1)[0]
    poses = torch.from_numpy(room.world_to_camera)[None]
    intrinsics = torch.from_numpy(room.intrinsics).expand(1, 8, 3, 3)
    cameras = Cameras(poses, intrinsics, room.size)
    points = unproject(torch.from_numpy(first.depth).double()[None, None], cameras.select(slice(0, 1)))
    pixels, z = project(points, cameras.select(slice(1, 2)))
    errors = []
    for y in range(2, 54, 6):
        for x in range(2, 110, 6):
            u, v = pixels[0, 0, y, x].tolist()
            if not (0 < u < 111 and 0 < v < 55):
                continue
            shifted = room.intrinsics.copy()
            shifted[:2, 2] -= (u, v)  # the position becomes pixel (0, 0)
            depth = float(render_frame(room.world, room.world_to_camera[1], shifted, (1, 1)).depth[0, 0])
            if depth > float(z[0, 0, y, x]) - 0.01:  # else frame 1 sees something in front of it
                seen = torch.tensor([(u - room.intrinsics[0, 2]), (v - room.intrinsics[1, 2])]) / room.intrinsics[0, 0]
                world = torch.cat((seen, torch.ones(1))).double() * depth
                pose = invert_rigid(poses[0, 1])
                back = room.world_to_camera[0] @ np.append((pose[:3, :3] @ world + pose[:3, 3]).numpy(), 1)
                pixel = room.intrinsics @ back[:3] / back[2]
                errors.append(np.hypot(pixel[0] - x, pixel[1] - y))
    assert len(errors) > 60
    assert max(errors) < 0.02


def test_depth_of_one_frame_predicts_the_next(rooms):
    frames = rooms.load("room-000002", range(6))
    differences, overlap = depth_differences(frames, 2, 3)
    assert overlap > 0.3
    assert differences.median() < 0.03  # nearest pixel of a 24x32 image


def test_normals_are_those_of_the_surface():
    rooms = SyntheticScenes(1, first_seed=5, num_frames=2, size=(56, 112))
    frames, normals = rooms.load("room-000005", [1]), rooms.normals("room-000005", [1])
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(1, 56, 112), atol=1e-5, rtol=0)
    rays = ray_directions(frames.intrinsics, (56, 112))
    assert ((normals.permute(0, 2, 3, 1) * rays).sum(-1) < 0).all()  # facing the camera
    points = (rays * frames.depth[..., None])[0]
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    estimate = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    cosine = (estimate * normals[0].permute(1, 2, 0)[1:-1, 1:-1]).sum(-1)
    assert (cosine > 0.999).float().mean() > 0.8  # everywhere but at edges and on curved parts
    assert cosine.median() > 0.99999


def test_colour_agrees_between_views():
    """Surfaces look alike from two places: texture sticks to them and light does not depend on the camera."""
    rooms = SyntheticScenes(1, first_seed=2, num_frames=12, size=(112, 224))
    frames = rooms.load("room-000002", [5, 6])
    points = unproject(frames.depth[None, :1], camera(frames, 0))
    pixels, z = project(points, camera(frames, 1))
    grid = pixels[0] / torch.tensor([223 / 2, 111 / 2]) - 1
    colors = torch.nn.functional.grid_sample(frames.images[1:], grid, align_corners=True)[0]
    depth = torch.nn.functional.grid_sample(frames.depth[1:, None], grid, align_corners=True)[0, 0]
    seen = (grid.abs().amax(-1)[0] < 1) & ((depth - z[0, 0]).abs() < 0.02)
    assert seen.float().mean() > 0.4
    difference = (colors - frames.images[0]).abs().mean(0)[seen]
    contrast = (frames.images[0] - frames.images[0].mean((1, 2), keepdim=True)).abs().mean(0)[seen]
    assert difference.mean() < 0.25 * contrast.mean()


def test_the_same_seed_gives_the_same_room_and_another_seed_another(rooms):
    again = SyntheticScenes(4, num_frames=6, size=SIZE)
    a, b = again.load("room-000001", [0, 3]), rooms.load("room-000001", [0, 3])
    assert torch.equal(a.images, b.images)
    assert torch.equal(a.depth, b.depth)
    assert not torch.equal(a.depth, again.load("room-000002", [0, 3]).depth)


def test_threads_do_not_change_pixels():
    room = SyntheticRoom(1, 4, SIZE)
    one, three = room.render(range(4), 1), room.render(range(4), 3)
    assert all(
        np.array_equal(a.image, b.image) and np.array_equal(a.depth, b.depth) for a, b in zip(one, three, strict=True)
    )


def test_a_damaged_cache_file_is_made_again(tmp_path, caplog):
    rooms = SyntheticScenes(1, num_frames=2, size=SIZE, cache_dir=str(tmp_path))
    whole = rooms.load("room-000000", [0, 1])
    path = rooms.cache_file("room-000000")
    assert path is not None
    content = path.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 3] ^= 0xFF
    for damaged in (content[: len(content) // 2], bytes(flipped), b""):
        path.write_bytes(damaged)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            again = rooms.load("room-000000", [0, 1])
        assert str(path) in caplog.text
        assert torch.equal(again.images, whole.images)
        assert torch.equal(again.depth, whole.depth)
        assert path.read_bytes() == content
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # no temporary file is left


def test_the_cache_is_read(tmp_path, monkeypatch):
    rooms = SyntheticScenes(1, num_frames=2, size=SIZE, cache_dir=str(tmp_path))
    first = rooms.load("room-000000", [1])
    monkeypatch.setattr(rooms, "_render", lambda scene: pytest.fail("rendered again"))
    assert torch.equal(rooms.load("room-000000", [1]).images, first.images)


def test_size_and_length_are_part_of_the_cache_key(tmp_path):
    names = {
        SyntheticScenes(1, num_frames=n, size=size, cache_dir=str(tmp_path)).cache_file("room-000000")
        for n, size in ((2, SIZE), (3, SIZE), (2, (32, 24)))
    }
    assert len(names) == 3


def test_another_version_of_the_generator_is_another_scene(monkeypatch):
    source = SyntheticScenes(2)
    before = source.identity("room-000000")
    assert before == SyntheticScenes(1, cache_dir="elsewhere").identity("room-000000")
    assert before != source.identity("room-000001")
    assert before != SyntheticScenes(1, highlights=True).identity("room-000000")
    monkeypatch.setattr(SyntheticRoom, "version", SyntheticRoom.version + 1)
    assert source.identity("room-000000") != before


def test_a_room_of_one_frame(tmp_path):
    frames = SyntheticScenes(1, num_frames=1, size=SIZE, cache_dir=str(tmp_path)).load("room-000000", [0])
    assert frames.depth.shape == (1, *SIZE)


@pytest.mark.parametrize("arguments", [{"num_scenes": 0}, {"num_frames": 0}, {"first_seed": -1}])
def test_impossible_arguments_are_refused(arguments):
    with pytest.raises(ValueError, match="num_scenes >= 1"):
        SyntheticScenes(**arguments)


def test_a_room_keeps_its_pixels():
    """Published figures were measured on these rooms: the same version of the generator must draw the same ones."""
    stored = np.load(Path(__file__).parent / "reference" / "room-000003.npz")
    room = SyntheticRoom(3, 8, (56, 112))
    frames = room.render([0, 5], 1)
    for name, found in (("parts", room.world.parts), ("materials", room.world.materials)):
        np.testing.assert_allclose(found, stored[name], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(room.world_to_camera, stored["world_to_camera"], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.stack([frame.depth for frame in frames]), stored["depth"], rtol=1e-6)
    # Processors that round products and sums otherwise move a pixel in ten thousand by a level or two.
    assert (np.stack([frame.image for frame in frames]) != stored["image"]).mean() < 1e-3
