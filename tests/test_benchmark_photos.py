"""benchmarks/photos.py on a procedural room: what programs are given, what is scored, and what is written."""

import json
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from vg2gt.data import SyntheticScenes
from vg2gt.geometry.cameras import project, unproject
from vg2gt.io import colmap_from_views, named_cameras, read_colmap, write_cameras_json, write_colmap, write_gaussian_ply
from vg2gt.io.images import to_pixels
from vg2gt.types import Cameras, Gaussians

SIZE = (56, 80)
HELD_OUT = [2, 6]
PROGRAM = """#!{python} -S
import shutil, sys, time
options = dict(option.lstrip("-").partition("=")[::2] for option in sys.argv[1:])
steps, began = int(options["num-iters"]), time.process_time()
with open({log!r}, "a") as log:
    log.write(options["num-iters"] + "\\n")
for step in range(1, steps + 1):
    while time.process_time() < began + step * 0.004:
        pass
    print(f"Step {{step}}", flush=True)
if {works}:
    shutil.copy({scene!r}, options["output"])
"""


@pytest.fixture(scope="module")
def room():
    """Seven views that overlap, with depth, and their cameras."""
    source = SyntheticScenes(1, num_frames=7, size=SIZE)
    frames = source.load(source.scenes[0], range(7))
    return frames, Cameras(frames.world_to_camera[None], frames.intrinsics[None], SIZE)


@pytest.fixture
def photos(room, tmp_path: Path) -> Path:
    """Photographs with ``cameras.json``."""
    frames, cameras = room
    names = [f"IMG_{index}.png" for index in range(7)]
    (tmp_path / "room").mkdir()
    for name, image in zip(names, frames.images, strict=True):
        Image.fromarray(to_pixels(image)).save(tmp_path / "room" / name)
    write_cameras_json(tmp_path / "room" / "cameras.json", named_cameras(cameras, names))
    return tmp_path / "room"


@pytest.fixture
def command(tmp_path: Path, benchmark_script, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[dict[str, Any]]]:
    """Runs the script; gives the rows of its file."""
    script = benchmark_script("photos")

    def run(*arguments: str) -> list[dict[str, Any]]:
        where = ["--poses", "given", "--size", "80", "--out", str(tmp_path), "--work", str(tmp_path / "work")]
        monkeypatch.setattr(sys, "argv", ["photos.py", *arguments, *where])
        script.main()
        return json.loads(max(tmp_path.glob("*-photos.json")).read_text())["rows"]

    return run


def add_points(photos: Path, room) -> None:
    """Puts a COLMAP model with five points in the place of cameras.json: seen by views (0, 2), (2, 6), (0, 1), ..."""
    frames, cameras = room
    (photos / "cameras.json").unlink()
    (photos / "images").mkdir()
    for path in photos.glob("*.png"):
        path.rename(photos / "images" / path.name)
    seen = [(0, 2), (2, 6), (0, 1), (1, 2, 4), (3,)]
    positions = unproject(frames.depth[None], cameras)[0, 0, 20:25, 30].double().numpy()
    point, view = np.array([(point, view) for point, views in enumerate(seen) for view in views]).T
    sources = (point, view, np.zeros((len(point), 2)))
    names = [f"IMG_{index}.png" for index in range(7)]
    write_colmap(photos / "sparse" / "0", colmap_from_views(cameras, names, positions, None, sources))


def program(folder: Path, works: bool = True) -> Path:
    """Takes 4 ms of processor time a step and leaves one Gaussian."""
    one = torch.ones(1)
    quat, scene = torch.tensor([[1.0, 0, 0, 0]]), folder / "one.ply"
    write_gaussian_ply(
        scene, Gaussians(torch.ones(1, 3), quat, torch.ones(1, 3), one, torch.zeros(1, 1, 3), torch.zeros(1).long())
    )
    path = folder / "splat.py"
    path.write_text(PROGRAM.format(python=sys.executable, log=str(folder / "log"), works=works, scene=str(scene)))
    path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return path


def test_rows_are_measured_and_merged(command, photos: Path, tmp_path: Path, capsys) -> None:
    rows = command(str(photos), "--budgets", "2", "--refine", "fill=0")
    assert [row["budget"] for row in rows] == ["feed-forward", 2.0]
    assert {(row["set"], row["size"], row["program"], row["settings"]) for row in rows} == {
        ("room", 80, "VG²GT", "refine.fill=0")
    }
    assert all(row["views"] == [5, 2] for row in rows)
    first, refined = rows
    assert first["psnr"] > 10
    assert refined["psnr_given"] > first["psnr_given"]
    assert 0 < first["core_seconds"] < 2 <= refined["core_seconds"] < 6
    assert refined["steps"] > 0
    assert all(0 < row["ssim"] < 1 for row in rows)
    assert all(row["gaussians"] > 100 and row["peak_memory_mb"] > 100 for row in rows)
    assert Image.open(tmp_path / "work" / "room-80.png").size == (3 * 80 + 8, 2 * 56 + 4)
    given = [path.name for path in (tmp_path / "work" / "room" / "80" / "images").iterdir()]
    assert sorted(given) == [f"{index:06d}.png" for index in range(7) if index not in HELD_OUT]
    rows = command(f"other={photos}", "--budgets", "--model", "fine.min_footprint=9")
    assert [(row["set"], row["settings"]) for row in rows] == [
        ("other", "model.fine.min_footprint=9"), ("room", "refine.fill=0"), ("room", "refine.fill=0")
    ]  # fmt: skip
    assert rows[0]["gaussians"] < first["gaussians"]
    table = max(tmp_path.glob("*-photos.md")).read_text()
    assert f"{first['psnr']:.2f} {first['ssim']:.3f} | {refined['psnr']:.2f} {refined['ssim']:.3f}" in table
    assert "other, VG²GT, feed-forward: " in capsys.readouterr().out


def test_what_only_left_out_views_saw_is_not_given(photos: Path, room, tmp_path: Path, benchmark_script) -> None:
    add_points(photos, room)
    prepared = benchmark_script("photo_sets").prepare(photos, tmp_path / "work", 80, 8, "given")
    assert (list(prepared.held_out), prepared.points) == (HELD_OUT, 2)
    model = read_colmap(prepared.folder / "sparse" / "0")
    points = list(model.points3D.values())
    seen = {image.name: image for image in model.images.values()}
    saw = {
        name: [v.image_id in {e.image_id for e in point.track.elements} for point in points] for name, v in seen.items()
    }
    assert saw == {
        "000000.png": [True, False], "000001.png": [True, True], "000003.png": [False, False],
        "000004.png": [False, True], "000005.png": [False, False],
    }  # fmt: skip
    positions = np.array([point.xyz for point in points])
    pixels, _ = project(torch.from_numpy(positions).float()[None, None], room[1].select(slice(1, 2)))
    found = sorted(point.xy.tolist() for point in seen["000001.png"].points2D)
    assert np.array(found) == pytest.approx(np.array(sorted((pixels[0, 0] + 0.5).tolist())), abs=1e-3)


def test_the_peer_gets_the_same_core_seconds(command, photos: Path, room, tmp_path: Path) -> None:
    add_points(photos, room)
    arguments = ["--only-peer", "--opensplat", str(program(tmp_path)), "--budgets", "1"]
    (row,) = command(str(photos), *arguments)
    assert (row["program"], row["settings"], row["gaussians"]) == ("OpenSplat", "default", 1)
    assert row["core_seconds"] == pytest.approx(1, rel=0.15)
    assert row["steps"] == pytest.approx(250, rel=0.15)
    tried, *others = (tmp_path / "log").read_text().splitlines()
    assert (tried, others[-1]) == ("100", str(row["steps"]))


def test_a_peer_that_cannot_be_run_is_an_error(command, photos: Path, room, tmp_path: Path) -> None:
    arguments = [str(photos), "--only-peer", "--opensplat", str(program(tmp_path, works=False)), "--budgets", "1"]
    with pytest.raises(ValueError, match=r"OpenSplat requires sparse points, but .* has none: use --poses sfm"):
        command(*arguments)
    add_points(photos, room)
    with pytest.raises(RuntimeError, match=r"splat.py .*--num-iters=100.* failed: (.|\n)*Step 100"):
        command(*arguments)


def test_sets_that_cannot_be_scored_are_refused(photos: Path, tmp_path: Path, benchmark_script) -> None:
    prepare = benchmark_script("photo_sets").prepare
    for index in range(2, 7):
        (photos / f"IMG_{index}.png").unlink()
    with pytest.raises(ValueError, match="only 2 photographs have cameras; at least 4 are needed"):
        prepare(photos, tmp_path / "work", 80, 8, "given")
    (photos / "cameras.json").unlink()
    with pytest.raises(ValueError, match=r"no cameras next to its images: expected cameras.json.*--poses sfm"):
        prepare(photos, tmp_path / "work", 80, 8, "given")
