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


@pytest.mark.parametrize("count", [6, pytest.param(250, marks=pytest.mark.slow)])
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
    assert refused > 0


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


def lines(change: Callable[[list[str]], list[str]]) -> Callable[[Path], Any]:
    return lambda path: path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def entries(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], Any]:
    """Changes what a JSON file holds."""

    def edit(path: Path) -> None:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return edit


def arrays(**changes: Any) -> Callable[[Path], Any]:
    """Exchanges arrays of an ``.npz`` file; None removes one."""

    def edit(path: Path) -> None:
        changed = {**np.load(path), **changes}
        np.savez(path, **{name: array for name, array in changed.items() if array is not None})

    return edit


def numbers(change: Callable[[np.ndarray], Any]) -> Callable[[Path], Any]:
    """Changes the matrix in a text file."""
    return lambda path: np.savetxt(path, change(np.loadtxt(path)))


def image(*shape: int, kind: type = np.uint16, value: int = 1) -> Callable[[Path], Any]:
    return lambda path: Image.fromarray(np.full(shape, value, kind)).save(path)


def array(*shape: int, kind: type = np.float32, value: float = 1) -> Callable[[Path], Any]:
    return lambda path: np.save(path, np.full(shape, value, kind))


def cut(share: float) -> Callable[[Path], Any]:
    return lambda path: path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def at(place: int, *values: bytes) -> Callable[[Path], Any]:
    def edit(path: Path) -> None:
        content, new = path.read_bytes(), b"".join(values)
        path.write_bytes(content[:place] + new + content[place + len(new) :])

    return edit


def equirectangular(rows: list[str]) -> list[str]:
    return [*rows[:-1], f"{rows[-1].split()[0]} EQUIRECTANGULAR 40 30 40 30"]


def in_colour(path: Path) -> None:
    path.write_bytes(b"PF\n4 3\n-1\n" + bytes(144))


gone = Path.unlink
POSE = "1305031102.0 1 2 3 0 0 0 1\n"
HUGE = struct.pack("<Q", 1 << 61)
SENS = 4 + 8 + 15 + 4 * 64 + 2 * 4 + 4 * 4 + 4  # first byte of the number of frames
TIMES = "must have lines of 'timestamp path'"
SIMILARITY = "Barn_trans.txt of scene Barn.*not a rotation, a scale and a translation"
CAMERA, LOG, VIEW = "00000001_cam.txt", "Barn_COLMAP_SfM.log", "Depth_0_0_0048_0.npy"
NAMED: dict[str, list[tuple[str, Callable[[Path], Any], str]]] = {
    "dtu": [
        (CAMERA, swap("intrinsic", "intrinsics"), f"{CAMERA} of scene scan65.*not a camera of MVSNet"),
        ("*_0002.pfm", in_colour, r"depth_map_0002\.pfm of scene scan65"),
        (CAMERA, swap("0.0 0.0 0.0 1.0", "0.0 0.0 0.5 1.0"), f"{CAMERA}.*not a rigid transform"),
        ("images", lambda folder: halve(folder, folder), "principal point .* the images are 20x15"),
    ],
    "colmap_text": [("cameras.txt", lines(equirectangular), "EQUIRECTANGULAR has no pinhole equivalent; convert im")],
    "tanks_and_temples": [
        ("Barn_trans.txt", put("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n"), SIMILARITY),
        (LOG, put("0 0 0\n1 0 0 0\n"), f"{LOG} of scene Barn: expected 3 numbers and a 4x4 matrix for each image"),
        ("000002.png", gone, "7 poses for 6 images; they are matched by order"),
    ],
    "tum": [
        ("groundtruth.txt", gone, "scene rgbd_dataset_freiburg1_desk in .* has no groundtruth.txt"),
        ("rgb.txt", put("nan rgb/a.png\n"), TIMES),
        ("groundtruth.txt", put(POSE.replace(" 1\n", " 0\n")), "1 frames whose pose is not finite"),
    ],
    "infinigen": [
        (VIEW, lambda path: path.rename(path.with_name("Depth_x.npy")), "is not named Depth_RIG"),
        ("camview_*", lambda path: [each.unlink() for each in path.parent.iterdir()], "6 frames without a pose"),
        (VIEW, array(60, 80, kind=int), rf"{VIEW} of scene 1a2b3c is not a depth image"),
        (VIEW, array(60, 40), "different aspect ratios"),
        ("camview_*_0048_0.npz", arrays(T=np.eye(4)[:3]), r"T in .*0048_0\.npz of scene 1a2b3c must hold 4x4 numbers"),
        (VIEW, array(60, 80, value=1e10), rf"{VIEW} of scene 1a2b3c has no valid depth .*data\.max_depth"),
    ],
    "nerfstudio": [
        ("*.json", entries(lambda c: c.update(camera_model="EQUIRECTANGULAR")), "EQUIRECTANGULAR; supported: PIN"),
        ("*.json", entries(lambda c: c.update(w=80, h=80)), "is 40x30 pixels, but its camera in .* 80x80"),
        ("*.json", entries(lambda c: c.update(k1=1e6)), "scene desk.*maps the image border outside"),
        ("*.json", entries(lambda c: c.update(frames=[])), "none of the 0 images"),
        ("*.json", entries(lambda c: c["frames"][0].update(transform_matrix=[[1]])), "scene desk.*transform_matrix"),
    ],
    "stray_scanner": [
        ("odometry.csv", put("timestamp, frame\n0, 0\n"), "is damaged"),
        ("odometry.csv", put(""), r"odometry\.csv .*is damaged|has no frames"),
        ("camera_matrix.csv", put("1,2\n3,4\n"), "is damaged"),
        ("camera_matrix.csv", put("a,b\n"), "is damaged"),
    ],
    "scannet_sens": [
        ("*.sens", at(0, b"\5"), r"cannot read .*\.sens of scene scene0707_00: .*version 5 of the format, expected 4"),
        ("*.sens", at(SENS - 24, b"\2"), "colour of type 2 and depth of type 2"),
        ("*.sens", at(SENS - 20, b"\xff\xff\xff\xff"), "images of 4294967295x30"),
        ("*.sens", at(SENS, HUGE), "it ends .*within"),
        ("*.sens", at(SENS, bytes(8)), "it holds no frame"),
        ("*.sens", at(SENS + 8 + 64 + 16, HUGE), "it ends within frame 0 of 6"),
        ("*.sens", lambda path: path.write_bytes(path.read_bytes()[:100]), "it ends after 100 bytes, within a header"),
    ],
    "rgbd": [
        ("images/00012.png", gone, "one line of numbers .* for each of the 5 images; it has 6"),
        ("poses.txt", gone, r"scene office in .* has 6 colour and 6 depth images but no poses: add poses\.txt"),
        ("poses.txt", lines(lambda rows: rows[1:]), "each of the 6 images; it has 5 lines of 16"),
        ("poses.txt", put("a b\n"), r"cannot read .*poses\.txt of scene office"),
        ("poses.txt", numbers(lambda poses: 2 * poses), "frame 10 in .*scene office.* not a rigid"),
        ("poses.txt", numbers(lambda poses: poses * np.nan), "no usable frame .*; 6 frames whose pose is not finite"),
        ("K.txt", gone, r"no intrinsics: add K\.txt"),
        ("K.txt", put("1 1 1\n1 1 1\n"), r"K\.txt .* 3x3 or 4x4 matrix, not 2x3"),
        ("K.txt", numbers(np.transpose), r"are not fx 0 cx, 0 fy cy, 0 0 1 \(transposed"),
        ("K.txt", put("30 3 20\n0 30 15\n0 0 1\n"), "with skew, which is not modelled"),
        ("K.txt", put("30 0 1e5\n0 30 15\n0 0 1\n"), "a principal point far outside"),
        ("K.txt", numbers(lambda k: np.diag([2, 2, 1]) @ k), r"K\.txt of scene .* \(about 78x58\): scale it"),
        ("K.txt", numbers(lambda k: np.diag([0.25, 0.25, 1]) @ k), r"another resolution \(about 10x7\)"),
        ("K.txt", numbers(lambda k: 0 * k), "no positive focal lengths"),
        ("images/00012.png", cut(0.3), r"cannot read .*s/00012\.png of scene office"),
        ("depth/00012.png", cut(0.3), r"cannot read .*h/00012\.png of scene office"),
        ("depth/00012.png", image(30, 38), r"00012\.png of scene office is 38x30 .* 40x30"),
        ("depth/00012.png", image(*SIZE, 3, kind=np.uint8), r"00012\.png of scene office is not a depth image"),
        ("depth/00012.png", image(*SIZE, value=65535), r"00012\.png of scene office has no valid depth"),
    ],
    "replica": [
        ("traj.txt", lines(lambda rows: rows[:3]), r"traj\.txt of scene .*frames 0 to 5; it has 3 lines of 16")
    ],
}


@pytest.mark.parametrize(
    ("name", "pattern", "damage", "message"), [(name, *case) for name, cases in NAMED.items() for case in cases]
)
def test_what_is_wrong_is_named(name, pattern, damage, message, tmp_path):
    LAYOUTS[name].write(tmp_path, room())
    damage(sorted(tmp_path.rglob(pattern))[0])
    with pytest.raises(DataError, match=message):
        _read_all(LAYOUTS[name], tmp_path)
