"""Compiled transformer blocks of the backbone."""

from functools import partial
from pathlib import Path

import pytest
import torch
from torch._dynamo.testing import CompileCounterWithBackend

from tests.training_helpers import NARROW
from vg2gt.types import Tokens

SIZES = ((2, (28, 56)), (3, (28, 56)), (4, (42, 28)), (5, (56, 42)))  # views and images


def encode(backend, make_scene) -> list[Tokens]:
    return [backend.encode(*make_scene(1, views, size)) for views, size in SIZES]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("da3_tiny", "aot_eager"),
        pytest.param("vggt_tiny", "aot_eager", marks=pytest.mark.slow),
        pytest.param("da3_tiny", "inductor", marks=pytest.mark.slow),
        pytest.param("vggt_tiny", "inductor", marks=pytest.mark.slow),
    ],
)
def test_compiled_blocks_equal_the_plain_ones_at_all_sizes(name, kind, make_backend, make_scene, monkeypatch) -> None:
    torch._dynamo.reset()
    graphs = CompileCounterWithBackend(kind)
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=graphs))
    plain, compiled = make_backend(name), make_backend(name)
    compiled.compile_blocks()
    for found, expected in zip(encode(compiled, make_scene), encode(plain, make_scene), strict=True):
        for one, other in zip((*found.patch, found.camera), (*expected.patch, expected.camera), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    blocks = sum(type(module).__name__ == "ViTBlock" for module in compiled.network.modules())
    assert 0 < graphs.frame_count < blocks, "blocks do not share their code, or sizes are compiled in"
    assert list(compiled.state_dict()) == list(plain.state_dict())
    assert compiled.identity() == plain.identity()


def test_a_backbone_without_transformer_blocks_is_refused(make_backend) -> None:
    with pytest.raises(ValueError, match=r"compile_blocks=true: backend oracle.*vggt_1b or da3"):
        make_backend("oracle").compile_blocks()


def test_a_training_compiles_the_blocks_when_asked(benchmark_script, tmp_path: Path, monkeypatch) -> None:
    torch._dynamo.reset()
    graphs = CompileCounterWithBackend("eager")
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=graphs))
    options = ("experiment=paper", "data=synthetic", "backend=da3_tiny", "backend.pretrained=false", *NARROW)
    losses = []
    for asked in ("false", "true"):
        overrides = (*options, f"training.compile_blocks={asked}")
        run, batch = benchmark_script("common").prepare(2, (28, 56), overrides, torch.device("cpu"), tmp_path / asked)
        losses.append(benchmark_script("common").whole_step(run)(batch.context))
        assert bool(graphs.frame_count) == (asked == "true")
    torch.testing.assert_close(*losses)
