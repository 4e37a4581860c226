"""What is unusual about a configuration, in a line each; nothing here stops a run."""

from __future__ import annotations

from omegaconf import DictConfig

QUICK_STEPS = 320  # trainer=default
QUICK_RATES = (4e-3, 1e-3)  # optimizer=muon and adamw
LARGE_BACKBONE = 768  # width of tokens: BASE and above
WIDE_FUSION = 512  # channels; model=tiny has 64, model=vg2gt 1024
NOT_FOCAL = ("backends.oracle.", "backends.vggt.")


def notices(config: DictConfig) -> list[str]:
    """Names combinations of options that seldom are what was meant.

    Args:
        config: the configuration of a training run.

    Returns:
        One line each; empty for the default run, and for a trial of one step.
    """
    if config.trainer.get("fast_dev_run"):
        return []
    return [line for line in (_quick_settings(config), _voxels_of_metres(config), _foreign_focal(config)) if line]


def _quick_settings(config: DictConfig) -> str | None:
    """A large backbone or model that keeps settings of the quick run, which are for minutes on a CPU."""
    backbone = config.backend.get("relative", config.backend)  # da3_nested has two
    large = []
    if backbone.get("pretrained") and backbone.get("dim", 0) >= LARGE_BACKBONE:
        large.append(f"backend={config.backend.name}")
    if ((config.model.get("coarse") or {}).get("fuse_channels") or 0) >= WIDE_FUSION:
        large.append("a model of the paper's widths")
    loss = config.loss.get("gaussian") or {}
    kept = []
    if config.trainer.max_steps == QUICK_STEPS:
        kept.append(f"trainer.max_steps={QUICK_STEPS}")
    if config.optimizer.lr in QUICK_RATES:
        kept.append(f"optimizer.lr={config.optimizer.lr:g}")
    if loss.get("normal_target") == "gt" and loss.get("color_l1") == 3:
        kept.append("loss=quickstart")
    if not large or not kept:
        return None
    return (
        f"{' and '.join(large)} with {', '.join(kept)} of the quick run, which is made for model=tiny and minutes on a "
        "CPU: experiment=finetune has settings for large backbones"
    )


def _voxels_of_metres(config: DictConfig) -> str | None:
    """The paper's voxels in metres, where the unit is the median depth."""
    fine = config.model.get("fine")
    if not fine or config.model.scale.source != "normalize" or fine.min_footprint > 0:
        return None
    unit = config.model.scale.median_depth
    return (
        f"model.fine.voxel_size={fine.voxel_size:g} with model.scale.source=normalize, model.fine.min_footprint=0: the "
        f"median depth is {unit:g}, so that voxels may be smaller than pixels and fuse nothing; "
        "experiment=paper_counts has voxels of one pixel"
    )


def _foreign_focal(config: DictConfig) -> str | None:
    """Depth Anything 3's convention for metres with the depth of another model."""
    if config.model.scale.source != "focal" or not config.backend._target_.startswith(NOT_FOCAL):
        return None
    return (
        "model.scale.source=focal takes depth times focal length / 300 for metres, which holds for Depth Anything 3 "
        f"and not for {config.backend._target_}: use normalize"
    )
