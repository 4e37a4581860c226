"""A small room, its feed-forward scene from noisy depth and cameras, and what its views show."""

from dataclasses import dataclass

import pytest
import torch

from vg2gt.data.synthetic import SyntheticScenes
from vg2gt.refinement import Observations, Refined, RefineOptions, refine
from vg2gt.rendering import Renderer
from vg2gt.runs.load import load_model
from vg2gt.types import Cameras, Gaussians, Hints

SIZE = (56, 84)
VIEWS = 6


@dataclass(frozen=True)
class Start:
    """What a refinement begins with."""

    gaussians: Gaussians
    cameras: Cameras
    seen: Observations
    renderer: Renderer


@pytest.fixture(scope="session")
def start() -> Start:
    source = SyntheticScenes(1, num_frames=VIEWS, size=SIZE)
    frames = source.load(source.scenes[0], range(VIEWS))
    cameras = Cameras(frames.world_to_camera[None], frames.intrinsics[None], SIZE)
    hints = Hints(frames.depth[None], cameras, ("room",), torch.arange(VIEWS)[None])
    loaded = load_model(None, "oracle", ["backend.depth_noise=0.02"], device="cpu")
    with torch.no_grad():
        prediction = loaded.model(frames.images[None], hints)
    geometry = prediction.geometry
    seen = Observations(frames.images, geometry.depth[0], geometry.depth_conf[0])
    return Start(prediction.gaussians, geometry.cameras, seen, loaded.renderer)


def run(start: Start, options: RefineOptions, **changes) -> Refined:
    return refine(start.gaussians, start.cameras, start.seen, start.renderer, options, **changes)
