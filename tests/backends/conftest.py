"""Scenes and the choice of backends for the contract test."""

import importlib

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from backends.base import Backend
from vg2gt.config import compose
from vg2gt.geometry.cameras import invert_rigid, ray_directions
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.types import Cameras, Hints

BUILT_IN = ("oracle", "sweep", "vggt_tiny", "da3_tiny", "onnx")
EXAMPLE = "examples.backend.LocalDepthBackend"
ITERMVS = "examples.backends.itermvs.IterMVSBackend"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--backend", default=None, help="dotted path of one backend for the contract test")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "backend" in metafunc.fixturenames:
        chosen = metafunc.config.getoption("--backend", default=None)
        names = [chosen] if chosen else [*BUILT_IN, EXAMPLE, ITERMVS]
        metafunc.parametrize("backend", names, indirect=True, scope="session")


@pytest.fixture(scope="session")
def backend(request: pytest.FixtureRequest):
    if request.param == "onnx":
        return make_backend("onnx", f"path={request.getfixturevalue('onnx_bundle')}")
    if request.param in BUILT_IN:
        return make_backend(request.param)
    module, _, name = request.param.rpartition(".")
    options = {"pretrained": False} if request.param == ITERMVS else {}
    return getattr(importlib.import_module(module), name)(**options)


def load_config(name: str, *overrides: str) -> DictConfig:
    """One option of the group backend with overrides such as ``pretrained=false``."""
    return compose(None, f"+backend={name}", *(f"++backend.{override}" for override in overrides)).backend


def make_backend(name: str, *overrides: str) -> Backend:
    return instantiate(load_config(name, *overrides))


def plane_scene(batch: int, views: int, size: tuple[int, int], seed: int = 0) -> tuple[Tensor, Hints]:
    """Random images of a slanted plane, about 2 units away, with exact depth, cameras and names."""
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    images = torch.rand(batch, views, 3, height, width, generator=generator)
    motion = 0.1 * torch.randn(batch, views, 6, generator=generator)
    poses = torch.eye(4).repeat(batch, views, 1, 1)
    poses[..., :3, :3] = quat_to_matrix(torch.cat((torch.ones(batch, views, 1), motion[..., :3] / 2), -1))
    poses[..., :3, 3] = motion[..., 3:]
    intrinsics = torch.tensor([[width, 0, width / 2 - 0.5], [0, width, height / 2 - 0.5], [0, 0, 1.0]])
    cameras = Cameras(poses, intrinsics.repeat(batch, views, 1, 1), size)
    normal = torch.nn.functional.normalize(torch.tensor([0.2, 0.1, 1.0]), dim=0)
    inverse = invert_rigid(poses)
    rays = ray_directions(cameras.intrinsics, size) @ inverse[..., None, :3, :3].transpose(-1, -2)
    depth = (2 - inverse[..., :3, 3] @ normal)[..., None, None] / (rays @ normal)
    frames = torch.arange(views).expand(batch, views)
    return images, Hints(depth, cameras, tuple(f"scene{seed}-{index}" for index in range(batch)), frames)


def given(value: object, name: str) -> object:
    """A fixture that is a function of this file."""
    return pytest.fixture(lambda: value, scope="session", name=name)


scenes = given(plane_scene, "make_scene")
configs = given(load_config, "load_config")
backends = given(make_backend, "make_backend")
