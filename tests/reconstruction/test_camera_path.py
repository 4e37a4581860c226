"""Orbits and paths of videos: where their cameras are, and what they see."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from vg2gt.cli import render as command
from vg2gt.io import FormatError, read_video, write_cameras_json, write_gaussian_ply
from vg2gt.io.cameras_json import NamedCamera, invert_pose
from vg2gt.reconstruction.camera_path import glide, look_at, median_depth, orbit, read_camera_path, resized
from vg2gt.rendering import Renderer
from vg2gt.types import Gaussians

DOWN = np.array([0.0, 0.6, 0.8])  # of the world of these scenes
AHEAD, SIDE = np.array([0.0, 0.8, -0.6]), np.array([1.0, 0, 0])
BALL = np.array([1.0, -2.0, 3.0])  # a red ball of radius 0.3
RENDERER = Renderer(mode="rasterized")


def scene_of(*parts: np.ndarray, scale: float = 0.06) -> Gaussians:
    """Opaque Gaussians at ``[N, 3]`` places; the first part is red, the others are grey."""
    means = torch.from_numpy(np.concatenate(parts)).float()
    sh = torch.zeros(len(means), 1, 3)
    sh[: len(parts[0])] = torch.tensor([2.2, -1.6, -1.6])
    quats, opacities = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4), torch.full((len(means),), 0.95)
    scales = torch.full((len(means), 3), scale)
    return Gaussians(means, quats, scales, opacities, sh, torch.zeros(len(means)).long())


def ball() -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(300, 3))
    return BALL + 0.3 * points / np.linalg.norm(points, axis=1, keepdims=True)


def place(degrees: float, radius: float = 2.0, height: float = 0.5) -> np.ndarray:
    angle = math.radians(degrees)
    return BALL - height * DOWN + radius * (math.cos(angle) * AHEAD + math.sin(angle) * SIDE)


def camera(center: np.ndarray, target: np.ndarray = BALL, size: tuple[int, int] = (45, 80)) -> NamedCamera:
    height, width = size
    intrinsics = np.array([[70.0, 0, (width - 1) / 2], [0, 70.0, (height - 1) / 2], [0, 0, 1]])
    return NamedCamera("view.png", width, height, intrinsics, look_at(center, target, DOWN))


def centers(cameras: list[NamedCamera]) -> np.ndarray:
    return invert_pose(np.stack([each.world_to_camera for each in cameras]))[:, :3, 3]


def test_orbit_is_level_and_even_at_the_median_height_and_distance() -> None:
    """Cameras all around, two of them elsewhere; held at all angles around their axis up to 20 degrees."""
    given = [camera(place(degrees, *rest)) for degrees in range(0, 360, 30) for rest in [(2.0, 0.5), (2.1, 0.6)]]
    given += [camera(place(10, 5.0, 2.0)), camera(place(200, 0.9, 0.1))]
    path = orbit(scene_of(ball()), given, RENDERER, (36, 64), fps=10, seconds=4)
    assert (path.kind, len(path.cameras), path.fps) == ("orbit", 40, 10)
    offsets = centers(path.cameras) - BALL
    heights = offsets @ -DOWN
    assert heights == pytest.approx(np.full(40, 0.55), abs=0.1)
    assert np.linalg.norm(offsets + np.outer(heights, DOWN), axis=1) == pytest.approx(np.full(40, 2.05), abs=0.15)
    steps = np.linalg.norm(np.diff(offsets, axis=0, append=offsets[:1]), axis=1)
    assert steps == pytest.approx(np.full(40, steps.mean()), rel=1e-3)
    for each in path.cameras:
        assert (each.width, each.height) == (64, 36)
        assert each.world_to_camera[0, :3] @ DOWN == pytest.approx(0, abs=0.02)
        local = each.world_to_camera[:3, :3] @ BALL + each.world_to_camera[:3, 3]
        assert np.abs(local[:2] / local[2]).max() < 0.08


def test_cameras_on_one_side_give_a_swing_between_them() -> None:
    path = orbit(scene_of(ball()), [camera(place(d)) for d in range(-170, -29, 20)], RENDERER, (36, 64), fps=10)
    assert (path.kind, len(path.cameras)) == ("swing", 80)
    offsets = centers(path.cameras) - BALL
    angles = np.degrees(np.arctan2(offsets @ SIDE, offsets @ AHEAD))
    assert (angles.min(), angles.max()) == pytest.approx((-170, -30), abs=5)


def wall(turned: float, distance: float) -> np.ndarray:
    """A wall 3 wide and 3 high that the orbit of radius 2 crosses."""
    across, up = np.meshgrid(np.linspace(-1.5, 1.5, 40), np.linspace(-1.5, 1.5, 40))
    middle, along = place(turned, distance, 0) - BALL, place(turned + 90, 1.0, 0) - BALL
    return BALL + middle + across.reshape(-1, 1) * along + up.reshape(-1, 1) * DOWN


def test_orbit_does_not_pass_through_walls() -> None:
    """The cameras come nearer where the wall is; an orbit at their median distance would be behind it."""
    given = [camera(place(degrees, 0.9 if 120 < degrees < 240 else 2.0)) for degrees in range(0, 360, 20)]
    free, blocked = (
        orbit(scene_of(ball(), *walls, scale=0.08), given, RENDERER, (36, 64), fps=10)
        for walls in ([], [wall(180, 1.2)])
    )
    assert (free.kind, blocked.kind) == ("orbit", "path")
    nearest = np.linalg.norm(centers(blocked.cameras)[:, None] - centers(given), axis=-1).min(1)
    assert nearest.max() < 0.7  # cameras are 0.7 apart, 1.3 where they come nearer
    side = (centers(blocked.cameras) - BALL) @ (place(180, 1.0, 0) - BALL)
    assert side.max() < 1.1


def test_cameras_inside_a_room_are_followed() -> None:
    """They look outwards at the walls, along a walk in one corner of the room."""
    walls = [wall(turned, 1.5) for turned in (0, 90, 180, 270)]
    spots = [place(turned, 0.3, 0.02 * (-1) ** index) for index, turned in enumerate(range(0, 360, 15))]
    given = [camera(spot, spot + (spot - BALL) @ (np.eye(3) - np.outer(DOWN, DOWN))) for spot in spots]
    path = orbit(scene_of(*walls, scale=0.1), given, RENDERER, (36, 64), fps=10)
    assert path.kind == "path"
    heights = (centers(path.cameras) - BALL) @ -DOWN
    assert np.abs(heights).max() < 0.02  # shakes by 0.02 are smoothed
    distance = np.linalg.norm(centers(path.cameras)[:, None] - centers(given), axis=-1).min(1)
    assert distance.max() < 0.15
    shuffled = [given[i] for i in np.random.default_rng(1).permutation(len(given))]
    mixed = orbit(scene_of(*walls, scale=0.1), shuffled, RENDERER, (36, 64), fps=10)
    assert len(mixed.cameras) < 2 * len(path.cameras)  # it goes from one to the next, not across the room


def test_scene_without_cameras_and_cameras_that_see_nothing() -> None:
    path = orbit(scene_of(ball()), [], RENDERER, (36, 64), fps=2)
    assert path.kind == "orbit"
    assert np.linalg.norm(centers(path.cameras) - BALL, axis=1) == pytest.approx(np.full(24, 0.9), abs=0.2)
    with pytest.raises(ValueError, match="see nothing of the scene"):
        orbit(scene_of(ball()), [camera(place(0), place(0) + place(0) - BALL)], RENDERER)


def test_glide_passes_through_cameras_at_constant_speed() -> None:
    given = [camera(place(0)), camera(place(0)), camera(place(50, 1.0)), camera(place(60, 3.0)), camera(place(200))]
    path = glide(given, 2.0, (90, 160), fps=50, seconds=4)
    assert (len(path.cameras), path.cameras[0].intrinsics[0, 0]) == (200, pytest.approx(140))
    poses, keys = (np.stack([c.world_to_camera for c in each]) for each in (path.cameras, given))
    for key in keys:
        assert np.abs(poses - key).max((1, 2)).min() < 0.08  # frames are up to 0.05 apart
    assert np.abs(poses[[0, -1]] - keys[[0, -1]]).max() < 1e-6
    moved = np.linalg.norm(np.diff(centers(path.cameras), axis=0), axis=1) / 2
    cosines = (np.einsum("nii->n", poses[:-1, :3, :3] @ poses[1:, :3, :3].swapaxes(1, 2)) - 1) / 2
    speed = np.hypot(moved, np.arccos(cosines.clip(-1, 1)))
    assert speed.std() < 0.05 * speed.mean()
    with pytest.raises(ValueError, match="two different cameras"):
        glide(given[:2], 1.0)


def test_size_keeps_how_much_is_seen() -> None:
    before = camera(place(0))
    assert np.allclose(resized(before, (90, 160)).intrinsics, [[140, 0, 79.5], [0, 140, 44.5], [0, 0, 1]])
    square = resized(before, (60, 60))
    assert np.allclose(square.intrinsics, [[70, 0, 29.5], [0, 70, 29.5], [0, 0, 1]])
    assert median_depth(scene_of(ball()), [before, square], RENDERER) == pytest.approx(
        math.hypot(2, 0.5) - 0.3, abs=0.1
    )


def frame(depth: float) -> dict:
    """A camera before the origin at z = depth that looks along -z, y up, as nerfstudio writes it."""
    return {"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, depth, 0, 0, 0, 1], "fov": 90, "aspect": 2.0}


def test_path_of_nerfstudio(tmp_path: Path) -> None:
    content = {"camera_type": "perspective", "render_height": 100, "render_width": 200, "fps": 12, "seconds": 0.2}
    file = tmp_path / "camera_path.json"
    file.write_text(json.dumps({**content, "keyframes": [], "camera_path": [frame(5), frame(6)]}))
    path = read_camera_path(file, None, None)
    assert (path.fps, [c.name for c in path.cameras]) == (12, ["frame-00000", "frame-00001"])
    assert np.allclose(path.cameras[1].world_to_camera, [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 6], [0, 0, 0, 1]])
    assert np.allclose(path.cameras[0].intrinsics, [[50, 0, 99.5], [0, 50, 49.5], [0, 0, 1]])
    larger = read_camera_path(file, (400, 300), 30)
    assert (larger.fps, larger.cameras[0].intrinsics[1, 1], larger.cameras[0].width) == (30, pytest.approx(200), 300)
    broken: list[tuple[dict, str]] = [
        ({"camera_type": "fisheye", "camera_path": [frame(5)]}, "camera_type is 'fisheye'"),
        ({"camera_path": []}, "camera_path is empty"),
        ({"camera_path": [{**frame(5), "fov": 180}]}, r"camera_path\[0\]\.fov is 180"),
        ({"camera_path": [frame(5), {"fov": 50}]}, r"camera_path\[1\]\.camera_to_world is missing"),
        ({"camera_path": [{**frame(5), "camera_to_world": [2.0] * 16}]}, "is not a rotation"),
    ]
    for wrong, said in broken:
        file.write_text(json.dumps(wrong))
        with pytest.raises(FormatError, match=said):
            read_camera_path(file, None, None)
    file.write_text("[]")
    assert read_camera_path(file, None, None) is None


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene's folder, as ``vg2gt reconstruct`` writes one."""
    write_gaussian_ply(tmp_path / "scene.ply", scene_of(ball()))
    write_cameras_json(tmp_path / "cameras.json", [camera(place(degrees)) for degrees in range(0, 360, 45)])
    return tmp_path


def run(*arguments: Path | str) -> None:
    command.main([*map(str, arguments), "--quiet", "--device", "cpu", "--mode", "rasterized"])


def test_video_of_a_folder(folder: Path, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("av")
    run(folder, "--orbit", "--size", "64x36", "--seconds", "0.5")
    assert {file.name for file in folder.iterdir()} == {"scene.ply", "cameras.json", "video.mp4"}
    assert "12 views of 300 Gaussians" in (printed := capsys.readouterr().out)
    assert "an orbit around what the cameras look at, 0.5 s at 24 frames per second" in printed
    frames = [pixels for _, pixels in read_video(folder / "video.mp4")]
    assert [pixels.shape for pixels in frames] == [(36, 64, 3)] * 12
    for pixels in frames:  # the ball in the middle, nothing around it
        assert pixels[16:20, 30:34].mean((0, 1)) == pytest.approx([255, 12, 12], abs=60)
        assert pixels[:, [0, -1]].max() < 40
    run(folder / "scene.ply", "--path", folder / "cameras.json", "--seconds", "1", "--fps", "6", "--save", "color.png",
        "--size", "32x18", "--out", folder / "path")  # fmt: skip
    assert sorted(file.name for file in (folder / "path" / "color").iterdir())[-1] == "frame-00005.png"
    run(folder, "--size", "32x18", "--out", folder / "views", "--save", "video.gif")  # its own cameras
    assert [pixels.shape for _, pixels in read_video(folder / "views" / "video.gif")] == [(18, 32, 3)] * 8


def test_mistakes_of_a_video(folder: Path) -> None:
    alone = folder / "alone"
    alone.mkdir()
    write_gaussian_ply(alone / "ball.ply", scene_of(ball()))
    (folder / "nerfstudio.json").write_text(json.dumps({"camera_path": [frame(5)]}))
    (folder / "one.json").write_text(json.dumps([camera(place(0)).fields()]))
    cases: list[tuple[tuple[Path | str, ...], str]] = [
        ((alone,), r"alone has no scene.ply"),
        ((alone / "ball.ply",), "alone has no cameras.json: choose the cameras with --cameras, --orbit or --path"),
        ((folder, "--seconds", "3"), "--seconds requires --orbit or --path"),
        ((folder, "--orbit", "--interpolate", "2"), "--interpolate is for views as they are"),
        ((folder, "--path", folder / "nerfstudio.json", "--seconds", "3"), "leave --seconds away"),
        ((folder, "--path", folder / "one.json"), "two different cameras, got 1"),
        ((folder, "--path", folder / "absent.json"), "absent.json"),
        ((folder, "--orbit", "--save", "film.avi"), "unknown output 'film.avi'"),
    ]
    for arguments, said in cases:
        with pytest.raises(SystemExit, match=said):
            run(*arguments)
    for flag, value in (("--size", "1920"), ("--seconds", "-1"), ("--fps", "0")):
        with pytest.raises(SystemExit) as ended:
            run(folder, "--orbit", flag, value)
        assert ended.value.code == 2
    assert not [file for file in folder.rglob("*") if file.suffix in (".mp4", ".tmp", ".png")]


def test_interrupted_video_leaves_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("av")
    (folder / "video.mp4").write_text("the former one")
    rendered: list[int] = []

    def third_is_interrupted(_: object) -> np.ndarray:
        rendered.append(1)
        if len(rendered) > 3:
            raise KeyboardInterrupt
        return np.zeros((36, 64, 3), np.uint8)

    monkeypatch.setattr("vg2gt.outputs.outputs.to_pixels", third_is_interrupted)
    with pytest.raises(SystemExit):
        run(folder, "--orbit", "--size", "64x36", "--overwrite")
    assert (folder / "video.mp4").read_text() == "the former one"
    assert {file.name for file in folder.iterdir()} == {"scene.ply", "cameras.json", "video.mp4"}
