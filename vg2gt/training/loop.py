"""A training run: build from the configuration, evaluate the untrained head, train, evaluate, report."""

from __future__ import annotations

import logging
import math
import os
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
from hydra.utils import instantiate
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.fabric.utilities.rank_zero import rank_zero_only
from lightning.pytorch import LightningDataModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from omegaconf import DictConfig

from backends.cache import TokenCache
from vg2gt.data.datamodule import SceneDataModule
from vg2gt.evaluation.checks import refuse_without_hints
from vg2gt.evaluation.pictures import PANELS
from vg2gt.geometry.precision import trainer_precision
from vg2gt.io.files import read_json, write_json, write_text
from vg2gt.memory import TRAINING, memory_advice
from vg2gt.runs.checkpoints import newest
from vg2gt.runs.load import made_of
from vg2gt.runs.lock import only_process_in
from vg2gt.training.checkpointing import AtomicCheckpointIO
from vg2gt.training.distributed import ending_together
from vg2gt.training.module import VG2GTModule
from vg2gt.training.report import comparison_table, write_preview
from vg2gt.training.start import checkpoint_to_resume, load_start, prepare_folder

log = logging.getLogger(__name__)

_EXPECTED_WARNINGS = (
    r"Found \d+ module\(s\) in eval mode",  # the frozen backbone
    r"You're resuming from a checkpoint that ended before the epoch",  # batches are a function of the step number
    r"It is recommended to use `self.log\('eval/",  # all ranks log the same values
    r".*isinstance\(treespec, LeafSpec\)",  # internal to Lightning
    r"Checkpoint directory .* exists and is not empty",  # expected when a run resumes
)

_FEW_WORKERS = r"The '\w+_dataloader' does not have many workers"  # expected on a CPU, whose cores are busy training

# Tensor sizes vary from step to step, which would fragment GPU memory. Read when CUDA initialises.
ALLOCATOR = (f"PYTORCH_{'' if torch.__version__ >= '2.9' else 'CUDA_'}ALLOC_CONF", "expandable_segments:True")

_TRAINER = {
    "max_epochs": -1,  # the number of steps ends a training
    "check_val_every_n_epoch": None,  # val_check_interval counts steps
    "num_sanity_val_steps": 0,
    "enable_model_summary": False,
    "log_every_n_steps": 10,
    "use_distributed_sampler": False,  # our sampler gives each rank its own scenes
}
"""Lightning's options that follow from how we train; ``+trainer.KEY=VALUE`` changes them."""

_PRECISIONS = ("auto", "32-true", "bf16-mixed", "32", "bf16")  # the last two are Lightning's short names


@dataclass(frozen=True)
class Run:
    """A training run, built from its configuration.

    Attributes:
        module: model, loss, renderer and optimiser.
        datamodule: training and evaluation scenes.
        trainer: Lightning's trainer.
        folder: output folder of the run, ``outputs/<name>``.
    """

    module: VG2GTModule
    datamodule: LightningDataModule
    trainer: Trainer
    folder: Path

    @property
    def trial(self) -> bool:
        """Whether this is a ``fast_dev_run``, which writes no reports and no checkpoints."""
        return bool(getattr(self.trainer, "fast_dev_run", False))


def build(config: DictConfig) -> Run:
    """Instantiates the module, data and trainer of a configuration; each constructor is the schema of its section."""
    _check(config)
    lightning.seed_everything(config.seed, workers=True, verbose=False)
    accelerator = _accelerator(config.trainer.accelerator)
    if accelerator == "gpu":
        os.environ.setdefault(*ALLOCATOR)
    for message in _EXPECTED_WARNINGS if accelerator == "gpu" else (*_EXPECTED_WARNINGS, _FEW_WORKERS):
        warnings.filterwarnings("ignore", message=message)
    _quieten_lightning()
    datamodule = instantiate(config.data)
    backend = instantiate(config.backend)
    model = instantiate(config.model, backend=backend)
    if config.token_cache.max_gb:
        model.token_cache = TokenCache(**config.token_cache)
    module = VG2GTModule(
        model=model,
        loss=instantiate(config.loss),
        renderer=instantiate(config.renderer),
        optimizer=_optimizer(config.optimizer),
        **config.training,
        seed=config.seed,
    )
    module.made_of = made_of(config)
    trainer = instantiate(
        config.trainer,
        **{key: value for key, value in _TRAINER.items() if key not in config.trainer},
        accelerator=accelerator,
        precision=trainer_precision(str(config.trainer.precision), accelerator),
        callbacks=_callbacks(config),
        logger=[instantiate(logger) for logger in config.logger.values() if logger],
        plugins=_plugins(),
        default_root_dir=config.output_dir,
    )
    return Run(module, datamodule, trainer, Path(config.output_dir))


def _plugins() -> list[Any]:
    """Our checkpoints; and in a SLURM job its tasks, without Lightning's requeueing, as the job's script requeues."""
    slurm = SLURMEnvironment.detect() and not TorchElasticEnvironment.detect()
    return [AtomicCheckpointIO(), *([SLURMEnvironment(auto_requeue=False)] if slurm else [])]


def _quieten_lightning() -> None:
    """Limits Lightning's log to warnings, and shows them once only."""
    logger = logging.getLogger("lightning.pytorch")
    logger.setLevel(logging.WARNING)
    if logging.getLogger().handlers:
        logger.handlers.clear()


def _optimizer(config: DictConfig) -> Callable[..., torch.optim.Optimizer]:
    """Instantiates the optimiser's partial and tries it, as Lightning would only call it after the first evaluation."""
    make = instantiate(config)
    try:
        rate = make([torch.nn.Parameter(torch.zeros(1))]).param_groups[0]["lr"]
    except ValueError as error:
        raise ValueError(f"optimizer: {error}") from error
    if not 0 < rate < math.inf:
        raise ValueError(f"optimizer.lr={rate} must be a positive number; vg2gt evaluate works without training")
    return make


def _callbacks(config: DictConfig) -> list[lightning.Callback]:
    """The configured callbacks; ``trainer.enable_progress_bar=false`` leaves progress bars out."""
    callbacks = [instantiate(callback) for callback in config.callbacks.values() if callback]
    return [c for c in callbacks if config.trainer.get("enable_progress_bar", True) or not isinstance(c, ProgressBar)]


def _accelerator(asked: str) -> str:
    """Resolves ``auto`` to CUDA or the CPU; raises ValueError for Apple's MPS."""
    if asked == "mps":
        raise ValueError("trainer.accelerator=mps: MPS has no float64, which the geometry needs; use trainer=cpu")
    return asked if asked != "auto" else "gpu" if torch.cuda.is_available() else "cpu"


def _check(config: DictConfig) -> None:
    """Raises ValueError for options of the trainer and the loss that would silently mean something else."""
    trainer = config.trainer
    if str(trainer.precision) not in _PRECISIONS:
        raise ValueError(
            f"trainer.precision={trainer.precision} is not supported: geometry, voxels, rendering and losses require "
            "float32 (half precision is too coarse, float64 brings no gain); use bf16-mixed (networks in bfloat16), "
            "32-true, or auto (bf16-mixed on a GPU, 32-true on a CPU)"
        )
    if trainer.get("accumulate_grad_batches", 1) != 1:
        raise ValueError(
            "trainer.accumulate_grad_batches is not supported: batches, random draws and checkpoints are determined by "
            "the optimiser step. Raise data.max_images, or take more and smaller steps (docs/guides/cluster.md)"
        )
    limit = trainer.get("limit_val_batches")
    if limit and not (isinstance(limit, float) and limit == 1):
        raise ValueError(
            f"trainer.limit_val_batches={limit} counts per device, so that metrics would depend on the number of "
            "devices: use data.eval_samples, which counts all scenes or windows"
        )
    if trainer.get("gradient_clip_algorithm") not in (None, "norm"):
        raise ValueError(
            f"trainer.gradient_clip_algorithm={trainer.gradient_clip_algorithm} is not supported; use norm"
        )
    for section, value in config.loss.items():
        if value is None and str(config.loss.get("_target_")).endswith(".VG2GTLoss"):  # the defaults of its class
            raise ValueError(f"loss.{section}=null does not turn anything off: set the weights in loss.{section} to 0")


@memory_advice(TRAINING)
def train(config: DictConfig) -> dict[str, Any]:
    """Trains and evaluates a model as configured.

    Writes into ``outputs/<name>``: the resolved configuration, checkpoints, ``metrics.json``, ``metrics.md`` and
    ``preview.png``. If the start is refused, the folder is left unchanged. A ``fast_dev_run`` writes nothing.

    Returns:
        The content of ``metrics.json``; empty if training was stopped early.

    Raises:
        BlockingIOError: if another process uses the folder.
        FileExistsError: if the folder holds a run and neither ``ckpt`` nor ``overwrite`` says what to do with it.
        FileNotFoundError: if ``ckpt`` names no checkpoint.
        ValueError: if the model has no trained part, or the checkpoint is beyond ``trainer.max_steps``.
        OutOfMemory: if device memory runs out; names the sizes and the options that reduce them.
    """
    writes = rank_zero_only.rank == 0 and not config.trainer.get("fast_dev_run")
    with only_process_in(config.output_dir) if writes else nullcontext():
        checkpoint = checkpoint_to_resume(config)
        run = build(config)
        _check_run(run)
        load_start(run.module, config, checkpoint)
        if writes:
            prepare_folder(config, checkpoint)
            log.info("run folder: %s; device: %s", run.folder, run.trainer.strategy.root_device)
        with ending_together(run.trainer):
            untrained = _untrained_metrics(run, resumed=checkpoint is not None)
            if not fit(run, checkpoint):
                return {}
            log.info("evaluating the trained model")
            return report(run, untrained, evaluate(run))


def _check_run(run: Run) -> None:
    """Checks a run before training.

    Raises:
        DataError: if the data cannot be used, or lacks the depth or cameras that the backend needs.
        ValueError: if the model has no trained part.
    """
    if isinstance(run.datamodule, SceneDataModule):
        run.datamodule.setup("fit")
        for source in run.datamodule.sources:
            refuse_without_hints(run.module.model, source)
    if not run.module.model.trained_parameters():
        raise ValueError(
            f"{type(run.module.model).__name__} has no trained part: evaluate it with vg2gt evaluate, or choose "
            "another model="
        )


def fit(run: Run, checkpoint: Path | None) -> bool:
    """Trains from scratch or from a checkpoint and saves the final weights; returns False if stopped early."""
    trainer = run.trainer
    trainer.fit(run.module, datamodule=run.datamodule, ckpt_path=checkpoint, weights_only=True)
    last = run.folder / "checkpoints" / f"step-{trainer.global_step}.ckpt"
    # Rank 0 decides for all ranks: saving is collective and creates the file.
    if trainer.strategy.broadcast(not run.trial and not last.is_file()):
        trainer.save_checkpoint(last)
    if not trainer.should_stop and (run.trial or trainer.global_step >= trainer.max_steps):
        return True
    log.warning("training ended at step %d of %d, without an evaluation", trainer.global_step, trainer.max_steps)
    return False


def evaluate(run: Run) -> dict[str, float]:
    """Evaluates the current model on the evaluation scenes; returns means over scenes."""
    results = run.trainer.validate(run.module, datamodule=run.datamodule, verbose=False)
    return {key.removeprefix("eval/"): float(value) for key, value in results[0].items()} if results else {}


def _untrained_metrics(run: Run, resumed: bool) -> dict[str, float]:
    """Metrics of the untrained head: measured once, and read from the run's folder when it resumes."""
    path = run.folder / "untrained.json"
    if resumed and path.is_file():
        return read_json(path)
    if resumed or run.trial:
        return {}
    log.info("evaluating the untrained model first, for comparison (progress bar: Validation)")
    metrics = evaluate(run)
    write_json(path, metrics)
    return metrics


def report(run: Run, untrained: dict[str, float], trained: dict[str, float]) -> dict[str, Any]:
    """Writes and prints the results; returns the content of ``metrics.json``."""
    content = {
        "untrained": untrained,
        "trained": trained,
        "steps": run.trainer.global_step,
        "skipped_steps": run.module.skipped.state_dict(),
    }
    if run.trainer.is_global_zero and not run.trial:
        write_json(run.folder / "metrics.json", content)
        table = comparison_table(untrained, trained)
        write_text(run.folder / "metrics.md", table)
        print(table)
        run.module.to(run.trainer.strategy.root_device)  # the strategy's teardown moved it to the CPU
        preview = write_preview(run.module, run.datamodule, run.folder / "preview.png")
        print(f"preview ({PANELS}): {preview}")
        print(f"checkpoint: {newest(run.folder / 'checkpoints')}")
        print(f"metrics: {run.folder / 'metrics.json'}")
        print(f"curves: {', '.join(str(logger.log_dir or logger.save_dir) for logger in run.trainer.loggers)}")
    return content
