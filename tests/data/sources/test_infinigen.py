"""Infinigen's own traps: depth of twice the images' size, the sky, file names, Blender's pixel centres."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from vg2gt.data import DataError
from vg2gt.data.sources import Infinigen
from vg2gt.data.splits import split_scenes
from vg2gt.geometry.cameras import project, ray_directions, unproject

from ..warping import camera
from .layouts import save

HEIGHT, WIDTH = 4, 6


PLAIN = np.full((HEIGHT, WIDTH), 2, np.float32)


def write_view(folder, name, depth=PLAIN, shift=0.0, camera=0):
    """One view with a symmetric camera, as Blender describes it."""
    image, stored, view = (folder / "frames" / kind / f"camera_{camera}" for kind in ("Image", "Depth", "camview"))
    save(image / f"Image_{name}.png", np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    for place in (stored, view):
        place.mkdir(parents=True, exist_ok=True)
    np.save(stored / f"Depth_{name}.npy", depth)
    pose = np.eye(4)
    pose[0, 3] = shift
    intrinsics = np.array([[5.0, 0, WIDTH / 2], [0, 5.0, HEIGHT / 2], [0, 0, 1]])
    np.savez(view / f"camview_{name}.npz", K=intrinsics, T=pose)


def test_depth_of_a_slanted_plane_is_right_to_a_quarter_of_a_pixel(tmp_path):
    """z = 1 / (a + b x) on the ray through an image pixel; fine pixel u lies at image pixel (u + 1/2) / 2 - 1/2."""

    def plane(u):
        return (1 / (0.4 + 0.3 * (u - (WIDTH - 1) / 2) / 5)).astype(np.float32)

    fine = np.tile(plane((np.arange(2 * WIDTH) + 0.5) / 2 - 0.5), (2 * HEIGHT, 1))
    write_view(tmp_path / "a", "0_0_0001_0", fine)
    frames = Infinigen(str(tmp_path)).load("a", [1])
    assert float(frames.intrinsics[0, 0, 2]) == (WIDTH - 1) / 2
    assert float(frames.intrinsics[0, 1, 2]) == (HEIGHT - 1) / 2
    columns = np.arange(WIDTH)
    np.testing.assert_allclose(frames.depth[0, 0].numpy(), plane(columns + 0.25), rtol=1e-6)
    assert np.abs(frames.depth[0, 0].numpy() - plane(columns)).max() > 0.01


def test_sky_and_what_is_too_far_have_no_depth(tmp_path):
    depth = PLAIN.copy()
    depth[0] = [np.inf, 1e10, 30.5, np.nan, -1, 29.5]
    write_view(tmp_path / "a", "0_0_0001_0", depth)
    assert Infinigen(str(tmp_path)).load("a", [1]).depth[0, 0].tolist() == [0, 0, 0, 0, 0, 29.5]
    assert Infinigen(str(tmp_path), max_depth=31).load("a", [1]).depth[0, 0, 2] == 30.5


def test_frames_are_numbered_by_what_varies(tmp_path):
    for frame in (9, 10, 100):
        write_view(tmp_path / "video", f"0_0_{frame:04d}_0")
    for rig in (2, 10, 1):
        write_view(tmp_path / "rigs", f"{rig}_0_0048_0", shift=rig)
    for name in ("0_0_0001_0", "0_0_0002_0", "3_0_0001_0"):
        write_view(tmp_path / "both", name)
    source = Infinigen(str(tmp_path))
    assert (source.frames("video"), source.frames("rigs")) == ((9, 10, 100), (1, 2, 10))
    assert source.frames("both") == (1, 2, 300_001)
    assert source.load("rigs", [10, 2]).world_to_camera[:, 0, 3].tolist() == [-10, -2]


def test_parts_of_an_exported_scene_show_one_place(tmp_path):
    for part in ("scene_1/x", "scene_1/y", "scene_2/x"):
        write_view(tmp_path / part, "0_0_0001_0")
    source = Infinigen(str(tmp_path))
    assert source.scenes == ("scene_1/x", "scene_1/y", "scene_2/x")
    assert [source.place(scene) for scene in source.scenes] == ["scene_1", "scene_1", "scene_2"]
    assert Infinigen(str(tmp_path / "scene_1")).scenes == ("x", "y")
    assert Infinigen(str(tmp_path / "scene_1" / "x")).scenes == ("x",)


def test_seeds_of_a_job_are_divided_when_the_job_is_named(tmp_path):
    """``JOB/SEED/frames`` looks like the parts of an exported scene; the error says how to tell them apart."""
    for seed in ("1a", "2b"):
        write_view(tmp_path / "indoors" / seed, "0_0_0001_0")
    with pytest.raises(DataError, match=r"single place \(indoors\).*data\.root=\[\.\.\./indoors\]"):
        split_scenes(Infinigen(str(tmp_path)), 0.5)
    train, val = split_scenes(Infinigen([str(tmp_path / "indoors")]), 0.5)
    assert sorted(train + val) == ["1a", "2b"]


def test_what_infinigen_itself_wrote_is_read_and_its_depth_is_z_depth():
    """Three frames of both cameras of a rig, 48x27, left by the render task of Infinigen 1.15.5 (a chair and a table
    of its making between three planes). One view's points lie where the other views see them; were its depth the
    length of rays, they would be off by half a percent and more. Images of the depth are next to the arrays."""
    source = Infinigen(str(Path(__file__).parents[1] / "reference" / "infinigen"), cameras=[0, 1])
    second = 1_000_000_000
    assert source.frames("room") == (1, 2, 3, second + 1, second + 2, second + 3)
    frames = source.load("room", source.frames("room"))
    assert frames.images.shape == (6, 3, 27, 48)
    assert 0.1 < frames.images.mean() < 0.9
    assert (frames.depth > 0).all()
    between = frames.world_to_camera[3:] @ torch.linalg.inv(frames.world_to_camera[:3])
    torch.testing.assert_close(between[:, 0, 3], torch.full((3,), -0.075), atol=1e-5, rtol=0)
    rays = ray_directions(frames.intrinsics, (27, 48)).norm(dim=-1)
    for one, other in ((0, 1), (0, 2), (0, 3), (1, 5)):
        assert _disagreement(frames, one, other) < 1e-4
        assert _disagreement(replace(frames, depth=frames.depth / rays), one, other) > 2e-3


def _disagreement(frames, one, other):
    """Median relative difference of inverse depth, interpolated between pixels, where two views see the same."""
    points = unproject(frames.depth[None, [one]], camera(frames, one))
    pixels, z = project(points, camera(frames, other))
    grid = 2 * pixels[0] / torch.tensor([47.0, 26.0]) - 1
    stored = torch.nn.functional.grid_sample(1 / frames.depth[None, [other]], grid, align_corners=True)[0, 0]
    difference = (stored * z[0, 0] - 1).abs()[(grid[0].abs() < 0.95).all(-1)]
    return float(difference.median())


def test_both_cameras_of_a_rig_are_held_out_together(tmp_path):
    for frame in range(4):
        write_view(tmp_path / "a", f"0_0_{frame:04d}_0")
        write_view(tmp_path / "a", f"0_0_{frame:04d}_1", PLAIN + 1, shift=0.075, camera=1)
    source = Infinigen(str(tmp_path), cameras=[0, 1], holdout=2)
    second = 1_000_000_000
    assert source.frames("a") == (0, 1, 2, 3, second, second + 1, second + 2, second + 3)
    assert source.held_out("a") == (1, 3, second + 1, second + 3)
    frames = source.load("a", [2, second + 2])
    assert frames.depth[:, 0, 0].tolist() == [2, 3]
    assert frames.world_to_camera[:, 0, 3].tolist() == pytest.approx([0, -0.075])
    assert Infinigen(str(tmp_path)).frames("a") == (0, 1, 2, 3)
    assert Infinigen(str(tmp_path), cameras=[1]).load("a", [second]).depth[0, 0, 0] == 3
    with pytest.raises(ValueError, match=r"cameras must be different numbers .* got \[0, 0\]"):
        Infinigen(str(tmp_path), cameras=[0, 0])
