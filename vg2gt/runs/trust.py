"""What is built from a configuration that may come from anywhere.

Hydra calls whatever a configuration names. The project's own YAML and the command line are the user's word; the
``config.yaml`` in a run's folder is not: a run may be downloaded together with its checkpoint. From such a file only
the project's own networks, backends, renderers and datasets are built. A package of one's own is named in the
environment: ``VG2GT_TRUST=my_pkg,other_pkg``.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from torch import nn

from vg2gt.data.base import SceneSource
from vg2gt.io.files import regular
from vg2gt.model import SceneScale
from vg2gt.rendering import Renderer

ENVIRONMENT = "VG2GT_TRUST"
OWN = ("vg2gt", "backends")
KINDS = (nn.Module, SceneSource, SceneScale, Renderer)
"""Of ours, what a run's file may name besides data modules: their constructors read files at most."""
_LARGEST = 1 << 20  # bytes of a run's config.yaml; ours have about 5000
_DEEPEST = 64


class UntrustedError(ValueError):
    """A file from elsewhere asks for more than data."""


def read_run_config(path: str | Path) -> DictConfig:
    """Reads a run's ``config.yaml``, which is plain: it is written with everything resolved.

    Raises:
        FileNotFoundError: if there is none.
        UntrustedError: if it holds tags, aliases or interpolations, or is too large: what could make objects, fill
            memory, or read the environment.
        ValueError: if it is not YAML, or no mapping.
    """
    path = Path(path)
    if path.stat().st_size > _LARGEST:
        raise UntrustedError(f"{path} has {path.stat().st_size} bytes; a run's configuration has at most {_LARGEST}")
    try:
        text = regular(path).read_text(encoding="utf-8")
    except (UnicodeDecodeError, OSError) as error:
        raise ValueError(f"{path} is not a run's configuration: {' '.join(str(error).split())}") from error
    return parse_run_config(text, path)


def parse_run_config(text: str, source: str | Path) -> DictConfig:
    """The configuration that a text from elsewhere holds; ``source`` names it in errors, which are the same."""
    try:
        _refuse_what_is_not_plain(source, text)
        config = OmegaConf.load(io.StringIO(text))
    except (yaml.YAMLError, OSError) as error:  # OmegaConf's own error for a lone value is OSError
        raise ValueError(f"{source} is not a run's configuration: {' '.join(str(error).split())}") from error
    if not isinstance(config, DictConfig):
        raise ValueError(f"{source} is not a run's configuration: expected a mapping, got a list")
    return config


def check_targets(config: Any, source: str | Path) -> None:
    """Checks everything that instantiating a part of a configuration would call; instantiates nothing.

    Args:
        config: the part, a mapping or a sequence.
        source: the file it was read from and the part's name, for the message.

    Raises:
        UntrustedError: naming the first that is neither one of ours nor of a package in ``VG2GT_TRUST``.
    """
    plain = OmegaConf.to_container(config, resolve=False) if OmegaConf.is_config(config) else config
    for key, target in _targets(plain, ""):
        _check(target, f"{source}.{key}_target_ is {str(target)[:100]!r}")


def _refuse_what_is_not_plain(source: str | Path, text: str) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        place = f"{source}, line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            raise UntrustedError(f"{place}: an alias (*{event.anchor}); a run's configuration has none")
        if getattr(event, "tag", None) is not None:
            raise UntrustedError(f"{place}: the tag {event.tag}; a run's configuration holds plain values only")
        if isinstance(event, yaml.ScalarEvent) and "${" in event.value:
            raise UntrustedError(
                f"{place}: the interpolation {event.value[:60]!r}; a run's configuration is written with its values"
            )
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise UntrustedError(f"{place}: nested more than {_DEEPEST} times")


def _targets(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Every ``_target_`` of nested mappings and sequences, with the keys that lead to it."""
    if isinstance(node, Mapping):
        if "_target_" in node:
            yield key, node["_target_"]
        for name, child in node.items():
            yield from _targets(child, f"{key}{name}.")
    elif isinstance(node, Sequence) and not isinstance(node, str):
        for place, child in enumerate(node):
            yield from _targets(child, f"{key}{place}.")


def _check(target: Any, said: str) -> None:
    named = [name.strip() for name in os.environ.get(ENVIRONMENT, "").split(",") if name.strip()]
    package = next((name for name in (*OWN, *named) if isinstance(target, str) and target.startswith(f"{name}.")), None)
    advice = (
        "from a run's file only models, backends, renderers and datasets of this project are built, and what lies in "
        f"packages that you trust by {ENVIRONMENT}=PACKAGE"
    )
    if package is None:
        raise UntrustedError(f"{said}; {advice}")
    try:
        found = get_object(target)
    except Exception as error:  # Hydra's, or whatever importing a trusted package raises
        raise UntrustedError(f"{said}, which cannot be imported ({' '.join(str(error).split())[:200]})") from error
    # A name may lead through a module to what it has imported itself: vg2gt.cli.sweeps.subprocess.run
    home = getattr(found, "__module__", None)
    if not isinstance(home, str) or not f"{home}.".startswith(f"{package}."):
        raise UntrustedError(f"{said}, which is defined in {home}, not in {package}; {advice}")
    if package in OWN and not (isinstance(found, type) and (issubclass(found, KINDS) or _is_data_module(found))):
        raise UntrustedError(f"{said}, which is none of them; {advice}")


def _is_data_module(found: type) -> bool:
    from lightning.pytorch import LightningDataModule  # seconds that a reconstruction does without

    return issubclass(found, LightningDataModule)
