"""``backend.compile=true`` as in a run, with the compiler torch uses by default."""

import shutil

import pytest
import torch


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler on a CPU")
@pytest.mark.parametrize("name", ["vggt_tiny", "da3_tiny"])
def test_compiled_backend_equals_the_eager_one(make_backend, name: str) -> None:
    eager, compiled = make_backend(name), make_backend(name, "compile=true")
    for views in (2, 5):
        images = torch.rand((1, views, 3, 56, 84), generator=torch.Generator().manual_seed(0))
        expected_tokens, tokens = eager.encode(images), compiled.encode(images)
        expected, geometry = eager.decode(expected_tokens), compiled.decode(tokens)
        pairs = [*zip(tokens.patch, expected_tokens.patch, strict=True), (tokens.camera, expected_tokens.camera)]
        pairs += [(geometry.depth, expected.depth), (geometry.depth_conf, expected.depth_conf)]
        pairs += [(geometry.cameras.world_to_camera, expected.cameras.world_to_camera)]
        for value, reference in pairs:
            assert float((value - reference).abs().max() / reference.abs().max()) < 5e-6
