"""From names and files to a model with its trained part."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from vg2gt.config import compose, group_options
from vg2gt.model import Reconstructor
from vg2gt.rendering import Renderer
from vg2gt.runs.checkpoints import model_state, read_checkpoint
from vg2gt.runs.find import checkpoint_path, run_config_path
from vg2gt.runs.trust import check_targets, read_run_config

log = logging.getLogger(__name__)

PARTS = ("backend", "model", "renderer")


@dataclass(frozen=True)
class TrainedWeights:
    """Where a model's weights come from.

    Attributes:
        path: the checkpoint; None for the untrained head.
        step: its training step.
        digest: sha256 of the file.
    """

    path: Path | None
    step: int
    digest: str | None

    def __str__(self) -> str:
        return f"{self.path} (step {self.step})" if self.path else "none: the head is untrained"


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
        choices = ", ".join(group_options("backend"))
        raise ValueError(f"name a checkpoint, or a backend for the untrained head, one of: {choices}")
    checkpoint = checkpoint_path(ckpt)
    given = {"backend": backend, "model": model}
    config = OmegaConf.create({part: compose_part(part, spec) for part, spec in given.items() if spec is not None})
    parts = resolve_parts(config, checkpoint)
    for option in options:
        part, _, change = option.partition(".")
        if part not in PARTS:
            raise ValueError(f"option {option!r} must begin with one of {', '.join(f'{name}.' for name in PARTS)}")
        _update(parts[part], change, part)
    try:
        built = build_model(parts, seed, choose_device(device))
        renderer: Renderer = instantiate(parts["renderer"])
    except HydraException as error:
        # What a constructor said; Hydra's own words around it name classes nobody asked about.
        cause: Any = error.__cause__
        known = isinstance(cause, (ValueError, FileNotFoundError, ImportError))
        raise (cause if known else ValueError(str(error))) from error
    weights = load_weights(built, checkpoint)
    if checkpoint is None and built.trained_parameters():
        log.warning("no checkpoint: the head is untrained and makes coloured voxels (give ckpt for a trained one)")
    return LoadedModel(built, replace(renderer, mode="solid", depth="median"), weights)


def resolve_parts(config: DictConfig, checkpoint: Path | None) -> dict[str, DictConfig]:
    """Configurations of backend, model and renderer: the run's own, changed by those that ``config`` names.

    ``model=tiny`` replaces the run's model, ``+model.fine.max_voxels=100000`` changes one key of it. Without a
    checkpoint the training defaults stand for the run.

    Raises:
        FileNotFoundError: if the run's ``config.yaml`` is needed and missing.
        ValueError: if it lacks a part.
        UntrustedError: if what is needed of it is not data only, or names what is not ours (:mod:`vg2gt.runs.trust`).
    """
    given: dict[str, Any] = {part: config.get(part) for part in PARTS}
    parts = {part: value for part, value in given.items() if value is not None and "_target_" in value}
    missing = [part for part in PARTS if part not in parts]
    if not missing:
        return parts
    if checkpoint is None:
        run = compose("train", "output_dir=.")
    else:
        path = run_config_path(checkpoint)
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} is missing: the run's configuration says which model and backend its checkpoint belongs to; "
                "put it back, or name both with model= and backend= and renderer="
            )
        run = read_run_config(path)
        for part in missing:
            if run.get(part) is None:
                raise ValueError(f"{path} names no {part}: it is not the configuration of a run; name one with {part}=")
            check_targets(run[part], f"{path}: {part}")
    return parts | {part: OmegaConf.merge(run[part], given[part] or {}) for part in missing}  # pyright: ignore


def compose_part(part: str, spec: str) -> DictConfig:
    """Configuration of ``NAME[,key=value...]`` of a group: ``backend``, ``model`` or ``renderer``.

    Raises:
        ValueError: if the name or an option is unknown.
    """
    name, *changes = split_outside_brackets(spec)
    if name not in group_options(part):
        raise ValueError(f"unknown {part} {name!r}; choose one of: {', '.join(group_options(part))}")
    config = compose(None, f"+{part}={name}")[part]
    for change in changes:
        _update(config, change, f"{part} {name}", anything=name == "custom")
    return config


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


def build_model(parts: dict[str, DictConfig], seed: int, device: torch.device) -> Reconstructor:
    """Instantiates the model in eval mode on its device; an untrained head is seeded."""
    torch.manual_seed(seed)
    model = instantiate(parts["model"], backend=instantiate(parts["backend"]))
    return model.eval().to(device)


def load_weights(model: Reconstructor, path: Path | None) -> TrainedWeights:
    """Loads the trained part into a model; nothing without a path.

    Raises:
        ValueError: if it was trained on another backbone, or does not fit the model.
    """
    if path is None:
        return TrainedWeights(None, 0, None)
    checkpoint = read_checkpoint(path)
    model.load_trained(model_state(checkpoint["state_dict"]), checkpoint.get("backend"))
    return TrainedWeights(path, int(checkpoint["global_step"]), hashlib.sha256(path.read_bytes()).hexdigest())


def choose_device(asked: str) -> torch.device:
    """``auto`` is the GPU where there is one.

    Raises:
        ValueError: if there is no such device.
    """
    there = torch.cuda.is_available()
    try:
        device = torch.device(("cuda" if there else "cpu") if asked == "auto" else asked)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        known = "a GPU (cuda) and a CPU" if there else "a CPU only"
        raise ValueError(
            f"device={asked}: torch sees {known} here; device=auto takes the GPU if there is one"
        ) from error
    return device
