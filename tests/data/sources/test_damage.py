"""Every layout with files truncated, altered, exchanged or removed: the documented error, or frames; never a crash.

The plain suite damages each layout a few times at random (``pytest -m slow``: 250 times), and chosen files in chosen
ways, whose error must name what is wrong.
"""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from shutil import copytree, rmtree
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.io.mutations import mutations
from vg2gt.data import DataError

from .layouts import SIZE, Layout, all_layouts, halve, room

LAYOUTS = all_layouts()
PICTURES = (".png", ".jpg", ".jpeg")
NUMBERS = (b"nan", b"inf", b"-1", b"0", b"1e30", b"999999999999", b"word", b"")


@pytest.mark.parametrize("count", [2, pytest.param(250, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", LAYOUTS)
def test_damage_is_a_data_error_or_frames(name, count, tmp_path):
    layout, whole, copy, refused = LAYOUTS[name], tmp_path / "whole", tmp_path / "damaged", 0
    layout.write(whole, room())
    for seed in range(2000, 2000 + count):
        copytree(whole, copy)
        what = _damage(copy, np.random.default_rng(seed))
        try:
            _read_all(layout, copy)
        except (DataError, FileNotFoundError) as error:
            refused += 1
            message = str(error)
            if str(copy) not in message and "scene" not in message:
                pytest.fail(f"{what} (seed {seed}): the error names neither file nor scene: {message}")
        except Exception as error:
            pytest.fail(f"{what} (seed {seed}) ended in {type(error).__name__}: {error}")
        rmtree(copy)
    assert refused > 0 or count < 10


def _read_all(layout: Layout, folder: Path) -> None:
    source = layout.read(folder)
    for scene in source.scenes:
        ids = source.frames(scene)
        assert len(ids) > 0
        frames = source.load(scene, ids)
        for value in (frames.images, frames.depth, frames.world_to_camera, frames.intrinsics):
            assert len(value) == len(ids)
            assert bool(torch.isfinite(value).all())
        assert bool((frames.depth >= 0).all())
        if source.has_depth:
            assert bool((frames.depth > 0).flatten(1).any(1).all()), "a frame without depth was handed on"


def _damage(folder: Path, rng: np.random.Generator) -> str:
    """Damages one file below ``folder``; returns what was done."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    # Half of the draws go to what is no picture: there are few such files, and they are parsed by our own code.
    others = [path for path in files if path.suffix not in PICTURES]
    chosen = others if others and rng.random() < 0.5 else files
    path = chosen[rng.integers(len(chosen))]
    content = path.read_bytes()
    kind = str(rng.choice(["bytes", "bytes", "remove", "exchange", "number", "lines"]))
    if kind == "bytes" and content:
        kinds = list(mutations(content, 6, int(rng.integers(1 << 30))))
        path.write_bytes(kinds[rng.integers(6)])
    elif kind == "exchange":
        path.write_bytes(files[rng.integers(len(files))].read_bytes())
    elif kind == "number":
        words = content.split(b" ")
        words[rng.integers(len(words))] = NUMBERS[rng.integers(len(NUMBERS))]
        path.write_bytes(b" ".join(words))
    elif kind == "lines":
        lines = content.split(b"\n")
        first = int(rng.integers(len(lines)))
        path.write_bytes(b"\n".join(lines[:first] + lines[first + 1 + int(rng.integers(3)) :]))
    else:
        path.unlink()
    return f"{kind} {path.relative_to(folder)}"


def swap(old: str, new: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(path.read_text().replace(old, new))


def put(text: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(text)


def entries(**changes: Any) -> Callable[[Path], Any]:
    """Changes what a JSON file holds."""
    return lambda path: path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def arrays(**changes: Any) -> Callable[[Path], Any]:
    """Exchanges arrays of an ``.npz`` file."""
    return lambda path: np.savez(path, **{**np.load(path), **changes})


def numbers(change: Callable[[np.ndarray], Any]) -> Callable[[Path], Any]:
    """Changes the matrix in a text file."""
    return lambda path: np.savetxt(path, change(np.loadtxt(path)))


def image(*shape: int, kind: type = np.uint16, value: int = 1) -> Callable[[Path], Any]:
    return lambda path: Image.fromarray(np.full(shape, value, kind)).save(path)


def array(*shape: int, kind: type = np.float32, value: float = 1) -> Callable[[Path], Any]:
    return lambda path: np.save(path, np.full(shape, value, kind))


def at(place: int, new: bytes) -> Callable[[Path], Any]:
    def edit(path: Path) -> None:
        content = path.read_bytes()
        path.write_bytes(content[:place] + new + content[place + len(new) :])

    return edit


def last_camera(words: str) -> Callable[[Path], Any]:
    """Replaces the last camera of a COLMAP model in text by one of the same number."""

    def edit(path: Path) -> None:
        *rows, last = path.read_text().splitlines()
        path.write_text("\n".join([*rows, f"{last.split()[0]} {words}"]))

    return edit


gone = Path.unlink
HUGE = struct.pack("<Q", 1 << 61)
SENS = 4 + 8 + 15 + 4 * 64 + 2 * 4 + 4 * 4 + 4  # first byte of the number of frames
CAMERA, LOG, VIEW = "00000001_cam.txt", "Barn_COLMAP_SfM.log", "Depth_0_0_0048_0.npy"
NAMED: list[tuple[str, str, Callable[[Path], Any], str]] = [
    ("dtu", CAMERA, swap("intrinsic", "intrinsics"), f"{CAMERA} of scene scan65.*not a camera of MVSNet"),
    ("dtu", CAMERA, swap("0.0 0.0 0.0 1.0", "0.0 0.0 0.5 1.0"), f"{CAMERA}.*not a rigid transform"),
    ("dtu", "images", lambda folder: halve(folder, folder), "principal point .* the images are 20x15"),
    ("dtu_training", "*_0002.pfm", put("PF\n4 3\n-1\n"), r"depth_map_0002\.pfm of scene scan1"),
    ("colmap_text", "cameras.txt", last_camera("EQUIRECTANGULAR 40 30 40 30"), "EQUIRECTANGULAR has no pinhole"),
    (
        "colmap_text",
        "cameras.txt",
        last_camera("PINHOLE 40 30 nan 27 20 15"),
        r"cameras\.txt: values that are not finite",
    ),
    ("tanks_and_temples", "Barn_trans.txt", put("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n"), "a rotation, a scale and"),
    ("tanks_and_temples", LOG, put("0 0 0\n1 0 0 0\n"), f"{LOG} of scene Barn.*has 2 lines; expected five for each"),
    ("tanks_and_temples", "000002.png", gone, "7 poses for 6 images; they are matched by order"),
    ("tum", "groundtruth.txt", gone, "scene rgbd_dataset_freiburg1_desk in .* has no groundtruth.txt"),
    ("tum", "rgb.txt", put("nan rgb/a.png\n"), "must have lines of 'timestamp path'"),
    ("tum", "groundtruth.txt", put("1305031102.0 1 2 3 0 0 0 0\n"), "1 frames whose pose is not finite"),
    ("scannetpp_iphone", "*.npz", arrays(trajectories=np.eye(4)[None]), "trajectories in .* must hold 7x4x4 numbers"),
    ("scannetpp_iphone", "*.npz", arrays(images=np.array(["frame_000010.jpg"] * 7)), "names frame 10 twice"),
    ("infinigen", VIEW, lambda path: path.rename(path.with_name("Depth_x.npy")), "is not named Depth_RIG"),
    ("infinigen", VIEW, array(60, 80, kind=int), rf"{VIEW} of scene 1a2b3c is not a depth image"),
    ("infinigen", VIEW, array(60, 40), "different aspect ratios"),
    ("infinigen", "camview_*_0048_0.npz", arrays(T=np.eye(4)[:3]), r"T in .* of scene 1a2b3c must hold 4x4 numbers"),
    ("infinigen", VIEW, array(60, 80, value=1e10), rf"{VIEW} of scene 1a2b3c has no valid depth .*data\.max_depth"),
    ("nerfstudio", "*.json", entries(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR; supported: PIN"),
    ("nerfstudio", "*.json", entries(w=80, h=80), "is 40x30 pixels, but its camera in .* 80x80"),
    ("nerfstudio", "*.json", entries(k1=1e6), "scene desk.*maps the image border outside"),
    ("nerfstudio", "*.json", entries(frames=[]), "none of the 0 images"),
    ("stray_scanner", "odometry.csv", put("timestamp, frame\n0, 0\n"), "is damaged"),
    ("stray_scanner", "odometry.csv", put("timestamp\n0,1e99,0,0,0,0,0,0,1\n"), "has no frames, or invalid"),
    ("scannet_sens", "*.sens", at(0, b"\5"), r"cannot read .*\.sens of scene .*version 5 of the format, expected 4"),
    ("scannet_sens", "*.sens", at(SENS - 24, b"\2"), "colour of type 2 and depth of type 2"),
    ("scannet_sens", "*.sens", at(SENS, HUGE), "it ends .*within"),
    ("scannet_sens", "*.sens", at(SENS + 8 + 64 + 16, HUGE), "it ends within frame 0 of 6"),
    ("rgbd", "images/00012.png", gone, "one line of numbers .* for each of the 5 images; it has 6 lines of 16"),
    ("rgbd", "images/00012.png", lambda path: path.rename(path.with_name("a.png")), "no frame number in its name"),
    ("rgbd", "images/00012.png", lambda path: path.rename(path.with_name("a13.png")), "have the same frame number 13"),
    ("rgbd", "poses.txt", gone, r"scene office in .* has 6 colour and 6 depth images but no poses: add poses\.txt"),
    ("rgbd", "poses.txt", put("a b\n"), r"cannot read .*poses\.txt of scene office"),
    ("rgbd", "poses.txt", put("# none\n"), r"poses\.txt of scene office holds no numbers"),
    ("rgbd", "poses.txt", numbers(lambda poses: 2 * poses), "frame 10 in .*scene office.* not a rigid"),
    ("rgbd", "poses.txt", numbers(lambda poses: poses * np.nan), "6 frames whose pose is not finite"),
    ("rgbd", "K.txt", gone, r"no intrinsics: add K\.txt"),
    ("rgbd", "K.txt", put("1 1 1\n1 1 1\n"), r"K\.txt .* 3x3 or 4x4 matrix, not 2x3"),
    ("rgbd", "K.txt", numbers(np.transpose), r"are not fx 0 cx, 0 fy cy, 0 0 1 \(transposed"),
    ("rgbd", "K.txt", numbers(lambda k: np.diag([2, 2, 1]) @ k), r"K\.txt of scene .* \(about 78x58\): scale it"),
    ("rgbd", "depth/00012.png", put("no image"), r"cannot read .*h/00012\.png of scene office"),
    ("rgbd", "depth/00012.png", image(30, 38), r"00012\.png of scene office is 38x30 .* 40x30"),
    ("rgbd", "depth/00012.png", image(*SIZE, 3, kind=np.uint8), r"00012\.png of scene office is not a depth image"),
    ("rgbd", "depth/00012.png", image(*SIZE, value=65535), r"00012\.png of scene office has no valid depth"),
    ("replica", "traj.txt", put("1 0 0\n" * 3), r"traj\.txt of scene .*frames 0 to 5; it has 3 lines of 3"),
    ("kitti", "calib_cam_to_cam.txt", swap("P_rect_02", "P_rect_03"), "P_rect_02 in .* should be 3x4 numbers"),
    ("kitti", "calib_velo_to_cam.txt", swap("T:", "T: 1e9"), "T in .* should be 3x1 numbers"),
    ("kitti", "0000000007.txt", put("49 8.4 116\n"), "is not an OXTS packet: it has 3 numbers"),
]


@pytest.mark.parametrize(("name", "pattern", "damage", "message"), NAMED)
def test_what_is_wrong_is_named(name, pattern, damage, message, tmp_path):
    LAYOUTS[name].write(tmp_path, room())
    damage(sorted(tmp_path.rglob(pattern))[0])
    with pytest.raises(DataError, match=message):
        _read_all(LAYOUTS[name], tmp_path)
