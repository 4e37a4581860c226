"""A room as an RGB-D recording and as photographs of several sizes, and its reconstruction."""

from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image

from vg2gt.data import SyntheticScenes
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.scene import Scene
from vg2gt.runs.load import LoadedModel, compose_part, load_model

SIZE = (84, 112)
ORACLE = "oracle,depth_noise=0"


@pytest.fixture(scope="session")
def frames():
    source = SyntheticScenes(1, num_frames=4, size=SIZE)
    return source.load(source.scenes[0], range(4))


@pytest.fixture(scope="session")
def recording(frames, tmp_path_factory) -> Path:
    """``images/ depth/ poses.txt K.txt``."""
    folder = tmp_path_factory.mktemp("recordings") / "room"
    for sub in ("images", "depth"):
        (folder / sub).mkdir(parents=True)
    for i in range(4):
        pixels = (frames.images[i].permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"{i + 8:03d}.png")
        millimetres = (frames.depth[i].numpy() * 1000 + 0.5).astype(np.uint16)
        Image.fromarray(millimetres).save(folder / "depth" / f"{i + 8:03d}.png")
    poses = np.linalg.inv(frames.world_to_camera.double().numpy())
    np.savetxt(folder / "poses.txt", poses.reshape(-1, 16))
    np.savetxt(folder / "K.txt", frames.intrinsics[0].numpy())
    return folder


@pytest.fixture(scope="session")
def photos(frames, tmp_path_factory) -> Path:
    """The same pictures: whole, larger as JPEG, lying on its side as its EXIF data say, cut to a portrait."""
    folder = tmp_path_factory.mktemp("holiday") / "photos"
    folder.mkdir()
    pictures = [Image.fromarray((f.permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)) for f in frames.images]
    pictures[0].save(folder / "IMG_8.png")
    pictures[1].resize((448, 336)).save(folder / "IMG_9.jpg", quality=95)
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned clockwise
    pictures[2].rotate(90, expand=True).save(folder / "IMG_10.jpg", quality=95, exif=exif)
    pictures[3].crop((28, 0, 84, 84)).save(folder / "IMG_11.png")
    return folder


@pytest.fixture(scope="session")
def ready() -> LoadedModel:
    return load_model(backend=ORACLE, device="cpu")


@pytest.fixture(scope="session")
def scene(ready, recording) -> Scene:
    return reconstruct_with(ready.model, recording, renderer=ready.renderer)


@pytest.fixture(scope="session")
def run_folder(ready, tmp_path_factory) -> Path:
    """A training run's folder, its head known by a mark in one weight."""
    folder = tmp_path_factory.mktemp("outputs") / "quickstart"
    (folder / "checkpoints").mkdir(parents=True)
    parts = {"backend": "oracle", "model": "tiny", "renderer": "solid"}
    OmegaConf.save(
        OmegaConf.create({key: compose_part(key, name) for key, name in parts.items()}), folder / "config.yaml"
    )
    state = {f"model.{key}": value for key, value in ready.model.state_dict().items() if not key.startswith("backend.")}
    state["model.gaussians.out.bias"] = state["model.gaussians.out.bias"] + 0.25
    checkpoint = {"state_dict": state, "backend": dict(ready.model.backend.identity()), "global_step": 7}
    torch.save(checkpoint, folder / "checkpoints" / "step-7.ckpt")
    return folder
