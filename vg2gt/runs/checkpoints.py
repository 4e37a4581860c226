"""Checkpoint files: atomic writes, and reading without executing code."""

from __future__ import annotations

import json
import logging
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from vg2gt.io.files import replacing, write_bytes

log = logging.getLogger(__name__)

_PATTERN = "step-*.ckpt"
_DAMAGED = "is damaged or not a checkpoint of this project (delete it to resume from the one before)"
_SLIM = ".safetensors"  # a checkpoint without training state
MADE_OF = "config"  # key of the configuration of backend, model and renderer, as YAML
MODEL_PREFIX = "model."  # prefix of the model's names in a checkpoint's state_dict, from the Lightning module


def write_checkpoint(checkpoint: Mapping[str, Any], path: str | Path) -> None:
    """Writes under a temporary name, flushes to disk and renames, so that ``path`` is never half-written.

    Raises:
        OSError: if it cannot be written (such as a full disk); an existing ``path`` is left intact.
    """
    try:
        with replacing(path, durable=True) as temporary, open(temporary, "wb") as file:
            torch.save(checkpoint, file)
    except (OSError, RuntimeError) as error:  # torch's writer may raise RuntimeError for a full disk
        raise OSError(
            f"checkpoint {path} could not be written ({error}; is the disk full?); earlier checkpoints are intact: "
            "free disk space and resume with ckpt=last"
        ) from error


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads a checkpoint and verifies its checksums.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged or holds anything but tensors and plain values.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}")
    if path.suffix == _SLIM:
        return _read_slim(path)
    try:
        with zipfile.ZipFile(path) as archive:  # torch.load does not verify checksums: flipped bits become weights
            if (wrong := archive.testzip()) is not None:
                raise ValueError(f"wrong checksum of {wrong}")
        content = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(content, dict):
            raise ValueError(f"it holds a {type(content).__name__}")
    except Exception as error:  # damaged bytes make readers raise almost anything
        raise ValueError(f"{path} {_DAMAGED}: {error}") from error
    return content


def write_slim(checkpoint: str | Path, path: str | Path) -> Path:
    """Writes a checkpoint for inference as safetensors: the trained weights, with the configuration in the header.

    Args:
        checkpoint: checkpoint of a run.
        path: output file, must end with ``.safetensors``. All commands accept it as a checkpoint, but training cannot
            resume from it.

    Returns:
        The path written.

    Raises:
        ValueError: if ``path`` has another suffix, or the checkpoint holds no configuration.
    """
    content = read_checkpoint(checkpoint)
    if Path(path).suffix != _SLIM or MADE_OF not in content:
        raise ValueError(f"{path} must end with {_SLIM}, and {checkpoint} must contain its configuration")
    header = {
        "backend": json.dumps(content["backend"]),
        "step": str(content["global_step"]),
        MADE_OF: content[MADE_OF],
    }
    state = {name: tensor.contiguous() for name, tensor in sorted(content["state_dict"].items())}
    return write_bytes(path, save(state, metadata=header))


def _read_slim(path: Path) -> dict[str, Any]:
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            names = list(file.keys())
            state = {name: file.get_tensor(name) for name in names}
        facts = {
            "backend": json.loads(header["backend"]),
            "global_step": int(header["step"]),
            MADE_OF: header[MADE_OF],
        }
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path} {_DAMAGED}: {error}") from error
    return {"state_dict": state, **facts}


def model_state(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns a checkpoint's ``state_dict`` with the model's own names (without :data:`MODEL_PREFIX`)."""
    return {name.removeprefix(MODEL_PREFIX): tensor for name, tensor in state.items()}


def refuse_not_finite(state: Mapping[str, Tensor], path: str | Path) -> None:
    """Raises ValueError if weights are not finite (training diverged), naming the file and the first bad tensor."""
    bad = next((name for name, value in state.items() if not bool(torch.isfinite(value).all())), None)
    if bad is not None:
        raise ValueError(f"checkpoint {path} has non-finite weights ({bad}): use an earlier checkpoint of its run")


def newest(folder: str | Path) -> Path:
    """Returns the newest checkpoint in a folder.

    Raises:
        FileNotFoundError: if there is none.
    """
    found = by_age(Path(folder))
    if not found:
        raise FileNotFoundError(f"no checkpoint in {folder}: name one with ckpt=PATH, or start anew with ckpt=null")
    return found[0]


def by_age(folder: Path) -> list[Path]:
    """Returns the checkpoints in a folder, newest first."""
    return sorted(folder.glob(_PATTERN), key=lambda path: (_step_of(path), path.name), reverse=True)


def _step_of(path: Path) -> int:
    digits = path.stem.removeprefix("step-").split("-")[0]
    return int(digits) if digits.isdecimal() else -1


def initialize_from(module: nn.Module, path: str | Path) -> None:
    """Initialises a Lightning module from trained weights; layers that do not fit keep their values and are logged.

    Raises:
        ValueError: if no tensor of the checkpoint fits the module, one is not finite, or it would change a frozen one.
    """
    stored: Mapping[str, Tensor] = read_checkpoint(path).get("state_dict", {})
    refuse_not_finite(stored, path)
    present = {k: v for k, v in module.state_dict().items() if k in stored or not k.startswith("model.backend.")}
    fitting = {k: v for k, v in stored.items() if k in present and present[k].shape == v.shape}
    frozen = {n for n, v in module.named_parameters() if n.startswith("model.backend.") and not v.requires_grad}
    if any(not torch.equal(present[name].cpu(), fitting[name].cpu()) for name in frozen & fitting.keys()):
        raise ValueError(f"init_from={path} holds a trained backbone, but this one is frozen: set backend.freeze=false")
    if not fitting:
        raise ValueError(f"init_from={path}: none of its {len(stored)} tensors matches this model")
    nn.Module.load_state_dict(module, fitting, strict=False)
    fresh = sorted({key.rpartition(".")[0] for key in present.keys() - fitting.keys()})
    unused = sorted({key.rpartition(".")[0] for key in stored.keys() - present.keys()})
    log.info("initialised %d of %d tensors from %s", len(fitting), len(present), path)
    if fresh:
        log.warning("re-initialised layers: %s", ", ".join(fresh))
    if unused:
        log.warning("layers of the checkpoint this model does not have: %s", ", ".join(unused))


def checkpoint_path(ckpt: str | Path | None, option: str = "ckpt") -> Path | None:
    """Returns ``ckpt`` if it is a file, or the newest checkpoint of a run's folder; None for None.

    Raises:
        FileNotFoundError: if there is no such file, or no checkpoint in the folder; names ``option``.
    """
    if ckpt is None or Path(ckpt).is_file():
        return None if ckpt is None else Path(ckpt)
    found = [*by_age(Path(ckpt, "checkpoints")), *by_age(Path(ckpt))]
    if not found:
        raise FileNotFoundError(
            f"{option}={ckpt}: no such checkpoint or run; give a run's folder such as outputs/quickstart, a "
            "checkpoint's file, or null for none (the untrained head)"
        )
    return found[0]


def run_config_path(checkpoint: Path) -> Path:
    """Returns the path of ``config.yaml`` of a checkpoint's run."""
    return checkpoint.resolve().parent.parent / "config.yaml"
