"""Caps drop the lowest of each scene and say so; full memory is one error that names sizes and options."""

import logging
from pathlib import Path

import pytest
import torch

from vg2gt.memory import TRAINING, OutOfMemory, dropped_by, memory_advice, note_sizes
from vg2gt.method import GaussianHead
from vg2gt.studies.study import compose_run
from vg2gt.training.loop import train
from vg2gt.types import Voxels

SMALL = [
    *("data.image_size=[28,28]", "data.num_frames=6", "data.train_scenes=1", "data.eval_scenes=1"),
    *("data.max_images=3", "data.min_views=2", "data.max_views=2", "data.eval_context=2", "data.eval_target=1"),
    "trainer.enable_progress_bar=false",
]


def some_voxels(counts: tuple[int, ...] = (40, 60), seed: int = 0) -> Voxels:
    generator = torch.Generator().manual_seed(seed)
    batch = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    total = len(batch)
    grid = torch.stack((torch.arange(total), torch.zeros(total), torch.zeros(total)), -1).long()
    features, colors = torch.randn(total, 8, generator=generator), torch.rand(total, 3, generator=generator)
    confidence = torch.rand(total, generator=generator) + 0.1
    return Voxels(
        features, colors, grid, batch, confidence, torch.ones(total), grid + 0.5, torch.full((len(counts),), 0.1)
    )


def head(max_gaussians: int | None = None) -> GaussianHead:
    torch.manual_seed(0)
    made = GaussianHead(8, splits=2, max_gaussians=max_gaussians)
    torch.nn.init.normal_(made.out.weight)
    return made


def test_the_least_opaque_gaussians_of_each_scene_go(caplog: pytest.LogCaptureFixture) -> None:
    voxels = some_voxels()
    whole = head()(voxels)
    capped = head(70)
    with caplog.at_level(logging.WARNING):
        kept = capped(voxels)
    assert torch.bincount(kept.batch).tolist() == [70, 70]
    for scene, count in ((0, 80), (1, 120)):
        before, after = whole.scene(scene), kept.scene(scene)
        assert torch.equal(after.opacities.sort().values, before.opacities.sort().values[count - 70 :])
        rows = (before.opacities >= after.opacities.min()).nonzero()[:, 0]
        assert torch.equal(after.means, before.means[rows])  # in their order
    assert "model.gaussians.max_gaussians=70 per scene: dropped the 60 least opaque of 200 Gaussians" in caplog.text
    assert dropped_by(capped) == {"gaussians": 60}
    assert torch.equal(capped(voxels).means, kept.means)


def test_below_the_limit_nothing_changes(caplog: pytest.LogCaptureFixture) -> None:
    voxels = some_voxels()
    for limit in (120, 10**6):
        made, expected = head(limit)(voxels), head()(voxels)
        for name in ("means", "quats", "scales", "opacities", "sh", "batch"):
            assert torch.equal(getattr(made, name), getattr(expected, name))
    assert not caplog.records
    assert dropped_by(head()) == {}


def test_training_logs_what_was_dropped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    overrides = ["model.fine.max_voxels=200", "model.gaussians.max_gaussians=300", "trainer.max_steps=1"]
    config = compose_run([*SMALL, *overrides, "++trainer.log_every_n_steps=1", f"name={tmp_path.name}"], tmp_path)
    with caplog.at_level(logging.WARNING):
        train(config)
    (metrics,) = tmp_path.rglob("metrics.csv")
    header = metrics.read_text().splitlines()[0].split(",")
    assert {"train/voxels_dropped", "train/gaussians_dropped"} <= set(header)
    assert "model.fine.max_voxels=200 per scene: dropped" in caplog.text
    assert "model.gaussians.max_gaussians=300 per scene: dropped" in caplog.text


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB"),
        MemoryError(),
        RuntimeError("[enforce fail at alloc_cpu.cpp:114] err == 0. DefaultCPUAllocator: can't allocate memory: 12"),
        RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 1024 bytes."),
        RuntimeError("std::bad_alloc"),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
    ],
)
def test_full_memory_is_one_error(error):
    @memory_advice(TRAINING)
    def fail() -> None:
        note_sizes({"images of 1x1": 1, "Gaussians": 5}, first=True)
        note_sizes({"images of 28x28": 4}, first=True)
        note_sizes({"voxels": 7})
        raise error

    said = r"out of memory with 4 images of 28x28, 7 voxels \(.+\)\. To reduce memory, use fewer"
    with pytest.raises(OutOfMemory, match=said) as caught:
        fail()
    assert caught.value.__cause__ is error
    note_sizes({"voxels": 1})  # outside: no listener


@pytest.mark.parametrize("stage", ["model.fine.point_mlp", "renderer"])
def test_training_names_sizes_and_options(stage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")

    place = "vg2gt.rendering.renderer.Renderer.__call__" if stage == "renderer" else "vg2gt.method.PointMLP.forward"
    monkeypatch.setattr(place, fail)
    config = compose_run([*SMALL, "trainer.max_steps=1", f"name={tmp_path.name}"], tmp_path)
    sizes = r"out of memory with 2 images of 28x28 in 1 scene, \d+ voxels"
    sizes += r", \d+ Gaussians" if stage == "renderer" else r" \("
    with pytest.raises(OutOfMemory, match=rf"{sizes}.*data\.max_images.*data\.image_size.*model\.fine\.max_voxels"):
        train(config)
