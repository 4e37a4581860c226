"""Checks of untrusted configurations before anything in them is instantiated.

Hydra calls whatever a configuration names, and the ``config.yaml`` of a run may be downloaded. Only three kinds of
target are allowed: the project's own networks, backends, renderers and datasets; classes that installed packages
declare (:func:`vg2gt.config.plugin_targets`); and anything in packages named in ``VG2GT_TRUST=my_pkg,other_pkg``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from torch import nn

from vg2gt.config import plugin_targets
from vg2gt.data.base import SceneSource
from vg2gt.io.files import regular
from vg2gt.model import SceneScale
from vg2gt.rendering import Renderer
from vg2gt.visibility import ViewCheck

ENVIRONMENT = "VG2GT_TRUST"
OWN = ("vg2gt", "backends")
KINDS = (nn.Module, SceneSource, SceneScale, ViewCheck, Renderer)
"""Classes of this project that a run's file may name, besides data modules; their constructors at most read files."""


class UntrustedError(ValueError):
    """An untrusted file asks for more than data."""


def read_run_config(path: str | Path) -> DictConfig:
    """Reads a run's ``config.yaml``.

    Raises:
        UntrustedError: if it holds an interpolation.
        ValueError: if it is not a YAML mapping of plain values.
    """
    try:
        text = regular(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a run's configuration: {error}") from error
    return parse_run_config(text, path)


def parse_run_config(text: str, source: str | Path) -> DictConfig:
    """Parses an untrusted configuration; ``source`` names it in errors, which are those of :func:`read_run_config`."""
    if "${" in text:  # an interpolation could read the environment
        raise UntrustedError(f"{source} holds an interpolation; a run's configuration must contain plain values only")
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"{source} is not a run's configuration: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{source} is not a run's configuration: expected a mapping")
    return OmegaConf.create(content)


def check_targets(config: Any, source: str | Path) -> None:
    """Checks every target that instantiating a part of a configuration would call; instantiates nothing.

    Args:
        config: part of the configuration, a mapping or a sequence.
        source: its file and the part's name, for messages.

    Raises:
        UntrustedError: for the first target that is not allowed (see the module's docstring) or cannot be imported.
    """
    trusted = [name.strip() for name in os.environ.get(ENVIRONMENT, "").split(",") if name.strip()]
    plain = OmegaConf.to_container(config, resolve=False) if OmegaConf.is_config(config) else config
    declared = {target for targets in plugin_targets().values() for target in targets.values()}
    for key, target in _targets(plain, ""):
        if isinstance(target, str) and target in declared:
            continue
        said = f"{source}.{key}_target_ is {str(target)[:100]!r}"
        package = str(target).partition(".")[0]
        if not isinstance(target, str) or package not in (*OWN, *trusted):
            raise UntrustedError(
                f"{said}; a run's file may only name models, backends, renderers and datasets of this project, or "
                f"packages trusted with {ENVIRONMENT}=PACKAGE"
            )
        try:
            found = get_object(target)
        except Exception as error:  # Hydra's, or whatever importing a trusted package raises
            raise UntrustedError(f"{said}, which cannot be imported ({' '.join(str(error).split())[:200]})") from error
        # a name may reach what a module has imported, such as vg2gt.kernels.threads.os.mkdir
        home = str(getattr(found, "__module__", None))
        if home.partition(".")[0] != package:
            raise UntrustedError(f"{said}, which is defined in {home}, not in {package} ({ENVIRONMENT}=PACKAGE)")
        bases = found.__mro__ if isinstance(found, type) else ()
        if package in OWN and not any(base in KINDS or base.__name__ == "LightningDataModule" for base in bases):
            raise UntrustedError(f"{said}, which is not a model, backend, renderer or dataset ({ENVIRONMENT}=PACKAGE)")


def _targets(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Every ``_target_`` in nested mappings and sequences, with the path of keys to it."""
    if isinstance(node, Mapping):
        if "_target_" in node:
            yield key, node["_target_"]
        for name, child in node.items():
            yield from _targets(child, f"{key}{name}.")
    elif isinstance(node, Sequence) and not isinstance(node, str):
        for place, child in enumerate(node):
            yield from _targets(child, f"{key}{place}.")
