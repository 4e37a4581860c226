"""The Infinigen recipe without Infinigen: camera paths in a box, the check of a room, resuming."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.commands import ROOT
from vg2gt.data.synthetic.rooms import SyntheticRoom
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene

RECIPE = ROOT / "recipes" / "infinigen"


@pytest.fixture
def recipe(monkeypatch):
    """Imports a module of the recipe."""
    monkeypatch.syspath_prepend(str(RECIPE))
    return importlib.import_module


class Box:
    """An empty room with solid boxes, as ``paths`` asks for it."""

    def __init__(self, size=(5.0, 4.0, 2.6), boxes=((0.6, 0.2, 0.35, 0.35), (-1.2, -0.9, 0.3, 0.3))):
        self.low = np.array([-size[0] / 2, -size[1] / 2, 0.0])
        self.high = np.array([size[0] / 2, size[1] / 2, size[2]])
        self.objects = np.array([(x, y, height, 1.7 * half) for x, y, height, half in boxes]).reshape(-1, 4)
        self._boxes = [
            (np.array([x - half, y - half, 0.0]), np.array([x + half, y + half, 2 * height]))
            for x, y, height, half in boxes
        ]

    def inside(self, point):
        return bool((point[:2] > self.low[:2]).all() and (point[:2] < self.high[:2]).all())

    def cast(self, origin, direction):
        with np.errstate(divide="ignore"):
            inverse = 1 / np.where(direction == 0, 1e-12, direction)

        def cross(low, high):
            a, b = (low - origin) * inverse, (high - origin) * inverse
            return np.minimum(a, b).max(), np.maximum(a, b).min()

        best, back = cross(self.low, self.high)[1], False
        for low, high in self._boxes:
            enter, leave = cross(low, high)
            if 0 < enter < min(leave, best):
                best, back = enter, False
            elif enter <= 0 < leave < best:
                best, back = leave, True
        return float(best), back


def test_paths_are_free_and_of_every_kind(recipe):
    paths = recipe("paths")
    room = Box()
    views = paths.plan(room, np.random.default_rng(0), 60)
    assert len(views) == 60
    kinds = {view.path.rsplit("_", 1)[0] for view in views}
    assert kinds == set(paths.SHARES)
    for view in views:
        assert room.inside(view.position)
        assert min(room.cast(view.position, side)[0] for side in paths._SIDES) >= paths._MARGIN
        assert not any(room.cast(view.position, side)[1] for side in paths._SIDES)
        pose = view.camera_to_world()
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(pose[:3, :3]) > 0
        assert pose[2, 1] < -0.5  # upright
    walking = [view for view in views if view.path.startswith("walk")]
    assert all(1.0 < view.position[2] < 1.9 for view in walking)
    again = paths.plan(room, np.random.default_rng(0), 60)
    assert all(np.array_equal(a.position, b.position) for a, b in zip(views, again, strict=True))


def test_a_room_without_space_is_an_error(recipe):
    with pytest.raises(ValueError, match=r"the room has space for \d+ of 60 views"):
        recipe("paths").plan(Box((0.8, 0.8, 2.6), ()), np.random.default_rng(0), 60)


def test_ten_rooms_are_held_out_two_of_each_kind(recipe):
    rooms = recipe("make")
    kinds = [rooms.kind(seed) for seed in rooms.HELD_OUT]
    assert len(set(rooms.HELD_OUT)) == 10
    assert max(rooms.HELD_OUT) < 40
    assert {kind: kinds.count(kind) for kind in rooms.KINDS} == dict.fromkeys(rooms.KINDS, 2)


def write_room(folder: Path, scene: SyntheticScene, ray_depth=False, shift=0.0) -> None:
    """Views of a procedural room as ``views.py`` writes them."""
    for kind in ("Image", "Depth", "camview"):
        (folder / "frames" / kind / "camera_0").mkdir(parents=True)
    count = len(scene.world_to_camera)
    (folder / "views.json").write_text(json.dumps([{"path": "walk_0"}] * count))
    height, width = scene.size
    intrinsics = scene.intrinsics + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    rays = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1) - intrinsics[:2, 2]
    longer = np.sqrt(1 + ((rays / intrinsics[0, 0]) ** 2).sum(-1))
    for i, frame in enumerate(scene.render(range(count), 1)):
        name = f"0_0_{i:04d}_0"
        Image.fromarray(frame.image).save(folder / f"frames/Image/camera_0/Image_{name}.jpg", quality=92)
        depth = frame.depth * longer if ray_depth else frame.depth
        depth[:4] = np.inf
        np.save(folder / f"frames/Depth/camera_0/Depth_{name}.npy", depth.astype(np.float16))
        pose = np.linalg.inv(scene.world_to_camera[i])
        pose[0, 3] += shift * (i % 2)
        np.savez(folder / f"frames/camview/camera_0/camview_{name}.npz", K=intrinsics, T=pose, HW=scene.size)


def test_the_check_finds_wrong_depth_and_wrong_poses(recipe, tmp_path):
    check = recipe("check")
    room = SyntheticRoom(3, 8, (56, 112))
    write_room(tmp_path / "right", room)
    write_room(tmp_path / "rays", room, ray_depth=True)
    write_room(tmp_path / "poses", room, shift=0.2)
    right, rays, poses = (check.check_room(tmp_path / name) for name in ("right", "rays", "poses"))
    assert right["ok"]
    assert right["pairs"] == 7
    assert right["difference"] < 5e-4  # 16 bits
    assert right["contradictions"] < 0.01
    assert right["beyond"] == pytest.approx(4 / 56, abs=1e-4)
    assert not rays["ok"]
    assert not poses["ok"]


FAKE = """#!/bin/sh
# Replaces Infinigen's interpreter: its first argument is the script.
echo "$@" >> {calls}
case "$1" in
  */coarse.py) [ "$3" = 1 ] && exit 3; mkdir -p "$7"; touch "$7/scene.blend";;
  */views.py) [ -e {broken} ] && exit 1; mkdir -p "$3"; cp {views} "$3/views.json";;
  */check.py) cat {figures};;
esac
"""


def test_rooms_are_made_in_stages_that_resume(recipe, tmp_path):
    make = recipe("make")
    calls, broken, figures, views = (tmp_path / name for name in ("calls", "broken", "figures", "views"))
    figures.write_text(json.dumps({"ok": True}) + "\n")
    views.write_text("[]")
    interpreter = tmp_path / "env/bin/python"
    interpreter.parent.mkdir(parents=True)
    (tmp_path / "env/lib/python3.11/site-packages").mkdir(parents=True)
    interpreter.write_text(FAKE.format(calls=calls, broken=broken, figures=figures, views=views))
    interpreter.chmod(0o755)
    out = tmp_path / "out"
    out.mkdir()

    def run(*seeds):
        rooms = make.Rooms(out, interpreter)
        calls.write_text("")
        for seed in seeds:
            rooms.make(seed)
        return [Path(line.split()[0]).stem for line in calls.read_text().splitlines()]

    broken.touch()
    assert run(0, 1) == ["coarse", "views", "coarse"]  # room 0 ends in its views, room 1 in its first stage
    assert "views.py" in (out / "work/room_0000/failed.txt").read_text()
    broken.unlink()
    assert run(0, 1) == []  # passed over until told otherwise
    (out / "work/room_0000/failed.txt").unlink()
    assert run(0, 1) == ["views", "check"]
    assert (out / "train/room_0000/views.json").exists()
    assert not (out / "work/room_0000/coarse").exists()  # the large file
    assert run(0) == []
    assert run(3) == ["coarse", "views", "check"]
    logged = [line.split(",")[:2] for line in (out / "log.csv").read_text().splitlines()]
    assert logged[-3:] == [["room_0003", script] for script in ("coarse.py", "views.py", "check.py")]
    assert json.loads((out / "held_out/room_0003/check.json").read_text())["kind"] == "Kitchen"
    figures.write_text(json.dumps({"ok": False}) + "\n")
    run(2)
    assert (out / "rejected/room_0002").exists()
    held = make.Rooms(out, interpreter)
    with pytest.raises(SystemExit, match="another process is making rooms in"):
        make.Rooms(out, interpreter)
    del held


def test_every_path_becomes_a_scene(recipe, tmp_path):
    room = tmp_path / "train/room_0000"
    frames = room / "frames/Image/camera_0"
    frames.mkdir(parents=True)
    views = ["turn_0", "walk_0", "near_0", "walk_0", "near_1"]
    (room / "views.json").write_text(json.dumps([{"path": path} for path in views]))
    for number in range(len(views)):
        (frames / f"Image_0_0_{number:04d}_0.jpg").write_bytes(b"%d" % number)
    for _ in range(2):  # what is there is kept
        recipe("make").link_paths(room)
    links = sorted((tmp_path / "paths/train/room_0000").glob("*/frames/Image/camera_0/*"))
    assert [(link.parents[3].name, link.name, link.read_bytes()) for link in links] == [
        ("near", "Image_0_0_0002_0.jpg", b"2"),
        ("near", "Image_0_0_0004_0.jpg", b"4"),
        ("walk", "Image_0_0_0001_0.jpg", b"1"),
        ("walk", "Image_0_0_0003_0.jpg", b"3"),
    ]
