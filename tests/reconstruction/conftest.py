"""A room as an RGB-D recording and as photographs of several sizes, and its reconstruction."""

import shutil
from pathlib import Path

import pytest
from PIL import Image

from tests.data.sources.layout_rgbd import write_recording
from tests.data.sources.layouts import pixels
from tests.reconstruction.by_itself import PlaneAhead
from tests.training_helpers import write_run
from vg2gt.cli import reconstruct as reconstruct_command
from vg2gt.data import SyntheticScenes
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.scene import Scene
from vg2gt.runs.load import LoadedModel, load_model

SIZE = (84, 112)
ORACLE = ["backend=oracle", "backend.depth_noise=0"]
STAND_IN = ["backend=custom", f"backend._target_={PlaneAhead.__module__}.{PlaneAhead.__name__}"]


@pytest.fixture(scope="session")
def frames():
    source = SyntheticScenes(1, num_frames=4, size=SIZE)
    return source.load(source.scenes[0], range(4))


@pytest.fixture(scope="session")
def recording(frames, tmp_path_factory) -> Path:
    """``images/ depth/ poses.txt K.txt``."""
    return write_recording(tmp_path_factory.mktemp("recordings"), frames, "room", first=8, digits=3)


@pytest.fixture
def folder(recording: Path, tmp_path: Path) -> Path:
    """The recording's images alone."""
    shutil.copytree(recording / "images", tmp_path / "room" / "images")
    return tmp_path / "room"


@pytest.fixture(scope="session")
def model():
    """One that needs cameras and nothing else."""
    return load_model(overrides=STAND_IN, device="cpu").model


@pytest.fixture(scope="session")
def photos(frames, tmp_path_factory) -> Path:
    """The same pictures: whole, larger as JPEG, lying on its side as its EXIF data say, cut to a portrait."""
    folder = tmp_path_factory.mktemp("holiday") / "photos"
    folder.mkdir()
    pictures = [Image.fromarray(image) for image in pixels(frames)]
    pictures[0].save(folder / "IMG_8.png")
    pictures[1].resize((448, 336)).save(folder / "IMG_9.jpg", quality=95)
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned clockwise
    pictures[2].rotate(90, expand=True).save(folder / "IMG_10.jpg", quality=95, exif=exif)
    pictures[3].crop((28, 0, 84, 84)).save(folder / "IMG_11.png")
    return folder


@pytest.fixture(scope="session")
def ready() -> LoadedModel:
    return load_model(overrides=ORACLE, device="cpu")


@pytest.fixture(scope="session")
def scene(ready, recording) -> Scene:
    return reconstruct_with(ready.model, recording, renderer=ready.renderer)


@pytest.fixture(scope="session")
def run_folder(ready, tmp_path_factory) -> Path:
    """A training run's folder, its head known by a mark in one weight."""
    return write_run(tmp_path_factory.mktemp("outputs") / "quickstart", ready.model, mark=0.25)


def run(*arguments: str | Path) -> None:
    """``vg2gt reconstruct`` with a stand-in of a backbone; refines only if asked to."""
    plain = [*STAND_IN, "--device", "cpu", "--quiet"]
    reconstruct_command.main(["--refine", "0", *map(str, arguments), *plain])
