"""Scenarios on two or more processes, several after one another on the same ones."""

import functools
import os
import signal
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import CompletedProcess, TimeoutExpired
from typing import Any
from unittest.mock import patch

import lightning
import torch
from lightning.fabric.utilities.rank_zero import rank_zero_only
from omegaconf import open_dict
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from tests.commands import ROOT, become, warm_process
from tests.reliability.degenerate import SCENES, beside
from tests.reliability.steps import TINY, first_batches, fit, tiny_run
from tests.training_helpers import small_config
from vg2gt.data import DataError
from vg2gt.data.batches import BatchDataset
from vg2gt.data.views.sampling import StepSampler
from vg2gt.training.distributed import ending_together
from vg2gt.training.loop import Run, evaluate, train

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


PROVEN = {"frozen": ["backend=da3_tiny"], "trained": ["backend=da3_tiny", "backend.freeze=false"]}
VARYING = ["data.min_views=2", "data.max_views=4", "data.max_images=4", "data.train_scenes=6"]
ON_RANK_1 = ["unchanged", "no depth", "black images", "held-out view looks away", "unchanged", "one pixel with depth"]


class Steps(lightning.Callback):
    """Keeps the weights before every step, its loss, and its gradient after all ranks have averaged it.

    Args:
        given: weights to set before every step, so that a step's rounding does not reach the next; None: as trained.
    """

    def __init__(self, given: Sequence[Tensor] | None = None) -> None:
        self.given = given
        self.weights: list[Tensor] = []
        self.gradients: list[Tensor] = []
        self.losses: list[float] = []

    def on_train_batch_start(self, trainer: lightning.Trainer, pl_module: Any, *args: Any) -> None:
        parameters = pl_module.model.trained_parameters()
        if self.given is not None:
            vector_to_parameters(self.given[len(self.weights)].clone(), parameters)
        self.weights.append(parameters_to_vector(parameters).detach().clone())

    def on_before_optimizer_step(self, trainer: lightning.Trainer, pl_module: Any, optimizer: Any) -> None:
        self.gradients.append(torch.cat([p.grad.flatten().clone() for p in pl_module.model.trained_parameters()]))

    def on_train_batch_end(self, trainer: lightning.Trainer, *args: Any) -> None:
        self.losses.append(float(trainer.callback_metrics["loss"]))


def step_by_step(
    folder: Path, cache: Path, overrides: Sequence[str], ranks: Sequence[int], given: Sequence[Tensor] | None = None
) -> dict[str, Any]:
    """Trains on the batches that some of two ranks draw; those of rank 1 are changed by :data:`ON_RANK_1`."""
    run = tiny_run(folder, cache, "optimizer=adamw", *VARYING, *overrides)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # away from the zero convolutions
        for parameter in run.module.model.trained_parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=generator)
    run.datamodule.setup("fit")
    module: Any = run.datamodule
    data, scenes, views = module._train, module._train_names, module.sampler
    samplers = [StepSampler(data.source, scenes, views, 100, rank=rank, world_size=2) for rank in ranks]
    batches = []
    for step, change in enumerate(ON_RANK_1):
        of_ranks = [data[sampler.step(step)] for sampler in samplers]
        changed = [SCENES[change](batch) if rank else batch for rank, batch in zip(ranks, of_ranks, strict=True)]
        batches.append(functools.reduce(beside, changed))
    steps = Steps(given)
    run.trainer.callbacks.append(steps)  # pyright: ignore[reportAttributeAccessIssue]
    audit = fit(run, batches)
    assert not any(audit.skipped)
    views = [batch.num_context for batch in batches]
    return {"weights": steps.weights, "gradients": steps.gradients, "losses": steps.losses, "views": views}


class KilledAt(lightning.Callback):
    """Kills a rank in a step that no checkpoint follows."""

    def __init__(self, step: int, rank: int) -> None:
        self.step, self.rank = step, rank

    def on_train_batch_start(self, trainer: lightning.Trainer, *args: Any) -> None:
        if (trainer.global_step, trainer.global_rank) == (self.step, self.rank):
            os.kill(os.getpid(), signal.SIGKILL)


def whole_run(folder: Path, cache: Path, killed: bool = False) -> dict[str, Any]:
    """Trains six steps with a checkpoint after every second one, or goes on; rank 1 is killed in the fourth."""
    kept = [override for override in TINY if not override.startswith("callbacks.")]
    overrides = [*kept, *VARYING, *RANKS, "ckpt=auto", "trainer.max_steps=6", "backend=da3_tiny"]
    config = small_config(folder, cache, *overrides)
    if killed:
        with open_dict(config):
            config.callbacks.kill = {"_target_": f"{__name__}.KilledAt", "step": 3, "rank": 1}
    rank_zero_only.rank = own_rank()  # Lightning read it when it was imported, before this process had one
    return {"steps": train(config)["steps"]}


def three_scenes(folder: Path, cache: Path, *overrides: str) -> dict[str, Any]:
    """Evaluates three scenes, the second of them without depth."""
    run = tiny_run(folder, cache, "data.eval_scenes=3", *overrides)
    load = BatchDataset.__getitem__

    def without_depth(dataset: BatchDataset, views: Any) -> Any:
        batch = load(dataset, views)
        return SCENES["no depth"](batch) if views[0].scene.endswith("1") else batch

    with patch.object(BatchDataset, "__getitem__", without_depth):
        return evaluate(run)


WINDOWS = [
    "data.num_frames=60",
    "data.eval_scenes=10",
    "data.eval_window=2",
    "data.eval_context=1",
    "data.eval_target=1",
]


def windows(folder: Path, cache: Path, *overrides: str) -> dict[str, Any]:
    """Evaluates 300 windows of ten scenes."""
    return evaluate(tiny_run(folder, cache, *WINDOWS, *overrides))


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
    **{
        name: lambda folder, cache, more=more: step_by_step(folder, cache, [*RANKS, *more], [own_rank()])
        for name, more in PROVEN.items()
    },
    "whole": whole_run,
    "killed": lambda folder, cache: whole_run(folder.with_name("interrupted"), cache, killed=True),
    "resumed": lambda folder, cache: whole_run(folder.with_name("interrupted"), cache),
    "windows": lambda folder, cache: windows(folder, cache, *RANKS, f"trainer.devices={os.environ['WORLD_SIZE']}"),
}


def run_on_ranks(
    folder: Path, cache: Path, *names: str, ranks: int = 2, timeout: float = 900
) -> list[CompletedProcess[str]]:
    """Runs scenarios after one another; their results are ``FOLDER/<name>-<rank>.pt``, errors end a rank."""
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "NODE_RANK": "0", "WORLD_SIZE": str(ranks)}
    said = [folder / f"said-{rank}.txt" for rank in range(ranks)]
    processes = [
        warm_process(_run_rank, folder, cache, names, path, address | {"LOCAL_RANK": str(rank)})
        for rank, path in enumerate(said)
    ]
    end = time.monotonic() + timeout
    try:
        for process in processes:
            process.join(max(0, end - time.monotonic()))
        codes = [process.exitcode for process in processes]
    finally:
        for process in processes:
            process.kill()
    if None in codes:
        raise TimeoutExpired(names, timeout)
    return [CompletedProcess(names, code, stderr=path.read_text()) for code, path in zip(codes, said, strict=True)]


def _run_rank(folder: Path, cache: Path, names: Sequence[str], said: Path, environment: dict[str, str | None]) -> None:
    become(ROOT, [said], environment)
    for name in names:
        result = SCENARIOS[name](folder / name, cache)
        torch.save(result, folder / f"{name}-{environment['LOCAL_RANK']}.pt")


def own_rank() -> int:
    return int(os.environ["LOCAL_RANK"])


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
