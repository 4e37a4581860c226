"""Checkpoints of the recipe, and the weight file that ships."""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig
from safetensors import safe_open
from safetensors.torch import save

from recipes.sweep.module import SweepTraining
from vg2gt.io.files import write_bytes


def newest_checkpoint(folder: Path) -> Path | None:
    """Returns the most recently written checkpoint; None if there is none."""
    return max(folder.glob("*.ckpt"), key=lambda path: path.stat().st_mtime, default=None)


def start_step(checkpoint: str | Path) -> int:
    """Returns the step at which a checkpoint of this recipe resumes."""
    return int(torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)["global_step"])


def begin_with(training: SweepTraining, path: Path) -> None:
    """Loads initial weights into the network and its average, and adds their core-hours to the count."""
    with safe_open(path, "pt") as file:
        state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        hours = float((file.metadata() or {}).get("core_hours", 0))
    for net in (training.net, training.averaged.module):
        net.load_state_dict(state)
    training.count_from(3600 * hours)


def write_weights(training: SweepTraining, path: Path, config: DictConfig, rooms: int) -> Path:
    """Writes the averaged weights in half precision, with a summary of the training in the header.

    Args:
        training: training whose average to write.
        path: output safetensors file.
        config: configuration of the training.
        rooms: number of Infinigen rooms among its scenes.

    Returns:
        ``path``.
    """
    state = training.averaged.module.state_dict()
    tensors = {name: value.detach().half().contiguous() for name, value in sorted(state.items())}
    made_of = {
        "steps": str(training.global_step),
        "scenes": f"{config.scenes.count} from seed {config.scenes.first_seed}, {rooms} Infinigen rooms",
        "seed": str(config.seed),
        "begun_with": Path(config.begin).name if config.begin else "random weights",
        "core_hours": f"{training.core_seconds / 3600:.2f}",
        "device": torch.cuda.get_device_name() if config.accelerator == "gpu" else "cpu",
    }
    write_bytes(path, save(tensors, metadata=made_of))
    return path
