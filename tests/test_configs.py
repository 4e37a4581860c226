"""Every configuration file composes, instantiates, and names only arguments its constructor has."""

import importlib.util
import inspect
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

import lightning
import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import get_class, instantiate
from lightning.pytorch.strategies import DDPStrategy, SingleDeviceStrategy
from omegaconf import DictConfig, OmegaConf
from typing_extensions import get_type_hints

from tests.training_helpers import full_model, group_options
from vg2gt.config import compose, config_dir, variants
from vg2gt.geometry.precision import trainer_precision
from vg2gt.losses import VG2GTLoss
from vg2gt.refinement import RefineOptions
from vg2gt.training.loop import ALLOCATOR, build

OPTIONAL_PACKAGES = {"wandb": "wandb", "tensorboard": "tensorboard"}


def composed(tmp_path: Path, *overrides: str) -> DictConfig:
    return compose("train", f"output_dir={tmp_path}", *overrides)


def targets(node: Any, where: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    if isinstance(node, dict):
        if "_target_" in node:
            yield where, node
        for key, value in node.items():
            yield from targets(value, f"{where}.{key}")
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from targets(value, f"{where}[{index}]")


def assert_signatures_fit(node: Any) -> int:
    count = 0
    for where, target in targets(node):
        given = [key for key in target if not (key.startswith("_") and key.endswith("_"))]
        unknown = [key for key in given if not accepts(target, key)]
        assert not unknown, f"{where}: {target['_target_']} has no argument {unknown}"
        count += 1
    return count


def accepts(target: dict[str, Any], key: str) -> bool:
    """Whether a constructor has an argument, or hands it on to parts of its own that all have it."""
    made = get_class(target["_target_"])
    parameters = inspect.signature(made).parameters
    if key in parameters:
        return True
    if shared := get_type_hints(made.__init__, include_extras=True).get("shared"):  # **shared: Unpack[FileOptions]
        return key in get_type_hints(get_args(shared)[0])
    if not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
        return False
    if target["_target_"] == "vg2gt.data.SceneDataModule":
        return accepts(target["train"], key) and accepts(target["val"], key)
    if target["_target_"] == "vg2gt.data.Mixture":
        owners = [name for name in target["parts"] if key.startswith(f"{name}_")] or list(target["parts"])
        return all(accepts(target["parts"][name], key.removeprefix(f"{name}_")) for name in owners)
    return True


GROUPS = ["backend", "model", "data", "loss", "renderer", "optimizer", "trainer", "callbacks", "logger"]


@pytest.mark.parametrize(("group", "name"), [(group, name) for group in GROUPS for name in group_options(group)])
def test_every_option_composes_and_fits_its_constructor(tmp_path: Path, group: str, name: str) -> None:
    if name in OPTIONAL_PACKAGES and importlib.util.find_spec(OPTIONAL_PACKAGES[name]) is None:
        pytest.skip(f"{name} is not installed (extra: log)")
    config = composed(tmp_path, f"{group}={name}", *(["data.root=somewhere"] if name == "rgbd" else []))
    if group in ("loss", "renderer", "optimizer"):
        assert callable(instantiate(config[group]))
    assert assert_signatures_fit(OmegaConf.to_container(config[group], resolve=True)) >= 1
    if group == "data" and name not in ("synthetic", "paper_mix", "stream"):  # scenes in files
        assert {"every", "index_cache", "max_views"} <= set(config.data)


def test_devices_and_several_loggers(tmp_path: Path) -> None:
    """Item 32 of issue 47."""
    trainer = build(composed(tmp_path, "logger=[csv,tensorboard]", "trainer=cpu")).trainer
    assert trainer.accelerator.__class__.__name__ == "CPUAccelerator"
    assert [type(logger).__name__ for logger in trainer.loggers] == ["CSVLogger", "TensorBoardLogger"]
    with pytest.raises(ValueError, match=r"MPS has no float64.*trainer=cpu"):
        build(composed(tmp_path, "trainer.accelerator=mps"))


@pytest.mark.parametrize("own", [None, "max_split_size_mb:128"])
def test_a_gpus_allocator_grows_its_segments(tmp_path: Path, own: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless the environment says otherwise, and whether or not there is a GPU."""
    name, value = ALLOCATOR
    monkeypatch.delenv(name, raising=False)
    if own:
        monkeypatch.setenv(name, own)
    with suppress(InstantiationException):  # without a GPU, Lightning refuses
        build(composed(tmp_path, "trainer.accelerator=gpu"))
    assert os.environ[name] == (own or value)


@pytest.mark.parametrize("name", group_options("refine"))
def test_refinements_instantiate_and_the_default_is_the_codes(name: str) -> None:
    config = compose(None, f"+refine={name}").refine
    assert assert_signatures_fit(OmegaConf.to_container(config)) == 3 + (config.full is not None)
    assert (instantiate(config) == RefineOptions()) == (name == "default")


@pytest.mark.parametrize("group", ["experiment", "ablation"])
def test_every_preset_composes(tmp_path: Path, group: str) -> None:
    assert group_options(group)
    for name in group_options(group):
        config = composed(tmp_path, f"{group}={name}")
        assert assert_signatures_fit(OmegaConf.to_container(config, resolve=True)) >= 8


def test_the_coarse_module_may_learn_at_a_rate_of_its_own(tmp_path: Path) -> None:
    class Planned:
        estimated_stepping_batches = 10

    rates = []
    for factor in (1.0, 3.0):
        module = build(composed(tmp_path, f"training.coarse_lr_factor={factor}", "training.warmup_steps=0")).module
        trainer = Planned()
        module.trainer = trainer  # pyright: ignore[reportAttributeAccessIssue]
        made = module.configure_optimizers()
        by_parameter = {id(p): group["lr"] for group in made["optimizer"].param_groups for p in group["params"]}
        named = [(n, p) for n, p in module.model.named_parameters() if p.requires_grad]
        rates.append({name: by_parameter[id(parameter)] for name, parameter in named})
        assert len(by_parameter) == len(named)
    for name, rate in rates[0].items():
        assert rates[1][name] == pytest.approx(rate * (3 if name.startswith("coarse.") else 1)), name
    assert len(set(rates[1].values())) == 2


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("training.coarse_lr_factor=-1.0", r"training\.coarse_lr_factor=.* must be a positive number"),
        ("training.pose_noise=0.5", r"training\.pose_noise=0\.5 .*0 with part=all"),
        ("training.part=fine", r"training\.part=fine must be all or coarse"),
    ],
)
def test_senseless_options_of_the_training_are_refused(tmp_path: Path, override: str, said: str) -> None:
    with pytest.raises(Exception, match=said):
        build(composed(tmp_path, override))


@pytest.mark.parametrize("ablation", group_options("ablation"))
def test_every_ablation_builds_what_it_says(tmp_path: Path, ablation: str) -> None:
    run = build(
        composed(tmp_path, f"ablation={ablation}", "trainer.accelerator=cpu", "data.cache_dir=" + str(tmp_path))
    )
    full = {
        "rasterized": run.module.renderer.mode == "rasterized",
        "wo_coarse": full_model(run).coarse is None,
        "wo_split": full_model(run).gaussians.splits == 1,
    }
    loss = run.module.loss
    assert isinstance(loss, VG2GTLoss)
    full |= {
        "wo_depth": loss.gaussian.depth_gt == loss.gaussian.depth_consistency == 0,
        "wo_enhance": loss.enhance.weight == 0,
    }
    assert {name for name, changed in full.items() if changed} == {ablation}


# Constructor arguments that no configuration file sets: nobody should turn them, but results depend on their defaults.
DEFAULTS: dict[str, dict[str, Any]] = {
    "vg2gt.model.SceneScale": {"median_depth": 1.0},
    "vg2gt.visibility.ViewCheck": {
        "rounds": 2, "partners": 24, "fine_below": 1.4, "coarsest": 1.4, "moved_margin": 0.08,
    },
    "vg2gt.method.CoarseModule": {"neighbors": 16, "inject": "all", "upsample": 2},
    "vg2gt.method.PTv3": {"window": 64, "norm": "layer", "legacy": False},
    "vg2gt.method.FineModule": {"coarsest_drawn": 1.0},
    "vg2gt.method.DenseHead": {
        "features": 256, "out_channels": 128, "merge_channels": None, "finest": 4, "views_per_chunk": 8,
    },
    "vg2gt.method.PointMLP": {"stages": 2, "window": 32},
    "vg2gt.method.GaussianHead": {"max_offset": 1.0},
    "vg2gt.baselines.PixelHead": {"max_offset": 1.0, "max_depth_residual": 0.1},
    "vg2gt.baselines.PointCloud": {"spacing": "pixel", "width": 0.5, "opacity": 0.9},
    "vg2gt.baselines.VoxelMerged": {"voxel_size": 0.002, "min_footprint": 3.3},
    "vg2gt.rendering.Renderer": {
        "depth": "median", "lowpass": 0.3, "alpha_max": 0.99, "slope_floor": 30.0, "bisections": 12, "newton_steps": 2,
        "geometry": True, "footprints": False, "absgrad": False,
    },
    "vg2gt.losses.GeometryLoss": {"depth": 1.0, "point": 1.0, "gamma": 1.0, "alpha": 0.2, "quantile": 0.98},
    "vg2gt.losses.EnhancementLoss": {"margin": 0.0, "form": "improve", "on": "total"},
    "vg2gt.losses.GaussianLoss": {"confidence_weighted": True, "min_alpha": 0.5},
    "vg2gt.refinement.FullSizeOptions": {
        "renderings": 40.0, "coarse": 0.5, "rate": 0.5, "least": 0.3, "grow_every": 150, "grow_until": 0.4,
        "opened": 0.5, "geometry_every": 8,
    },
    "vg2gt.data.RGBDFolder": {"invalid": (0, 65535)},
    "vg2gt.data.sources.Infinigen": {"max_depth": 30.0, "cameras": (0,)},
    "vg2gt.data.views.drawn.ViewSelection": {"index": None, "targets": 4, "seed": 0},
    "vg2gt.evaluation.evaluator.EvaluationOptions": {"depth_range": (None, None), "neighbors": 8},
    "vg2gt.evaluation.evaluator.PointOptions": {"threshold": 0.05, "downsample": 0.02, "cap": None},
    "vg2gt.training.memory.ReturnFreeMemory": {"growth_mb": 600},
    "vg2gt.training.module.VG2GTModule": {"rasterized_depth": False, "max_skipped": 20},
    "vg2gt.training.checkpointing.BestCheckpoint": {"mode": "max"},
    "vg2gt.training.muon.MuonAdamW": {"momentum": 0.8, "adamw": ("coarse",)},
    "backends.oracle.OracleBackend": {
        "patch_size": 14, "dim": 64, "taps": 4, "pose_noise": None, "response": 0.02, "seed": 0,
    },
    "backends.sweep.SweepBackend": {"seed": 0},
    "backends.da3.DA3Backend": {"reference_view": "first", "revision": None, "seed": 0},
    "backends.da3.DA3MetricBackend": {"revision": None, "seed": 0},
    "backends.vggt.VGGTBackend": {"revision": None, "seed": 0},
    "backends.published.Network": {
        "licence": "unknown", "repo": None, "encoder_depth": 24, "ffn": "mlp", "multiview_from": None,
        "camera_depth": 4, "camera_heads": 16, "image_size": 518, "patch_size": 14, "prefix": "model.",
    },
}  # fmt: skip


@pytest.mark.parametrize("target", DEFAULTS)
def test_what_no_file_sets_keeps_its_default(target: str) -> None:
    parameters = inspect.signature(get_class(target)).parameters
    assert {name: parameters[name].default for name in DEFAULTS[target]} == DEFAULTS[target]


# What the paper does not have:
ADDITIONS = {"surface_evidence": True, "embedding_skip": True, "fuse_kernel": 3, "gate": True}
PAPER = {"surface_evidence": False, "embedding_skip": False, "fuse_kernel": 1, "gate": False}


@pytest.mark.parametrize(
    ("overrides", "coarse", "anchor"),
    [
        ([], ADDITIONS, "centroid"),
        (["model=vg2gt"], PAPER, "center"),
        (["model=vg2gt_plus"], ADDITIONS, "centroid"),
        (["experiment=paper"], PAPER, "center"),
        (["experiment=paper_counts"], PAPER, "center"),
        (["experiment=finetune"], ADDITIONS, "centroid"),
    ],
)
def test_the_papers_presets_have_none_of_our_additions(tmp_path, overrides, coarse, anchor):
    model = composed(tmp_path, *overrides).model
    assert {key: model.coarse[key] for key in coarse} == coarse
    assert model.gaussians.anchor == anchor


@pytest.mark.parametrize(
    ("machine", "steps", "rate"),
    [
        ("trainer=ddp", 420_000, 3e-6),  # the paper's two GPUs
        ("trainer=gpu", 840_000, 3e-6 * 0.5**0.5),
        ("trainer=gpu data.max_images=36", 420_000, 3e-6),
        ("trainer=ddp trainer.devices=8", 105_000, 6e-6),
        ("trainer=ddp trainer.devices=[0,1,2,3] +trainer.num_nodes=2", 105_000, 6e-6),
        ("trainer=ddp trainer.devices=-1 trainer.accelerator=cpu", 840_000, 3e-6 * 0.5**0.5),
        ("trainer=ddp trainer.devices=8 optimizer.lr=1e-5 trainer.max_steps=7", 7, 1e-5),
    ],
)
def test_a_training_of_the_papers_length_reads_as_many_images_on_any_machine(tmp_path, machine, steps, rate):
    config = composed(tmp_path, "experiment=paper", *machine.split())
    assert config.trainer.max_steps == config.data.steps_per_epoch == steps
    assert config.optimizer.lr == pytest.approx(rate, rel=1e-12)
    if "optimizer" not in machine:
        assert config.training.final_lr / config.optimizer.lr == pytest.approx(1e-8 / 3e-6)


MACHINES = {  # what the trainers of the experiments compute on
    "trainer=gpu": {"devices": [0], "nodes": 1, "strategy": SingleDeviceStrategy},
    "trainer=ddp": {"devices": [0, 1], "nodes": 1, "strategy": DDPStrategy},
    "trainer=ddp trainer.devices=-1": {"devices": list(range(8)), "nodes": 1, "strategy": DDPStrategy},
    "trainer=slurm": {"devices": [0, 1, 2, 3], "nodes": 3, "strategy": DDPStrategy},
}


@pytest.mark.parametrize("machine", MACHINES)
def test_experiments_train_on_any_machine(tmp_path, machine, monkeypatch):
    """The trainer that Lightning makes on a machine that pretends to have eight GPUs."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for package in ("fabric", "pytorch"):
        monkeypatch.setattr(f"lightning.{package}.accelerators.cuda.num_cuda_devices", lambda: 8)
    job = {"SLURM_JOB_ID": "7", "SLURM_JOB_NAME": "paper", "SLURM_NTASKS": "12", "SLURM_NTASKS_PER_NODE": "4"}
    job |= {"SLURM_JOB_NUM_NODES": "3", "SLURM_NNODES": "3", "SLURM_LOCALID": "0", "SLURM_PROCID": "0"}
    for name, value in {**job, "SLURM_NODEID": "0", "SLURM_NODELIST": "a"}.items() if "slurm" in machine else ():
        monkeypatch.setenv(name, value)
    config = composed(tmp_path, "experiment=paper", *machine.split())
    assert (config.trainer.accelerator, config.trainer.precision) == ("gpu", "auto")
    precision = trainer_precision(config.trainer.precision, config.trainer.accelerator)
    trainer: lightning.Trainer = instantiate(config.trainer, precision=precision, logger=False)
    expected = MACHINES[machine]
    assert (trainer.device_ids, trainer.num_nodes) == (expected["devices"], expected["nodes"])
    assert trainer.world_size == len(expected["devices"]) * expected["nodes"]
    assert type(trainer.strategy) is expected["strategy"]
    assert trainer.precision == "bf16-mixed"
    assert config.optimizer.fused
    assert composed(tmp_path, machine.split()[0]).optimizer == composed(tmp_path).optimizer  # fused everywhere
    assert "fused" not in composed(tmp_path, "optimizer=adamw", "optimizer.lr=3e-6").optimizer  # bit for bit as ever
    if isinstance(trainer.strategy, DDPStrategy):
        assert trainer.strategy._ddp_kwargs == {"broadcast_buffers": False}


def written_keys(node: Any, place: str) -> Iterator[str]:
    """Dotted keys that a configuration file writes, without Hydra's and those of instantiation (``_target_``)."""
    if isinstance(node, dict) and node:
        for key, value in node.items():
            if key != "defaults":
                yield from written_keys(value, f"{place}.{key}".strip("."))
    elif place and not place.startswith("hydra.") and not place.rpartition(".")[2].startswith("_"):
        yield place


def test_there_are_few_files_and_keys() -> None:
    """What nobody should turn is a default of a constructor, see :data:`DEFAULTS`."""
    files = sorted(Path(config_dir()).rglob("*.yaml"))
    keys: set[str] = set()
    for group, options in variants().items():
        for node in options.values():
            keys.update(written_keys(node, "" if group == "ablation" else group))
    for path in files:
        if path.name != "variants.yaml":
            of_all = path.read_text().startswith("# @package _global_")
            group = "" if of_all else path.relative_to(config_dir()).parts[0].removesuffix(path.name)
            keys.update(written_keys(OmegaConf.to_container(OmegaConf.load(path)), group))
    assert len(files) <= 60
    assert len(keys) <= 220, sorted(keys)


def test_no_preset_but_a_trainers_chooses_the_machine() -> None:
    """Presets win over groups: one that sets devices or precision makes the trainer of the command line void."""
    for path in Path(config_dir()).rglob("*.yaml"):
        if path.parent.name != "trainer":
            chosen = (OmegaConf.load(path).get("trainer") or {}).keys()  # pyright: ignore
            assert not chosen & {"accelerator", "devices", "num_nodes", "strategy", "precision"}, path
