"""Loading of models with their trained weights, from names and files."""

from __future__ import annotations

import hashlib
import inspect
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.errors import HydraException
from hydra.utils import get_class, instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from backends.published import NETWORKS
from vg2gt.config import compose, compose_groups, flatten
from vg2gt.io.tensors import tensors_digest
from vg2gt.model import Reconstructor
from vg2gt.rendering import Renderer
from vg2gt.runs.checkpoints import (
    MADE_OF,
    checkpoint_path,
    model_state,
    read_checkpoint,
    refuse_not_finite,
)
from vg2gt.runs.untrusted import check_targets, parse_run_config
from vg2gt.uncertainty import Calibration, read_calibration

log = logging.getLogger(__name__)

SHIPPED = Path(__file__).resolve().parents[1] / "weights" / "sweep-tiny.safetensors"
"""Head trained on ``backend=sweep``; the package also contains that backend's weights, so no download is needed."""
PARTS = ("backend", "model", "renderer")
_TOKENS = ("taps", "reference_view", "given_poses")
"""Backend keys that change its outputs for the same weights; a trained part is valid for one choice only."""

RESUMED_IN_PLACE = (None, "last", "auto")
"""Values of ``ckpt`` and ``init_from`` that name no other run."""


@dataclass(frozen=True)
class TrainedWeights:
    """Origin of a model's weights.

    Attributes:
        path: the checkpoint; None if untrained.
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
    """A loaded model.

    Attributes:
        model: the model, in eval mode on its device.
        renderer: its run's renderer, set to stochastic solids with median depth.
        weights: origin of the weights.
        calibration: error bounds of its depth; None if they were not measured (``vg2gt calibrate``).
    """

    model: Reconstructor
    renderer: Renderer
    weights: TrainedWeights
    calibration: Calibration | None = None


def load_model(
    ckpt: str | Path | None = None,
    backend: str | None = None,
    overrides: Sequence[str] = (),
    device: str = "auto",
) -> LoadedModel:
    """Builds a model from the configuration of its run and loads the trained weights.

    Args:
        ckpt: a checkpoint or a run's folder. None loads the weights that ship with the package (:data:`SHIPPED`), or
            with another backend than ``sweep`` the untrained head of ``model=tiny_ungated`` (``oracle``: ``tiny``),
            which predicts coloured voxels.
        backend: an option of ``backend=``, short for the override ``backend=NAME``; None keeps the run's backend.
        overrides: command-line overrides. ``backend=NAME``, ``model=NAME`` and ``renderer=NAME`` replace a part of the
            run's configuration; ``backend.key=value`` and the like change one key.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    Returns:
        The model in eval mode, its renderer and the origin of its weights.

    Raises:
        FileNotFoundError: if there is no such checkpoint, or a weight file is missing.
        ImportError: if the backend needs a package that is not installed.
        ValueError: if a name or an option is unknown, or the checkpoint belongs to another backbone.
    """
    checkpoint, parts = _model_parts(ckpt, [*([f"backend={backend}"] if backend else []), *overrides])
    try:
        built = build_model(parts, 0, choose_device(device))
        renderer: Renderer = instantiate(parts["renderer"])
    except HydraException as error:
        # Raise the constructor's own error: Hydra's message around it names internal classes.
        cause: Any = error.__cause__
        known = isinstance(cause, (ValueError, FileNotFoundError, ImportError))
        raise (cause if known else ValueError(str(error))) from error
    weights = load_weights(built, checkpoint)
    if checkpoint is None and built.trained_parameters():
        log.warning("no trained weights for this backend: the scene is coloured voxels (ckpt names a checkpoint)")
    known = find_calibration(built, weights)
    return LoadedModel(built, replace(renderer, mode="solid", depth="median"), weights, known)


def _model_parts(ckpt: str | Path | None, overrides: Sequence[str]) -> tuple[Path | None, dict[str, DictConfig]]:
    """Returns the checkpoint and the configurations of backend, model and renderer for :func:`load_model`."""
    keys = [override.partition("=")[0].lstrip("+~") for override in overrides]
    for override, key in zip(overrides, keys, strict=True):
        if "=" not in override or key.partition(".")[0] not in PARTS:
            raise ValueError(f"option {override!r}: expected key=value with a key of {', '.join(PARTS)}")
    named = {key for key in keys if "." not in key}
    suits = "backend" not in named or "backend=sweep" in overrides
    checkpoint = checkpoint_path(SHIPPED if ckpt is None and suits else ckpt)
    chosen = [override for override, key in zip(overrides, keys, strict=True) if key.partition(".")[0] in named]
    parts = resolve_parts(compose_groups(*chosen) if chosen else OmegaConf.create(), checkpoint)
    config = OmegaConf.create({part: OmegaConf.to_container(parts[part]) for part in PARTS})
    for override in overrides:
        if override in chosen:
            continue
        OmegaConf.set_struct(config, not override.startswith("+"))  # new keys need a leading plus, as in Hydra
        try:
            config.merge_with_dotlist([override.lstrip("+")])
        except (OmegaConfBaseException, ValueError) as error:
            part = override.lstrip("+").partition(".")[0]
            raise ValueError(
                f"option {override!r}: {str(error).splitlines()[0]}; {part} has {', '.join(parts[part])}"
            ) from error
    parts = {part: config[part] for part in PARTS}
    of_backend = any(key.startswith("backend.") for key in keys)
    if checkpoint is not None and "backend" not in named and of_backend:
        refuse_other_tokens(parts["backend"], read_checkpoint(checkpoint), checkpoint)
    return checkpoint, parts


def backend_class(ckpt: str | Path | None, overrides: Sequence[str]) -> type:
    """Returns the class of the backend that :func:`load_model` would build; ``object`` if it cannot be imported."""
    try:
        return get_class(_model_parts(ckpt, overrides)[1]["backend"]["_target_"])
    except ImportError:
        return object


def resolve_parts(config: DictConfig, checkpoint: Path | None) -> dict[str, DictConfig]:
    """Returns the configurations of backend, model and renderer: the checkpoint's, with the overrides in ``config``.

    ``model=tiny`` replaces the run's model; ``+model.fine.max_voxels=100000`` changes one key of it. Without a
    checkpoint, the training defaults are used, with ``model=tiny_ungated`` for other backends than ``oracle``.

    Raises:
        ValueError: if the checkpoint stores no configuration, or another one decides its tokens.
        UntrustedError: if it holds an interpolation or a target that is not allowed (:mod:`vg2gt.runs.untrusted`).
    """
    given: dict[str, Any] = {part: config.get(part) for part in PARTS}
    parts = {part: value for part, value in given.items() if value is not None and "_target_" in value}
    missing = [part for part in PARTS if part not in parts]
    if missing:
        # the simulated backbone's noise contradicts itself; learned depth is checked against other views
        learned = "backend" in parts and not parts["backend"]["_target_"].endswith("OracleBackend")
        model = ["model=tiny_ungated"] if learned else []
        run = compose("train", "output_dir=.", *model) if checkpoint is None else _config_of(checkpoint, missing)
        OmegaConf.set_struct(run, False)  # +key=value gives arguments that the files leave at their default
        parts |= {part: OmegaConf.merge(run[part], given[part] or {}) for part in missing}
    if checkpoint is not None and given["backend"] is not None:
        refuse_other_tokens(parts["backend"], read_checkpoint(checkpoint), checkpoint)
    return parts


def refuse_other_tokens(backend: Any, checkpoint: Mapping[str, Any], path: Path) -> None:
    """Raises ValueError if a backend's _TOKENS differ from those that a checkpoint was trained with.

    The hash of the weights does not cover these keys. Checkpoints without a configuration pass.
    """
    text = checkpoint.get(MADE_OF)
    if not isinstance(text, str):
        return
    stored = parse_run_config(text, f"{path}: {MADE_OF}").get("backend")
    parts: list[Any] = [OmegaConf.to_container(OmegaConf.create(part or {})) for part in (backend, stored)]
    own, other = ({k: v for k, v in flatten(part).items() if k.endswith("_target_")} for part in parts)
    if own != other:  # compared before any of the checkpoint's classes is imported
        return  # another network, which the hash of the weights reveals, or the same network as an ONNX bundle
    here, there = (flatten(_with_defaults(part)) for part in parts)
    for key in sorted(here.keys() & there.keys()):
        if key.rpartition(".")[2] in _TOKENS and here[key] != there[key]:
            raise ValueError(
                f"{path} was trained with backend.{key}={there[key]}, but this run uses {here[key]}: use the same "
                "value, or start a new run from these weights with init_from="
            )


def _with_defaults(backend: Any) -> Any:
    """Options of a backend, with the defaults of its constructor and the shape of its network where it names none."""
    if not isinstance(backend, dict):
        return list(backend) if isinstance(backend, tuple) else backend
    if "_target_" in backend:
        defaults = constructor_defaults(backend["_target_"])
        named = str(backend.get("name", defaults.get("name")))
        backend = defaults | NETWORKS.get(named, {}) | backend
    return {key: _with_defaults(value) for key, value in backend.items()}


def constructor_defaults(target: str) -> dict[str, Any]:
    """Returns the arguments of a class with a default, tuples as lists; imports the class."""
    parameters = inspect.signature(get_class(target)).parameters.items()
    known = {name: each.default for name, each in parameters if each.default is not each.empty}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in known.items()}


def earlier_configs(path: Path) -> list[Path]:
    """Returns the ``config-N.yaml`` that a run kept next to its ``config.yaml`` when it was resumed, newest first."""
    found = {each.stem.removeprefix("config-"): each for each in path.parent.glob("config-*.yaml")}
    return [found[number] for number in sorted(filter(str.isdecimal, found), key=int, reverse=True)]


def made_of(config: DictConfig) -> str:
    """Returns the configurations of backend, model and renderer as YAML, for checkpoints."""
    return OmegaConf.to_yaml({part: OmegaConf.to_container(config[part], resolve=True) for part in PARTS})


def _config_of(checkpoint: Path, parts: Sequence[str]) -> DictConfig:
    """The configuration that a checkpoint stores, with the targets in ``parts`` checked."""
    text = read_checkpoint(checkpoint).get(MADE_OF)
    if not isinstance(text, str):
        raise ValueError(f"{checkpoint} stores no configuration: set model=, backend= and renderer=")
    run = parse_run_config(text, f"{checkpoint}: {MADE_OF}")
    for part in parts:
        check_targets(run[part], f"{checkpoint}: {MADE_OF}.{part}")
    return run


def build_model(parts: dict[str, DictConfig], seed: int, device: torch.device) -> Reconstructor:
    """Builds the model in eval mode on its device; ``seed`` determines an untrained head."""
    torch.manual_seed(seed)
    model = instantiate(parts["model"], backend=instantiate(parts["backend"]))
    return model.eval().to(device)


def load_weights(model: Reconstructor, path: Path | None) -> TrainedWeights:
    """Loads trained weights into a model; does nothing if ``path`` is None.

    Raises:
        ValueError: if the weights do not fit or are not finite.
    """
    if path is None:
        return TrainedWeights(None, 0, None)
    checkpoint = read_checkpoint(path)
    refuse_not_finite(checkpoint["state_dict"], path)
    model.load_trained(model_state(checkpoint["state_dict"]), checkpoint.get("backend"))
    return TrainedWeights(path, int(checkpoint["global_step"]), hashlib.sha256(path.read_bytes()).hexdigest())


def made_for(model: Reconstructor) -> str:
    """Returns the hash of the weights that a calibration is valid for: the trained part, else the backbone."""
    state = model.trained_state()
    return tensors_digest(state) if state else model.backend.identity()["weights"]


def calibration_path(checkpoint: Path) -> Path:
    """Returns the path of a checkpoint's calibration: ``NAME.calibration.json`` next to it."""
    return checkpoint.with_suffix(".calibration.json")


def find_calibration(
    model: Reconstructor, weights: TrainedWeights, path: str | Path | None = None
) -> Calibration | None:
    """Returns the calibration in ``path``, else the one next to the model's checkpoint; None if there is none.

    A calibration next to the checkpoint that was made for other weights is ignored with a warning.

    Raises:
        FileNotFoundError: if ``path`` does not exist.
        ValueError: if a file is damaged, or ``path`` was made for other weights.
    """
    file = path if path is not None or weights.path is None else calibration_path(weights.path)
    if file is None or (path is None and not Path(file).is_file()):
        return None
    found = read_calibration(file)
    if found.made_for == made_for(model):
        return found
    message = f"{file} was made for other weights: recreate it with vg2gt calibrate"
    if path is not None:
        raise ValueError(message)
    log.warning("%s; depth error bounds are not available", message)
    return None


def choose_device(asked: str) -> torch.device:
    """Returns the named device, for ``auto`` the GPU if there is one; raises ValueError if it is not available."""
    try:
        device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if asked == "auto" else asked)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueError(
            f"device={asked} is not available to torch here; device=auto uses the GPU if there is one"
        ) from error
    return device
