"""From names and files to a model that is ready to reconstruct."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vg2gt.config import config_dir
from vg2gt.model import Reconstructor
from vg2gt.rendering import Renderer
from vg2gt.runs.load import (
    PARTS,
    TrainedWeights,
    build_model,
    checkpoint_path,
    choose_device,
    load_weights,
    resolve_parts,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedModel:
    """A model with what belongs to it.

    Attributes:
        model: in eval mode, on its device.
        renderer: the run's options; renders solids unless asked otherwise.
        weights: where the trained part comes from.
    """

    model: Reconstructor
    renderer: Renderer
    weights: TrainedWeights


def load_model(
    ckpt: str | Path | None = None,
    backend: str | None = None,
    model: str | None = None,
    options: Sequence[str] = (),
    device: str = "auto",
    seed: int = 0,
) -> LoadedModel:
    """Builds a model as its run was configured, and loads its trained part.

    Args:
        ckpt: a checkpoint or a run's folder; None: the untrained head, which makes coloured voxels.
        backend: ``NAME[,key=value...]`` of ``configs/backend``; None: the run's own.
        model: ``NAME[,key=value...]`` of ``configs/model``; None: the run's own, ``tiny`` without a checkpoint.
        options: further ``part.key=value``, part being ``backend``, ``model`` or ``renderer``.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.
        seed: of the untrained head.

    Raises:
        FileNotFoundError: if there is no such checkpoint, or its run's ``config.yaml`` or a weight file is missing.
        ValueError: if neither a checkpoint nor a backend is given, a name or an option is unknown, or the checkpoint
            belongs to another backbone.
    """
    if ckpt is None and backend is None:
        raise ValueError(
            f"name a checkpoint, or a backend for the untrained head, one of: {', '.join(_names('backend'))}"
        )
    checkpoint = checkpoint_path(None if ckpt is None else str(ckpt))
    given = {"backend": backend, "model": model}
    config = OmegaConf.create({part: compose_part(part, spec) for part, spec in given.items() if spec is not None})
    parts = resolve_parts(config, checkpoint)
    for option in options:
        _set_option(parts, option)
    try:
        built = build_model(parts, seed, choose_device(device))
        renderer: Renderer = instantiate(parts["renderer"])
    except HydraException as error:
        raise _cause(error) from error
    weights = load_weights(built, checkpoint)
    if checkpoint is None and built.trained_parameters():
        log.warning("no checkpoint: the head is untrained and makes coloured voxels (give ckpt for a trained one)")
    return LoadedModel(built, replace(renderer, mode="solid", depth="median"), weights)


def compose_part(part: str, spec: str) -> DictConfig:
    """Configuration of ``NAME[,key=value...]`` of a group: ``backend``, ``model`` or ``renderer``.

    Raises:
        ValueError: if the name or an option is unknown.
    """
    name, *changes = split_outside_brackets(spec)
    if name not in _names(part):
        raise ValueError(f"unknown {part} {name!r}; choose one of: {', '.join(_names(part))}")
    # Inside a command Hydra is initialised already, with the same folder.
    inside = GlobalHydra.instance().is_initialized()
    with nullcontext() if inside else initialize_config_dir(config_dir(), version_base="1.3"):
        config = compose(overrides=[f"+{part}={name}"])[part]
    for change in changes:
        _update(config, change, f"{part} {name}", anything=name == "custom")
    return config


def _set_option(parts: dict[str, DictConfig], option: str) -> None:
    part, _, change = option.partition(".")
    if part not in PARTS:
        raise ValueError(f"option {option!r} must begin with one of {', '.join(f'{name}.' for name in PARTS)}")
    _update(parts[part], change, part)


def _update(config: DictConfig, change: str, place: str, anything: bool = False) -> None:
    key, equals, _ = change.partition("=")
    if not equals:
        raise ValueError(f"option {change!r} of {place} must be key=value")
    missing = object()
    if not anything and OmegaConf.select(config, key, default=missing) is missing:
        raise ValueError(f"{place} has no option {key!r}; it has {', '.join(str(name) for name in config)}")
    try:
        OmegaConf.set_struct(config, False)
        config.merge_with_dotlist([change])
    except (OmegaConfBaseException, ValueError) as error:
        raise ValueError(f"option {change!r} of {place}: {error}") from error


def split_outside_brackets(text: str) -> list[str]:
    """Splits at commas that are in no brackets, so that values may be lists."""
    parts, depth = [""], 0
    for character in text:
        depth += (character in "[{(") - (character in "]})")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts]


def _names(group: str) -> list[str]:
    return sorted(path.stem for path in (Path(config_dir()) / group).glob("*.yaml"))


def _cause(error: HydraException) -> Exception:
    """What a constructor said; Hydra's own words around it name classes nobody asked about."""
    cause: Any = error.__cause__
    return cause if isinstance(cause, (ValueError, FileNotFoundError, ImportError)) else ValueError(str(error))
