"""Configurations: where the groups are, and how all commands, studies and tests compose them."""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Sequence
from contextlib import nullcontext
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

OmegaConf.register_new_resolver("last_part", lambda path: Path(str(path)).name, replace=True)

_PACKAGE = Path(__file__).resolve().parent
ENTRY_POINTS = {"backend": "vg2gt.backends", "data": "vg2gt.datasets"}
"""By group of configurations, the entry points by which installed packages add options to it."""


def plugin_targets() -> dict[str, dict[str, str]]:
    """Classes of installed packages by group and name; none is imported.

    A package adds ``backend=NAME`` by an entry point ``NAME = "module:Class"`` in ``vg2gt.backends``, and ``data=NAME``
    by one in ``vg2gt.datasets``, where the class is a :class:`~vg2gt.data.sources.files.FileSource`.
    """
    return {
        group: {entry.name: entry.value.replace(":", ".") for entry in importlib.metadata.entry_points(group=points)}
        for group, points in ENTRY_POINTS.items()
    }


def _register_plugins() -> None:
    """Makes options of the plug-ins; a file of the same name in ``configs/`` goes before."""
    store = ConfigStore.instance()
    for name, target in plugin_targets()["backend"].items():
        store.store(name, {"_target_": target}, group="backend")
    for name, target in plugin_targets()["data"].items():
        ends = {end: {"_target_": target} for end in ("train", "val")}
        node = {"defaults": [{"shared@_here_": "files"}, "_self_"], **ends, "image_size": [224, 336]}
        store.store(name, node, group="data")


_register_plugins()


def config_dir() -> str:
    """Returns the absolute path of the configuration folder: inside the installed package, or beside it in a checkout.

    Raises:
        FileNotFoundError: if neither the package nor the checkout holds it.
    """
    for folder in (_PACKAGE / "configs", _PACKAGE.parent / "configs"):
        if (folder / "train.yaml").is_file():
            return str(folder)
    raise FileNotFoundError(f"no configuration folder with train.yaml in or beside {_PACKAGE}; reinstall vg2gt")


def group_options(group: str) -> list[str]:
    """The names that ``group=`` takes, sorted."""
    plugins = plugin_targets().get(group, {})
    return sorted({*plugins, *(path.stem for path in Path(config_dir(), group).glob("*.yaml"))})


def compose(name: str | None, *overrides: str) -> DictConfig:
    """Composes a configuration as the commands do, inside a command as well.

    Args:
        name: ``train``, ``evaluate``, ``ablate``, or one option such as ``loss/quickstart``; None: nothing but what
            ``+group=option`` adds.
        overrides: as on the command line.

    Raises:
        ValueError: if an override is wrong, with Hydra's reason in one line.
    """
    # Inside a command Hydra is initialised already, with the same folder.
    inside = GlobalHydra.instance().is_initialized()
    try:
        with nullcontext() if inside else hydra.initialize_config_dir(config_dir(), version_base="1.3"):
            return hydra.compose(name, list(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(hydra_message(error)) from error


def hydra_message(error: Exception) -> str:
    """What Hydra or OmegaConf say, in one line; where they have looked is left out."""
    said = str(error).partition("Config search path")[0].removeprefix("In '_dummy_empty_config_': ")
    said = said.partition("Error raised while resolving interpolation: ")[2] or said
    if missing := re.match(r".*Could not find '([^']+)/([^'/]+)'", said):
        near = get_close_matches(missing[2], group_options(missing[1]), 1)
        near_by = f", did you mean {near[0]}?" if near else ";"
        said = f"there is no {missing[1]}={missing[2]}{near_by} {said[missing.end() :].strip()}"
    if isinstance(error.__cause__, OmegaConfBaseException):
        said += f" ({str(error.__cause__).splitlines()[0]})"
    return " ".join(said.partition("    full_key")[0].split())


def near_keys(name: str, overrides: Sequence[str], error: Exception) -> str:
    """What an unknown key of a command line may have meant: keys of the same last part, or alike.

    Args:
        name: of the configuration that was composed.
        overrides: the command line's.
        error: that composing them raised.

    Returns:
        The message; empty if the error is another one, or nothing is alike.
    """
    unknown = re.match(r"Could not override '([^']+)'", str(error))
    if unknown is None:
        return ""
    try:
        groups = [each for each in overrides if "." not in (key := each.partition("=")[0]) and key != unknown[1]]
        config = compose(name, *groups, "output_dir=.")
    except ValueError:
        return ""
    keys = [key for key in flatten(OmegaConf.to_container(config, resolve=False)) if "_target_" not in key]
    room, _, last = unknown[1].rpartition(".")
    inner = [key for key in keys if key.startswith(f"{room}." if room else "") and key.endswith(f".{last}")]
    found = (inner or get_close_matches(unknown[1], keys, 3, 0.75))[:3]
    return f"there is no option {unknown[1]}, did you mean {' or '.join(found)}?" if found else ""


def flatten(node: Any, prefix: str = "") -> dict[str, Any]:
    """Names the leaves of nested dictionaries by dotted keys."""
    if not isinstance(node, dict):
        return {prefix: node}
    return {
        key: value
        for name, child in node.items()
        for key, value in flatten(child, f"{prefix}.{name}".strip(".")).items()
    }
