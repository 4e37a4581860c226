"""Shared code of the benchmarks: options, machine info, clock, a scene and a training step, result files."""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from datetime import date
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vg2gt.io.files import write_json
from vg2gt.profiling import now
from vg2gt.studies.study import compose_run
from vg2gt.training.loop import Run, build
from vg2gt.training.module import parameter_groups
from vg2gt.types import Batch

RESULTS = Path(__file__).resolve().parent / "results"
MEGABYTE = 1e6


def parser(doc: str | None, out: Path = RESULTS) -> argparse.ArgumentParser:
    """Returns a parser with the docstring of a script as help and ``--out``, the folder of results."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, default=out)
    return made


def dated(folder: Path, name: str) -> Path:
    """Returns today's result file for a name."""
    return folder / f"{date.today().isoformat()}-{name}.json"


def write_results(folder: Path, name: str, content: Mapping[str, Any]) -> Path:
    """Writes ``<date>-<name>.json``; prints and returns its path."""
    path = write_json(dated(folder, name), dict(content))
    print(path)
    return path


def machine() -> dict[str, Any]:
    """Returns processor, cores and versions, and the name of the GPU if torch can use one."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    found = {"processor": models[0] if models else platform.processor(), "cores": os.cpu_count()}
    found |= {"torch": torch.__version__, "python": platform.python_version()}
    return found | ({"gpu": torch.cuda.get_device_name()} if torch.cuda.is_available() else {})


def used_seconds(device: torch.device) -> float:
    """Returns CPU time of all cores, which other processes hardly affect; on a GPU, wall time after synchronising."""
    return now(device) if device.type == "cuda" else time.process_time()


def prepare(
    views: int, size: tuple[int, int], overrides: Sequence[str], device: torch.device, folder: Path
) -> tuple[Run, Batch]:
    """Builds a run and loads one scene, both on the device.

    Args:
        views: number of input views.
        size: image ``(height, width)``.
        overrides: Hydra overrides of ``train.yaml``.
        device: a GPU or a CPU.
        folder: folder of the run.
    """
    height, width = size
    accelerator = "gpu" if device.type == "cuda" else "cpu"
    scene = [f"data.image_size=[{height},{width}]", "data.eval_scenes=1", "data.train_scenes=1", "data.eval_target=1"]
    scene += [f"data.eval_context={views}", f"data.num_frames={views + 6}"]
    scene += [f"data.min_views={views}", f"data.max_views={views}", f"data.max_images={views}"]
    alone = [f"trainer.accelerator={accelerator}", "trainer.devices=1", "++trainer.strategy=auto"]
    run = build(compose_run([*alone, *scene, *overrides], folder))
    run.datamodule.setup("validate")
    run.module.to(device)
    return run, next(iter(run.datamodule.val_dataloader())).to(device)


def whole_step(
    run: Run, stage: Callable[[str], AbstractContextManager[Any]] = nullcontext
) -> Callable[[Batch], Tensor]:
    """Returns a training step from batch to loss, with backward pass, clipping and optimiser, but without logging.

    Args:
        run: the run.
        stage: marks the backward pass and the optimiser.
    """
    module = run.module.train()
    run.trainer.strategy.connect(module)
    module.trainer = run.trainer
    module.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    optimizer = module.make_optimizer(parameter_groups(module.model))

    def step(batch: Batch) -> Tensor:
        """Runs one training step; returns its loss."""
        with run.trainer.precision_plugin.train_step_context():
            loss = module.training_step(batch, 0)
        with stage("backward"):
            loss.backward()
        with stage("optimizer"):
            torch.nn.utils.clip_grad_norm_(module.model.trained_parameters(), 1.0)
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        return loss.detach()

    return step
