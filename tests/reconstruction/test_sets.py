"""Images are added to a scene and taken out again; what is left is what a scene that never saw them has."""

import hashlib
import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.data.sources.layout_rgbd import write_recording
from tests.reconstruction.test_windows import BY_ITSELF, built
from vg2gt.cli import reconstruct as command
from vg2gt.data import SyntheticScenes
from vg2gt.io import read_cameras_json, read_gaussian_ply
from vg2gt.monitor import Monitor
from vg2gt.outputs.saved import read_scene
from vg2gt.reconstruction.pipeline import add_images, take_out
from vg2gt.reconstruction.scene import Scene
from vg2gt.reconstruction.windows.run import gaussians_of
from vg2gt.reconstruction.windows.store import finished_sets, read_anchor, tidy
from vg2gt.rendering import Renderer

SETS = 4


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> list[Path]:
    """Recordings of one room, from frames that take turns."""
    source = SyntheticScenes(1, first_seed=5, num_frames=4 * SETS, size=(56, 84))
    folder = tmp_path_factory.mktemp("parts")
    found = []
    for part in range(SETS):
        frames = source.load(source.scenes[0], range(part, 4 * SETS, SETS))
        found.append(write_recording(folder, frames, f"part{part}", first=100 * part, digits=3))
    return found


@pytest.fixture(scope="module")
def model():
    return built("surfel")


def start(parts, folder: Path, *more: str) -> None:
    plain = ["--keep-windows", "--window", "4", "--refine", "0", "--quiet", "--device", "cpu"]
    command.main([str(parts[0]), "--out", str(folder), *plain, *more, *BY_ITSELF, "model.coarse=null"])


def fingerprint(gaussians) -> str:
    values = [value for value in vars(gaussians).values() if value is not None]
    return hashlib.sha256(b"".join(value.contiguous().numpy().tobytes() for value in values)).hexdigest()


def changed(change, model, scene: Path, part: Path) -> Scene:
    """The scene in a folder with images added or taken out."""
    return change(model, read_scene(scene, Renderer()), scene, part, Monitor(), 4)


@pytest.mark.parametrize(("changes", "met_again"), [(10, 4), pytest.param(20, 10, marks=pytest.mark.slow)])
def test_any_order_of_adding_and_taking_out_gives_the_same_scene(parts, model, tmp_path, changes, met_again) -> None:
    """Issue 49's bar, the slow case: 20 random orders, equal to the bit."""
    start(parts, tmp_path / "scene")
    first = read_gaussian_ply(tmp_path / "scene" / "scene.ply")
    kept, rng = tmp_path / "scene" / "windows", random.Random(0)
    seen: dict[frozenset, str] = {}
    there: set[int] = set()
    revisited = 0
    for _ in range(changes):
        part = rng.randrange(1, SETS)
        change = take_out if part in there else add_images
        scene = changed(change, model, tmp_path / "scene", parts[part])
        scene.save(tmp_path / "next", ("scene.ply", "cameras.json", "views.npz"))
        for file in (tmp_path / "next").iterdir():
            shutil.move(file, tmp_path / "scene" / file.name)
        tidy(kept)
        there ^= {part}
        assert len(scene.gaussians) > len(first) or not there
        assert scene.names == tuple(sorted(scene.names))
        assert np.isfinite(scene.gaussians.means.numpy()).all()
        assert len(scene.names) == 4 * (1 + len(there))
        assert len(finished_sets(kept)) == 1 + len(there)
        found = fingerprint(gaussians_of(model, kept, read_anchor(kept), Monitor()))
        revisited += frozenset(there) in seen
        assert seen.setdefault(frozenset(there), found) == found
    assert revisited >= met_again
    assert len(set(seen.values())) == len(seen)


def test_the_scene_without_them_is_the_scene_that_never_saw_them(parts, tmp_path) -> None:
    arguments = ["--quiet", "--device", "cpu", "--window", "4", "--refine", "0", *BY_ITSELF]
    arguments += ["model.coarse=null", "model.visibility=null"]
    start(parts, tmp_path / "scene", "model.visibility=null")
    before = (tmp_path / "scene" / "scene.ply").read_bytes()
    command.main(["--add", str(tmp_path / "scene"), str(parts[1]), *arguments])
    assert len(read_cameras_json(tmp_path / "scene" / "cameras.json")) == 8
    assert len(read_gaussian_ply(tmp_path / "scene" / "scene.ply")) > len(before) // 100
    assert (tmp_path / "scene" / "scene.ply").read_bytes() != before
    command.main(["--take-out", str(tmp_path / "scene"), str(parts[1]), *arguments])
    assert (tmp_path / "scene" / "scene.ply").read_bytes() == before
    assert len(read_cameras_json(tmp_path / "scene" / "cameras.json")) == 4


def test_taking_out_can_be_repeated_until_the_scene_is_written(parts, tmp_path, monkeypatch) -> None:
    start(parts, tmp_path / "scene")
    before = (tmp_path / "scene" / "scene.ply").read_bytes()
    rest = [str(parts[1]), "--quiet", "--device", "cpu", "--window", "4", "--refine", "0", *BY_ITSELF]
    rest.append("model.coarse=null")
    command.main(["--add", str(tmp_path / "scene"), *rest])
    with pytest.raises(SystemExit, match="--size, --drop cannot be combined with --add or --take-out"):
        command.main(["--take-out", str(tmp_path / "scene"), "--drop", "guessed", "--size", "56", *rest])
    with monkeypatch.context() as patch:
        patch.setattr("vg2gt.outputs.outputs.write_outputs", full)
        with pytest.raises(SystemExit, match="disk full"):
            command.main(["--take-out", str(tmp_path / "scene"), *rest])
    with pytest.raises(SystemExit, match="was interrupted: repeat it first"):
        command.main(["--add", str(tmp_path / "scene"), str(parts[2]), *rest[1:]])
    command.main(["--take-out", str(tmp_path / "scene"), *rest])
    assert (tmp_path / "scene" / "scene.ply").read_bytes() == before
    assert len(finished_sets(tmp_path / "scene" / "windows")) == 1


def full(*_, **__) -> None:
    raise OSError("disk full")


def test_what_cannot_be_changed_says_why(parts, model, tmp_path) -> None:
    start(parts, tmp_path / "scene")
    here = tmp_path / "scene"
    with pytest.raises(ValueError, match="already has images with these names: 000"):
        changed(add_images, model, here, parts[0])
    with pytest.raises(ValueError, match="not added by one command"):
        changed(take_out, model, here, parts[1])
    with pytest.raises(ValueError, match="another model"):
        changed(add_images, built("plain"), here, parts[1])
    anchor = here / "windows" / "scene.json"
    anchor.write_text(anchor.read_text().replace("shift", "moved"))
    with pytest.raises(ValueError, match="an earlier version: reconstruct the scene again"):
        changed(add_images, model, here, parts[1])
    shutil.rmtree(here / "windows")
    with pytest.raises(FileNotFoundError, match="--keep-windows"):
        changed(add_images, model, here, parts[1])
