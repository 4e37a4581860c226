"""The backbones are graphs: they compile, export with free sizes, and bear half precision."""

import shutil

import pytest
import torch
from torch import Tensor, nn

from backends.da3 import DA3Backend
from backends.normalization import normalize_images
from backends.vggt import VGGTBackend

SHAPES = [(2, 3, 3, 56, 84), (1, 1, 3, 70, 70), (1, 2, 3, 84, 56), (2, 5, 3, 42, 112)]


class Encoder(nn.Module):
    """The backbone alone, images ``[B, V, 3, H, W]`` to the tapped patch tokens and the camera token."""

    def __init__(self, backend: VGGTBackend | DA3Backend) -> None:
        super().__init__()
        self.backend = backend

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        backend = self.backend
        if isinstance(backend, DA3Backend):
            patch, camera = backend.network.backbone.pretrained(
                normalize_images(images), backend.taps, backend.reference_view
            )
        else:
            patch, camera = backend.network.aggregator(images, backend.taps)
        return (*patch, camera)


@pytest.fixture(params=["vggt_tiny", "da3_tiny"])
def encoder(request: pytest.FixtureRequest, make_backend) -> Encoder:
    return Encoder(make_backend(request.param))


def random_images(shape: tuple[int, ...]) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler on a CPU")
@pytest.mark.parametrize("name", ["vggt_tiny", "da3_tiny"])
def test_compiled_backend_equals_the_eager_one(make_backend, name: str) -> None:
    """``backend.compile=true`` as in a run, with the compiler torch uses by default."""
    eager, compiled = make_backend(name), make_backend(name, "compile=true")
    for views in (2, 5):
        images = random_images((1, views, 3, 56, 84))
        expected_tokens, tokens = eager.encode(images), compiled.encode(images)
        expected, geometry = eager.decode(expected_tokens), compiled.decode(tokens)
        pairs = [*zip(tokens.patch, expected_tokens.patch, strict=True), (tokens.camera, expected_tokens.camera)]
        pairs += [(geometry.depth, expected.depth), (geometry.depth_conf, expected.depth_conf)]
        pairs += [(geometry.cameras.world_to_camera, expected.cameras.world_to_camera)]
        for value, reference in pairs:
            assert float((value - reference).abs().max() / reference.abs().max()) < 5e-6
