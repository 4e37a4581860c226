"""Finds the configuration groups and composes them, for all commands, studies and tests."""

from __future__ import annotations

import importlib.metadata
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException


def _images_per_step(config: DictConfig) -> int:
    """Images that all devices of a training together read in a step, at most."""
    trainer, devices = config.trainer, str(config.trainer.devices).strip("[]")
    if devices in ("-1", "auto"):
        import torch

        count = 1 if trainer.accelerator == "cpu" else max(1, torch.cuda.device_count())
    else:
        count = len(devices.split(",")) if "," in devices or "[" in str(trainer.devices) else int(devices)
    return int(config.data.max_images) * count * int(trainer.get("num_nodes", 1))


def _steps_for(images: int, *, _root_: DictConfig) -> int:
    """``${steps_for:IMAGES}``: the number of steps that read so many images, on any number of devices."""
    return round(images / _images_per_step(_root_))


def _rate_for(rate: float, images: int, *, _root_: DictConfig) -> float:
    """``${rate_for:RATE,IMAGES}``: a learning rate for steps of so many images, scaled by the root of the number.

    Adam's updates have the size of the rate whatever the batch, while the noise of their mean falls with its root
    (Malladi et al., On the SDEs and Scaling Rules for Adaptive Gradient Algorithms, 2022).
    """
    return rate * (_images_per_step(_root_) / images) ** 0.5


OmegaConf.register_new_resolver("last_part", lambda path: Path(str(path)).name, replace=True)
OmegaConf.register_new_resolver("steps_for", _steps_for, replace=True)
OmegaConf.register_new_resolver("rate_for", _rate_for, replace=True)

_PACKAGE = Path(__file__).resolve().parent
_ENTRY_POINTS = {"backend": "vg2gt.backends", "data": "vg2gt.datasets"}
"""Entry-point group through which packages add options, by configuration group."""


def plugin_targets() -> dict[str, dict[str, str]]:
    """Returns the plug-in classes of installed packages by group and name, without importing them.

    A package adds ``backend=NAME`` with an entry point ``NAME = "module:Class"`` in ``vg2gt.backends``, and
    ``data=NAME`` with one in ``vg2gt.datasets``, whose class is a :class:`~vg2gt.data.sources.files.FileSource`.
    """
    return {
        group: {entry.name: entry.value.replace(":", ".") for entry in importlib.metadata.entry_points(group=points)}
        for group, points in _ENTRY_POINTS.items()
    }


def config_dir() -> str:
    """Returns the absolute path of the configuration folder: in the installed package, or next to it in a checkout."""
    for folder in (_PACKAGE / "configs", _PACKAGE.parent / "configs"):
        if (folder / "train.yaml").is_file():
            return str(folder)
    raise FileNotFoundError(
        f"configuration folder (with train.yaml) not found in or next to {_PACKAGE}; reinstall vg2gt"
    )


def variants() -> dict[str, dict[str, Any]]:
    """Returns the options in ``configs/variants.yaml`` by group and name."""
    return yaml.safe_load(Path(config_dir(), "variants.yaml").read_text(encoding="utf-8"))


def _register_options() -> None:
    """Registers variants and plug-ins as options; a file of the same name in ``configs/`` takes precedence."""
    store = ConfigStore.instance()
    for group, options in variants().items():
        for name, node in options.items():
            store.store(name, node, group=group, package="_global_" if group == "ablation" else None)
    for name, target in plugin_targets()["backend"].items():
        store.store(name, {"_target_": target}, group="backend")
    for name, target in plugin_targets()["data"].items():
        ends = {end: {"_target_": target} for end in ("train", "val")}
        node = {"defaults": [{"shared@_here_": "files"}, "_self_"], **ends, "image_size": [224, 336]}
        store.store(name, node, group="data")


_register_options()


def compose(name: str | None, *overrides: str) -> DictConfig:
    """Composes a configuration as the commands do; also works inside a command.

    Args:
        name: ``train``, ``evaluate``, ``ablate``, or one option such as ``loss/quickstart``; None: only what
            ``+group=option`` adds.
        overrides: Hydra overrides, as on the command line.

    Raises:
        ValueError: if an override is invalid, with Hydra's reason.
    """
    # inside a command, Hydra is already initialised with the same folder
    inside = GlobalHydra.instance().is_initialized()
    try:
        with nullcontext() if inside else hydra.initialize_config_dir(config_dir(), version_base="1.3"):
            return hydra.compose(name, list(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        said = str(error).partition("Config search path")[0].partition("    full_key")[0]
        raise ValueError(" ".join(said.split())) from error


def compose_groups(*overrides: str) -> DictConfig:
    """Composes only the groups named by ``group=option``, modified by ``group.key=value``."""
    return compose(None, *(each if "." in each.partition("=")[0] else f"+{each.lstrip('+')}" for each in overrides))


def flatten(node: Any, prefix: str = "") -> dict[str, Any]:
    """Flattens nested dictionaries into one with dotted keys."""
    if not isinstance(node, dict):
        return {prefix: node}
    return {
        key: value
        for name, child in node.items()
        for key, value in flatten(child, f"{prefix}.{name}".strip(".")).items()
    }
