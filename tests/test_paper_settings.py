"""Every setting of experiment=paper comes from the paper, is a row of the deviations, or changes no result."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from omegaconf import OmegaConf

from tests.commands import ROOT
from tests.test_configs import DEFAULTS
from vg2gt.config import compose

PAPER = ROOT.parent / "shared" / "paper" / "vg2gt.tex"
TABLE = ROOT / "docs" / "concepts" / "deviations.md"
# key: its value, and the line and words of the paper that give it
STATED: dict[str, tuple[Any, int, str]] = {
    "backend.name": ("da3_giant", 655, "DA3-GIANT-1.1 (1.15B)"),
    "model.scale.source": ("focal", 655, r"d_{\text{metric}} = \frac{f \cdot d_{\text{net}}}{300}"),
    "model.coarse.neighbors": (16, 200, "16 nearest voxel centers"),
    "model.fine.voxel_size": (0.002, 295, "voxel size to $0.002$ meters"),
    "model.gaussians.splits": (2, 295, "split each voxel feature into two Gaussian primitives"),
    "model.gaussians.anchor": ("center", 213, "initial Gaussian center is set to the voxel center"),
    "model.gaussians.start": (
        "plain",
        213,
        "initial color of each voxel is computed as a weighted average of image colors",
    ),
    "data.image_size": ([224, 448], 295, r"image resolution of $224\times448$"),
    "data.min_views": (3, 295, "randomly sample 3-18 images"),
    "data.max_views": (18, 295, "randomly sample 3-18 images"),
    "data.max_images": (18, 295, "randomly sample 3-18 images"),
    "data.expand_ratio": (4.0, 657, "sampling strategy similar to the official VGGT implementation"),
    "data.target_views": (0, 257, r"to rendered images $\left\{\mathbf{I}_{i}^\mathbf{G}\right\}_{i=1}^{N}$"),
    "loss.gaussian.color_l1": (1.0, 288, r"\mathcal{L}_\mathbf{G} &= \mathcal{L}_1^c"),
    "loss.gaussian.ssim": (1.0, 288, r"+ \mathcal{L}_\text{SSIM}^c"),
    "loss.gaussian.depth_consistency": (1.0, 288, r"\mathcal{L}_1(\mathbf{D},\mathbf{D}_\mathbf{G})"),
    "loss.gaussian.depth_gt": (1.0, 288, r"\mathcal{L}_1(\mathbf{D}_\text{gt},\mathbf{D}_\mathbf{G})"),
    "loss.gaussian.normal": (1.0, 288, r"+ \mathcal{L}_n"),
    "loss.gaussian.weight": (1.0, 288, r"\mathcal{L}_\mathbf{G} &="),
    "renderer.mode": ("solid", 218, "continuous stochastic solids and render them along camera rays"),
    "renderer.depth": ("median", 250, "we define the depth map as the median depth"),
    "renderer.geometry": (True, 292, "we render normal maps directly from Gaussian primitives"),
    "optimizer.lr": (3e-6, 295, r"initial learning rate is set to $3\times10^{-6}$"),
    "training.final_lr": (1e-8, 295, r"decayed to $1\times10^{-8}$"),
    "training.warmup_steps": (0, 295, "cosine annealing schedule"),
    "backend.freeze": (True, 267, "the DA3 backbone and all original decoders are kept frozen"),
    "training.part": ("all", 267, "train only the proposed differentiable multi-scale voxel module"),
    "training.render_views": (None, 284, "rendered RGB images"),
    "images": (420_000 * 2 * 18, 295, "420K iterations"),
    "trainer.devices": (2, 295, "two NVIDIA RTX PRO 6000 GPUs"),
    "trainer.max_steps": (420000, 295, "420K iterations"),
}
# The official code and weights of DA3 and VGGT give these: the networks' shapes, and the weights of VGGT's losses.
OFFICIAL = ("backend.", "loss.geometry.")
# Where files lie, what is written, how fast: no result depends on them.
BOOKKEEPING = (
    "name", "output_dir", "seed", "ckpt", "init_from", "overwrite", "token_cache.", "callbacks.", "logger.",
    "data.workers", "data.memory_mb", "data.seed", "data.steps_per_epoch", "data.index_cache", "data.eval_",
    "data.train.", "data.val.", "data.train_scenes", "data.view_sets", "data.infinigen_root",
    "data.kitti_root", "data.kitti_depth_root", "data.scannet_root",
    "model.fine.dense_head.views_per_chunk", "model.fine.point_mlp.checkpoint",
    "model.scale.median_depth", "renderer.implementation", "renderer.footprints", "renderer.absgrad", "optimizer.fused",
    "training.max_skipped", "training.backend_lr_factor", "training.compile_blocks",
    "trainer.accelerator", "trainer.strategy", "trainer.max_epochs", "trainer.deterministic", "trainer.log_every",
    "trainer.check_val", "trainer.val_check", "trainer.num_sanity", "trainer.limit_val", "trainer.fast_dev_run",
    "trainer.profiler", "trainer.enable_", "trainer.use_distributed_sampler",
)  # fmt: skip


def _settings(experiment: str = "paper") -> dict[str, Any]:
    fixed = ("name=paper", "output_dir=unused")
    config: Any = OmegaConf.to_container(compose("train", f"experiment={experiment}", *fixed), resolve=True)

    def walk(branch: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
        for key, value in (DEFAULTS.get(branch.get("_target_", ""), {}) | branch).items():
            if isinstance(value, dict):
                yield from walk(value, f"{path}{key}.")
            elif key not in ("_target_", "_partial_"):
                yield path + key, value

    return dict(walk(config))


def _explained(key: str, rows: set[str]) -> bool:
    """Whether a row names the key, or a group that ends with a dot and that the key belongs to."""
    return key in rows or any(row.endswith(".") and key.startswith(row) for row in rows)


def test_every_setting_has_a_source() -> None:
    rows = set(re.findall(r"`([a-z0-9_.]+)`", TABLE.read_text()))
    settings = _settings()
    unexplained = [
        key for key in settings
        if key not in STATED and not key.startswith((*OFFICIAL, *BOOKKEEPING)) and not _explained(key, rows)
    ]  # fmt: skip
    assert not unexplained, f"neither the paper nor {TABLE.name} explains {unexplained}"
    gone = [key for key in STATED if key not in settings]
    assert not gone
    assert {key: settings[key] for key in STATED} == {key: value for key, (value, _, _) in STATED.items()}


def test_the_table_names_what_there_is() -> None:
    """No option in it is gone, and the experiments take the paper's side of the keys that the page says they do."""
    settings, text = _settings(), TABLE.read_text()
    options = re.findall(r"`((?:backend|model|data|loss|renderer|optimizer|training|trainer)\.[a-z0-9_.]+)`", text)
    assert not [row for row in options if not any(key.startswith(row) for key in settings)]
    marked = {key: yaml.safe_load(value) for key, value in re.findall(r"`([a-z0-9_.]+)`\* \(`([^`]+)`\)", text)}
    assert len(marked) > 10
    assert {key: settings[key] for key in marked} == marked
    pairs = re.findall(r"`([a-z0-9_.]+)`\*? \(`([^`]+)`\)", text)
    assert len(pairs) == text.count("(`")  # the page's brackets hold nothing else
    bracketed = {key: yaml.safe_load(value) for key, value in pairs}
    literal = _settings("paper_literal")
    assert {key: literal[key] for key in bracketed} == bracketed
    changed = {key for key in settings.keys() & literal.keys() if settings[key] != literal[key]}
    assert changed <= bracketed.keys()


@pytest.mark.skipif(not PAPER.is_file(), reason=f"needs {PAPER.name}")
def test_the_paper_says_what_is_cited() -> None:
    lines = Path(PAPER).read_text().splitlines()
    assert not [key for key, (_, line, words) in STATED.items() if words not in lines[line - 1]]
