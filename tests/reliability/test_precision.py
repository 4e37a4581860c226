"""Precision: bfloat16 networks agree with float32 ones, and geometry is never below float32."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

import vg2gt.baselines.pixel_aligned
import vg2gt.baselines.pixels
import vg2gt.losses.objective
import vg2gt.method.additions.surface_evidence
import vg2gt.method.coarse
import vg2gt.method.fine
import vg2gt.rendering.renderer
import vg2gt.rendering.scenes
import vg2gt.training.module
from tests.reliability.steps import first_batches, fit, tiny_run
from tests.training_helpers import NARROW, full_model
from vg2gt.evaluation.in_training import evaluate_scene
from vg2gt.losses.gaussian import GaussianLoss
from vg2gt.losses.geometry import GeometryLoss
from vg2gt.model import SceneScale
from vg2gt.rendering import Renderer
from vg2gt.training.loop import evaluate
from vg2gt.types import Voxels

STEPS = 6
LOSS_TOLERANCE = 5e-3  # of the largest loss, in every step
COSINE = 0.998  # of every step's gradient before clipping
# Surfels are a twentieth of a voxel thick: what rounding moves by as much shows in depth, normals and colour, and what
# it moves over a silhouette shows in one step's whole gradient (0.976 to 0.997 for the same step of equal trainings).
SURFEL_LOSS_TOLERANCE, SURFEL_COSINE, SURFEL_MEAN = 2e-2, 0.99, 0.995
PLAIN = ("model.gaussians.start=plain", "model.fine.moments=false", "model.fine.drop_fringes=false")
METRIC_TOLERANCE = {"psnr": 0.1, "ssim": 0.01, "abs_rel": 0.005, "decoded_abs_rel": 0.001, "coverage": 0.01}


def autocast(enabled: bool) -> torch.autocast:
    return torch.autocast("cpu", torch.bfloat16, enabled=enabled)


class BothPrecisions(lightning.Callback):
    """Notes loss and gradient of every step in float32 and, at the same weights, in bfloat16."""

    def __init__(self) -> None:
        self.losses: list[tuple[float, float]] = []
        self.cosines: list[float] = []
        self._step: tuple[Any, ...] = ()

    def on_train_batch_start(self, trainer: Any, pl_module: Any, *step: Any) -> None:
        self._step = step

    def on_before_optimizer_step(self, trainer: Any, pl_module: Any, optimizer: Any) -> None:
        parameters = [parameter for parameter in pl_module.parameters() if parameter.requires_grad]
        kept = [parameter.grad for parameter in parameters]
        exact, mixed = (self._again(pl_module, parameters, enabled) for enabled in (False, True))
        for parameter, gradient in zip(parameters, kept, strict=True):
            parameter.grad = gradient
        self.losses.append((exact[0], mixed[0]))
        self.cosines.append(float(F.cosine_similarity(exact[1], mixed[1], dim=0)))

    def _again(self, module: Any, parameters: list[nn.Parameter], enabled: bool) -> tuple[float, Tensor]:
        for parameter in parameters:
            parameter.grad = None
        module.on_train_batch_start(*self._step)  # the step's own random draws
        with autocast(enabled):
            loss = module.training_step(*self._step)
        loss.backward()
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        assert {gradient.dtype for gradient in gradients} == {torch.float32}
        return float(loss.detach()), torch.cat([gradient.flatten().double() for gradient in gradients])


def check_agreement(overrides: tuple[str, ...], steps: int, folder: Path, cache: Path) -> None:
    """Every step agrees at equal weights, and training in bfloat16 arrives where training in float32 does."""
    exact, mixed = (tiny_run(folder, cache, f"trainer.precision={p}", *overrides) for p in ("32-true", "bf16-mixed"))
    noted = BothPrecisions()
    exact.trainer.callbacks.append(noted)  # pyright: ignore[reportAttributeAccessIssue]
    for run in (exact, mixed):
        fit(run, first_batches(run, steps)).assert_sound()
    # Terms of both signs: a loss may be next to nothing, its rounding is not.
    size = max(abs(one) for one, _ in noted.losses)
    surfels = getattr(getattr(exact.module.model, "gaussians", None), "start", "plain") == "surfel"
    for one, other in noted.losses:
        assert other == pytest.approx(one, abs=size * (SURFEL_LOSS_TOLERANCE if surfels else LOSS_TOLERANCE))
        assert other != one  # autocast was on
    assert len(noted.cosines) == steps
    worst, second = sorted(noted.cosines)[:2]
    if surfels:
        assert second > SURFEL_COSINE
        assert sum(noted.cosines) / steps > SURFEL_MEAN
    else:
        assert worst > COSINE
    exact.datamodule.setup("validate")
    batch = next(iter(exact.datamodule.val_dataloader()))
    scores = []
    for run in (exact, mixed):
        with run.trainer.precision_plugin.forward_context():
            scores.append(evaluate_scene(run.module.model.eval(), run.module.renderer, batch))
    for name, tolerance in METRIC_TOLERANCE.items():
        assert scores[1][name] == pytest.approx(scores[0][name], abs=tolerance), name


@pytest.mark.parametrize("overrides", [pytest.param(PLAIN, marks=pytest.mark.slow), ()], ids=["plain", "surfels"])
def test_bfloat16_networks_agree_with_float32(overrides: tuple[str, ...], tmp_path: Path, cache: Path) -> None:
    check_agreement(overrides, STEPS, tmp_path, cache)


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        ("data.image_size=[112,224]", "data.max_views=4", "data.min_views=4", "data.max_images=4"),
        ("backend=da3_tiny",),
        ("backend=vggt_tiny",),
        ("ablation=wo_coarse",),
        ("model=pixel_aligned",),
        ("model=voxel_merged",),
        ("model.gaussians.sh_degree=2",),
    ],
    ids=" ".join,
)
def test_bfloat16_networks_agree_for_longer_and_in_every_model(overrides, tmp_path, cache):
    check_agreement(overrides, 40, tmp_path, cache)


SCORES = ("psnr", "ssim", "abs_rel", "decoded_abs_rel", "normal_mean")
SEEDS = 3


@pytest.mark.slow
def test_two_hundred_steps_of_the_papers_model_end_as_other_seeds_do(tmp_path: Path, cache: Path) -> None:
    """bfloat16 changes the final metrics by less than the seed of a training in float32 does."""
    fixed = ["model=vg2gt", *NARROW, "loss=paper", "optimizer=adamw", "trainer.max_steps=200", "data.eval_scenes=4"]

    def trained(seed: int, precision: str) -> dict[str, float]:
        run = tiny_run(tmp_path, cache, *fixed, f"seed={seed}", f"trainer.precision={precision}")
        run.trainer.fit(run.module, datamodule=run.datamodule)
        return evaluate(run)

    exact, mixed = ([trained(seed, name) for seed in range(SEEDS)] for name in ("32-true", "bf16-mixed"))
    for name in SCORES:
        ours, theirs = ([metrics[name] for metrics in runs] for runs in (mixed, exact))
        spread = max(theirs) - min(theirs)
        print(name, "bfloat16", ours, "float32", theirs)
        assert ours != theirs
        assert abs(sum(ours) - sum(theirs)) / SEEDS < spread, name


def dtypes(value: Any, skip: tuple[str, ...] = ()) -> Iterator[tuple[str, torch.dtype]]:
    """Names and dtypes of all floating-point tensors in records, tuples and mappings."""
    if isinstance(value, Tensor):
        if value.is_floating_point():
            yield "", value.dtype
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            if field.name not in skip:
                yield from ((f".{field.name}{n}", d) for n, d in dtypes(getattr(value, field.name), skip))
    elif isinstance(value, (tuple, list, dict)):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from ((f"[{key}]{n}", d) for n, d in dtypes(item, skip))


# what networks may say in bfloat16: it becomes geometry in float32
NETWORKS = ("patch", "camera", "features")


def places(owner: Any, names: str) -> list[tuple[Any, str]]:
    return [(owner, name) for name in names.split()]


VOXELS = "unproject scene_voxel_size point_cells pool_mean pool_min"
PLACES = [
    *places(vg2gt.method.coarse, f"{VOXELS} interpolation_weights"),
    (vg2gt.method.additions.surface_evidence, "normals_from_depth"),
    *places(vg2gt.method.fine, VOXELS),
    (vg2gt.training.module, "training_cameras"),
    (vg2gt.rendering.scenes, "_scene_views"),
    *((called, "__call__") for called in (Renderer, SceneScale, GeometryLoss, GaussianLoss)),
    (vg2gt.losses.objective.VG2GTLoss, "forward"),
    *places(vg2gt.losses.objective, "normalize_truth"),
]
BASELINE_PLACES = [
    (vg2gt.baselines.pixels, "ray_directions"),
    *places(vg2gt.baselines.pixel_aligned, "point_cells pool_mean"),
    (Renderer, "__call__"),
]


class Probe:
    """Notes the dtypes that go into functions and come out of them."""

    def __init__(self) -> None:
        self.seen: set[str] = set()
        self.low: set[str] = set()

    def watch(self, owner: Any, name: str, patch: pytest.MonkeyPatch) -> None:
        label, original = f"{getattr(owner, '__name__', owner)}.{name}", getattr(owner, name)

        def probed(*args: Any, **kwargs: Any) -> Any:
            result = original(*args, **kwargs)
            self.note(label, {"in": args, "in_named": kwargs, "out": result})
            return result

        patch.setattr(owner, name, probed)

    def note(self, label: str, values: Any) -> None:
        self.seen.add(label)
        for name, dtype in dtypes(values, NETWORKS):
            if torch.finfo(dtype).bits < 32:
                self.low.add(f"{label}{name} is {dtype}")


@pytest.mark.parametrize(
    ("overrides", "watched"),
    [((), PLACES), (("backend=da3_tiny",), PLACES), (("model=voxel_merged",), BASELINE_PLACES)],
    ids=["full", "da3_tiny", "voxel_merged"],
)
def test_geometry_is_never_below_float32(overrides, watched, tmp_path, cache, monkeypatch):
    run = tiny_run(tmp_path, cache, "trainer.precision=bf16-mixed", *overrides)
    probe = Probe()
    for owner, name in (*watched, *places(run.module.model.backend, "decode encode")):
        probe.watch(owner, name, monkeypatch)
    networks: set[torch.dtype] = set()
    for name, module in run.module.model.named_modules():
        if name in ("", "fine", "gaussians", "coarse"):
            module.register_forward_hook(lambda module, args, out, name=name: probe.note(f"model.{name}", (args, out)))
        if name.endswith("dense_head"):
            module.register_forward_hook(lambda module, args, out: networks.add(out.dtype))
    (batch,) = first_batches(run, 1)
    fit(run, [batch, batch]).assert_sound()
    expected = {f"{getattr(owner, '__name__', owner)}.{name}" for owner, name in watched}
    assert expected <= probe.seen
    assert not probe.low
    assert networks == {torch.bfloat16}  # autocast was on, where it may be
    assert {parameter.dtype for parameter in run.module.parameters()} == {torch.float32}


def test_voxel_grids_do_not_depend_on_the_precision(tmp_path: Path, cache: Path) -> None:
    """From equal tokens: the same cells, counts, colours and centroids to the bit."""
    run = tiny_run(tmp_path, cache)
    model = full_model(run).eval()
    (batch,) = first_batches(run, 1)
    context = batch.context
    found: list[Voxels] = []
    with torch.no_grad():
        tokens, geometry, _ = model.read_views(context.images, context.hints)
        for enabled in (False, True):
            with autocast(enabled):
                size = model.fine.voxel_edges(geometry)
                found.append(model.fine.refine(model.fine.pool(tokens, geometry, context.images, size), size))
    exact, mixed = found
    for name in ("grid", "batch", "count", "colors", "confidence", "centroid", "voxel_size"):
        assert torch.equal(getattr(exact, name), getattr(mixed, name)), name
    assert not torch.equal(exact.features.float(), mixed.features.float())


def test_other_precisions_are_refused(tmp_path: Path, cache: Path) -> None:
    for precision in ("16-mixed", "bf16-true", "64-true", "16"):
        with pytest.raises(ValueError, match=rf"trainer\.precision={precision} .* use bf16-mixed .*, 32-true, or auto"):
            tiny_run(tmp_path, cache, f"trainer.precision={precision}")
