"""From a configuration to the model, the data and the settings of an evaluation."""

from __future__ import annotations

import hashlib
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from vg2gt.config import config_dir
from vg2gt.model import Reconstructor
from vg2gt.runs.checkpoints import model_state, newest_valid, read_checkpoint
from vg2gt.runs.trust import check_targets, read_run_config

PARTS = ("backend", "model", "renderer")


def checkpoint_path(ckpt: str | None) -> Path | None:
    """The checkpoint file that ``ckpt`` means: itself, or the newest valid one of a run's folder.

    Raises:
        FileNotFoundError: if there is none.
    """
    if ckpt is None:
        return None
    path = Path(ckpt)
    if path.is_dir():
        folder = path / "checkpoints" if (path / "checkpoints").is_dir() else path
        try:
            return newest_valid(folder)
        except FileNotFoundError as error:
            raise FileNotFoundError(
                f"ckpt={ckpt}: no valid checkpoint in {folder}; give a run's folder such as outputs/quickstart, a "
                "checkpoint's file, or ckpt=null for the untrained head"
            ) from error
    if not path.is_file():
        raise FileNotFoundError(
            f"ckpt={ckpt}: no such checkpoint or run; give a file, a run's folder such as outputs/quickstart, or "
            "ckpt=null for the untrained head"
        )
    return path


def run_config_path(checkpoint: Path) -> Path:
    """Where the configuration of a checkpoint's run is."""
    return checkpoint.resolve().parent.parent / "config.yaml"


def run_name(ckpt: str | None) -> str:
    """Name of the run to which a checkpoint belongs, for the evaluation's folder; ``untrained`` without one."""
    if not ckpt:
        return "untrained"
    parts = [part for part in Path(ckpt).parts if part not in ("outputs", "checkpoints", "/", "..", ".")]
    folders = parts[:-1] if parts[-1:] and parts[-1].endswith(".ckpt") else parts
    return (folders or [Path(ckpt).stem])[-1]


def resolve_parts(config: DictConfig, checkpoint: Path | None) -> dict[str, DictConfig]:
    """Configurations of backend, model and renderer: the run's own, changed by those that the evaluation names.

    ``model=tiny`` replaces the run's model, ``+model.fine.max_voxels=100000`` changes one key of it. Without a
    checkpoint the training defaults stand for the run.

    Raises:
        FileNotFoundError: if the run's ``config.yaml`` is needed and missing.
        ValueError: if it lacks a part.
        UntrustedError: if what is needed of it is not data only, or names what is not ours (:mod:`vg2gt.runs.trust`).
    """
    given: dict[str, Any] = {part: config.get(part) for part in PARTS}
    if all(value is not None and "_target_" in value for value in given.values()):
        return given
    path = None if checkpoint is None else run_config_path(checkpoint)
    if path is None:
        run = _training_defaults()
    else:
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} is missing: the run's configuration says which model and backend its checkpoint belongs to; "
                "put it back, or name both with model= and backend= and renderer="
            )
        run = read_run_config(path)
    parts = {}
    for part, value in given.items():
        whole = value is not None and "_target_" in value
        if path is not None and not whole:
            if run.get(part) is None:
                raise ValueError(f"{path} names no {part}: it is not the configuration of a run; name one with {part}=")
            check_targets(run[part], f"{path}: {part}")
        parts[part] = value if whole else OmegaConf.merge(run[part], value or {})
    return parts


def _training_defaults() -> DictConfig:
    # Inside a command Hydra is initialised already, with the same folder.
    inside = GlobalHydra.instance().is_initialized()
    with nullcontext() if inside else initialize_config_dir(config_dir(), version_base="1.3"):
        return compose("train", ["output_dir=.", "hydra/job_logging=default"])


@dataclass(frozen=True)
class TrainedWeights:
    """Where the evaluated weights come from.

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


def build_model(parts: dict[str, DictConfig], seed: int, device: torch.device) -> Reconstructor:
    """Instantiates the model in eval mode on its device; an untrained head is seeded."""
    torch.manual_seed(seed)
    backend = instantiate(parts["backend"])
    model = instantiate(parts["model"], backend=backend)
    return model.eval().to(device)


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
