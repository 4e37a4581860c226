"""Scenarios on two processes, several after one another on the same two."""

import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import CompletedProcess, TimeoutExpired
from typing import Any
from unittest.mock import patch

import lightning
import torch
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from tests.commands import ROOT, become, warm_process
from tests.reliability.degenerate import SCENES
from tests.reliability.steps import first_batches, fit, tiny_run
from vg2gt.data import DataError
from vg2gt.data.batches import BatchDataset
from vg2gt.training.distributed import ending_together
from vg2gt.training.loop import Run, evaluate

RANKS = ["trainer=ddp", "trainer.accelerator=cpu"]
SGD = ["optimizer=adamw", "optimizer._target_=torch.optim.SGD", "~optimizer.betas", "optimizer.lr=0.05"]
ADAMW = ["optimizer=adamw"]
BLIND = ["no depth", "one pixel with depth", "held-out view looks away"]
EMPTY = [*BLIND, "black images", "one view", "10 km, depth alone"]


class Curve(lightning.Callback):
    """Keeps the logged loss of every step, and what DDP averages."""

    def __init__(self) -> None:
        self.losses: list[float] = []
        self.averaged = 0

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        self.losses.append(float(trainer.callback_metrics["loss"]))
        if isinstance(trainer.strategy.model, DistributedDataParallel):
            reducer = trainer.strategy.model.reducer
            self.averaged = sum(bucket.buffer().numel() for bucket in reducer._get_zeros_like_grad_buckets())


def trained(run: Run) -> dict[str, Any]:
    """Trains a run to its end; its loss curve, final weights and number of averaged elements."""
    curve = Curve()
    run.trainer.callbacks.append(curve)  # pyright: ignore[reportAttributeAccessIssue]
    run.trainer.fit(run.module, datamodule=run.datamodule)
    return {"losses": curve.losses, "weights": weights(run), "averaged": curve.averaged}


def weights(run: Run) -> Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in run.module.model.trained_parameters()])


def step_overrides(optimizer: Sequence[str], steps: int, scenes: int) -> list[str]:
    """A run of ``scenes`` scenes a step and device."""
    return [*optimizer, f"trainer.max_steps={steps}", f"data.max_images={2 * scenes}", "data.train_scenes=6"]


def equal_steps(folder: Path, cache: Path, optimizer: Sequence[str], steps: int) -> dict[str, Any]:
    return trained(tiny_run(folder, cache, *RANKS, *step_overrides(optimizer, steps, scenes=1)))


def empty_rank(folder: Path, cache: Path) -> dict[str, Any]:
    """Rank 1 gets scenes without depth, views or anything to see, rank 0 good ones; views and voxels differ."""
    run = tiny_run(folder, cache, *RANKS, "data.train_scenes=3")
    batches = first_batches(run, 1) * len(EMPTY)
    if run.trainer.global_rank == 1:
        batches = [SCENES[name](batch) for name, batch in zip(EMPTY, batches, strict=True)]
    audit = fit(run, batches)
    audit.assert_sound()
    return {"weights": weights(run), "steps": run.trainer.global_step, "dropped": audit.skipped}


def faulty_rank(folder: Path, cache: Path) -> dict[str, Any]:
    """The second of three batches of rank 1 holds a value that is not a number."""
    run = tiny_run(folder, cache, *RANKS, "data.train_scenes=3")
    batches = first_batches(run, 3)
    if run.trainer.global_rank == 1:
        batches[1].images[0, 0] = float("nan")
    audit = fit(run, batches)
    audit.assert_sound()
    return {"weights": weights(run), "dropped": audit.skipped, "faults": run.module.skipped.state_dict()["faults"]}


def three_scenes(folder: Path, cache: Path, *overrides: str) -> dict[str, Any]:
    """Evaluates three scenes, the second of them without depth."""
    run = tiny_run(folder, cache, "data.eval_scenes=3", *overrides)
    load = BatchDataset.__getitem__

    def without_depth(dataset: BatchDataset, views: Any) -> Any:
        batch = load(dataset, views)
        return SCENES["no depth"](batch) if views[0].scene.endswith("1") else batch

    with patch.object(BatchDataset, "__getitem__", without_depth):
        return evaluate(run)


def one_scene(folder: Path, cache: Path, *overrides: str) -> dict[str, Any]:
    """Evaluates fewer scenes than there are ranks, in the middle of a training."""
    run = tiny_run(folder, cache, *overrides, "trainer.max_steps=2", "trainer.val_check_interval=1")
    run.trainer.fit(run.module, datamodule=run.datamodule)
    return {name: float(value) for name, value in run.trainer.callback_metrics.items() if name.startswith("eval/")}


def broken_loader(folder: Path, cache: Path) -> dict[str, Any]:
    """The second batch of rank 1 cannot be read."""
    run = tiny_run(folder, cache, *RANKS, "trainer.max_steps=4")
    load, calls = BatchDataset.__getitem__, []

    def fails(dataset: BatchDataset, views: Any) -> Any:
        calls.append(views)
        if run.trainer.global_rank == 1 and len(calls) == 2:
            raise DataError("this batch cannot be read")
        return load(dataset, views)

    with patch.object(BatchDataset, "__getitem__", fails), ending_together(run.trainer):
        run.trainer.fit(run.module, datamodule=run.datamodule)
    return {}


SCENARIOS: dict[str, Callable[[Path, Path], dict[str, Any]]] = {
    "sgd": lambda folder, cache: equal_steps(folder, cache, SGD, 4),
    "adamw_long": lambda folder, cache: equal_steps(folder, cache, ADAMW, 40),
    "muon_long": lambda folder, cache: equal_steps(folder, cache, (), 40),
    "empty_rank": empty_rank,
    "faulty_rank": faulty_rank,
    "three_scenes": lambda folder, cache: three_scenes(folder, cache, *RANKS),
    "one_scene": lambda folder, cache: one_scene(folder, cache, *RANKS),
    "broken_loader": broken_loader,
}


def run_on_two_ranks(folder: Path, cache: Path, *names: str, timeout: float = 900) -> list[CompletedProcess[str]]:
    """Runs scenarios after one another; their results are ``FOLDER/<name>-<rank>.pt``, errors end a rank."""
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "NODE_RANK": "0", "WORLD_SIZE": "2"}
    said = [folder / f"said-{rank}.txt" for rank in range(2)]
    ranks = [
        warm_process(_run_rank, folder, cache, names, path, address | {"LOCAL_RANK": str(rank)})
        for rank, path in enumerate(said)
    ]
    end = time.monotonic() + timeout
    try:
        for rank in ranks:
            rank.join(max(0, end - time.monotonic()))
        codes = [rank.exitcode for rank in ranks]
    finally:
        for rank in ranks:
            rank.kill()
    if None in codes:
        raise TimeoutExpired(names, timeout)
    return [CompletedProcess(names, code, stderr=path.read_text()) for code, path in zip(codes, said, strict=True)]


def _run_rank(folder: Path, cache: Path, names: Sequence[str], said: Path, environment: dict[str, str | None]) -> None:
    become(ROOT, [said], environment)
    for name in names:
        result = SCENARIOS[name](folder / name, cache)
        torch.save(result, folder / f"{name}-{environment['LOCAL_RANK']}.pt")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
