"""Checkpoints on disk: written to a temporary name and renamed, read without executing anything."""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor, nn

log = logging.getLogger(__name__)

PATTERN = "step-*.ckpt"


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint whole or not at all, and loads tensors and plain values only (no pickled code)."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        """Saves to ``<path>.tmp``, flushes to the disk and renames; the file under ``path`` is never half-written."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = target.with_name(target.name + ".tmp")
        try:
            with open(temporary, "wb") as file:
                torch.save(checkpoint, file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except (OSError, RuntimeError) as error:  # a full disk is a RuntimeError of torch's writer
            temporary.unlink(missing_ok=True)
            raise OSError(
                f"checkpoint {target} could not be written ({error}); earlier checkpoints are intact"
            ) from error

    def load_checkpoint(self, path: Any, map_location: Any = "cpu", weights_only: bool | None = True) -> dict[str, Any]:
        """Loads on the CPU with ``weights_only=True``, whatever is asked for."""
        return read_checkpoint(path)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads a checkpoint.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged or holds anything but tensors and plain values.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError, KeyError, OSError) as error:
        raise ValueError(f"checkpoint {path} is damaged or not a checkpoint of this project: {error}") from error


def newest_valid(folder: str | Path) -> Path:
    """Returns the newest readable checkpoint of a run, passing over damaged ones with a warning.

    Raises:
        FileNotFoundError: if the folder holds none.
    """
    folder = Path(folder)
    candidates = sorted(folder.glob(PATTERN), key=_step_of, reverse=True)
    for path in candidates:
        try:
            read_checkpoint(path)
        except ValueError as error:
            log.warning("%s; trying the one before", error)
        else:
            return path
    raise FileNotFoundError(
        f"ckpt=last found no valid checkpoint in {folder} ({len(candidates)} damaged); "
        "start the run without ckpt=last, or name a file with ckpt=PATH"
    )


def _step_of(path: Path) -> int:
    digits = path.stem.removeprefix("step-").split("-")[0]
    return int(digits) if digits.isdigit() else -1


def initialize_from(module: nn.Module, path: str | Path) -> None:
    """Starts a new run from trained weights; layers that don't fit keep their fresh initialisation and are logged.

    Args:
        module: the Lightning module.
        path: checkpoint whose ``state_dict`` is used; optimiser state and step are not.

    Raises:
        ValueError: if nothing in the checkpoint fits the module.
    """
    stored: Mapping[str, Tensor] = read_checkpoint(path).get("state_dict", {})
    present = {k: v for k, v in module.state_dict().items() if not k.startswith("model.backend.")}
    fitting = {k: v for k, v in stored.items() if k in present and present[k].shape == v.shape}
    if not fitting:
        raise ValueError(f"init_from={path}: none of its {len(stored)} tensors fits this model")
    nn.Module.load_state_dict(module, fitting, strict=False)
    fresh = sorted({key.rpartition(".")[0] for key in present.keys() - fitting.keys()})
    unused = sorted({key.rpartition(".")[0] for key in stored.keys() - present.keys()})
    log.info("initialised %d of %d tensors from %s", len(fitting), len(present), path)
    if fresh:
        log.warning("re-initialised layers: %s", ", ".join(fresh))
    if unused:
        log.warning("layers of the checkpoint this model does not have: %s", ", ".join(unused))
