"""Lightning data module: training and evaluation batches from scene sources."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from vg2gt.data.base import SceneSource, SourceMaker, made
from vg2gt.data.batches import BatchDataset
from vg2gt.data.overlap import refuse_overlap, refuse_untrainable
from vg2gt.data.transforms import resize_to_cover
from vg2gt.data.views.even import EvaluationViews, spread
from vg2gt.data.views.sampling import StepSampler, ViewSampler, usable_scenes
from vg2gt.types import Batch

_PIXEL_BYTES = 4 * (3 + 1 + 1)  # float32 colour, depth and the mask of some datasets

MOST = 16  # worker limit: more would wait for the disk
_PREFETCHED = 2  # batches prefetched by each worker: torch's default
_PROCESS_MB = 600  # memory of a worker without its decoded frames
_SHARED_MEMORY = Path("/dev/shm")  # workers pass batches to the trainer through it


class SceneDataModule(LightningDataModule):
    """Training and evaluation batches from two scene sources.

    A training batch depends only on the seed and the step number. A resumed run therefore sees the same batches as an
    uninterrupted one, with any number of workers.

    Args:
        train: training scenes, or a factory (``_partial_: true``), which is called with ``common``.
        val: evaluation scenes, or a factory.
        image_size: ``(height, width)`` that frames are resized to cover and cropped to, preferably multiples of the
            backbone's patch size.
        train_scenes: use at most this many training scenes; None: all.
        eval_scenes: use at most this many evaluation scenes; None: all.
        min_views: minimum number of context views in a training step.
        max_views: maximum number of context views in a training step.
        max_images: context images per step and device; a step with N views holds ``max_images // N`` scenes.
        expand_ratio: the N views are drawn from a window of ``expand_ratio * N`` frames.
        target_views: number of held-out views added to every training scene.
        view_sets: number of fixed view draws per scene; None: new draws at every step.
        eval_context: positions or number of the evaluation's input views (``EvaluationViews``).
        eval_target: positions or number of the evaluation's held-out views.
        eval_window: evaluate long scenes in stretches of this many frames; None: the whole scene at once.
        eval_samples: evaluate at most this many scenes or stretches, spread evenly over all, in total and not per
            device, so that metrics do not depend on the number of devices; None: all.
        steps_per_epoch: training steps per epoch.
        seed: seeds the sampling of scenes and views.
        workers: loader processes; 0 decodes in the training process; None: as many as cores and memory allow when
            training on a GPU, else 0.
        memory_mb: size of the cache of decoded frames in each process, in MB.
        common: arguments shared by ``train`` and ``val``, such as the dataset's ``root``.

    Raises:
        ValueError: if an option is out of range.
    """

    def __init__(
        self,
        train: SceneSource | SourceMaker,
        val: SceneSource | SourceMaker,
        image_size: Sequence[int] = (224, 448),
        train_scenes: int | None = None,
        eval_scenes: int | None = None,
        min_views: int = 3,
        max_views: int = 18,
        max_images: int = 18,
        expand_ratio: float = 2.0,
        target_views: int = 0,
        view_sets: int | None = None,
        eval_context: int | Sequence[int] = 8,
        eval_target: int | Sequence[int] = 3,
        eval_window: int | None = None,
        eval_samples: int | None = None,
        steps_per_epoch: int = 1000,
        seed: int = 0,
        workers: int | None = None,
        memory_mb: int = 1024,
        **common: Any,
    ) -> None:
        super().__init__()
        limits = {"train_scenes": (train_scenes, 1), "eval_scenes": (eval_scenes, 1), "workers": (workers, 0)}
        limits |= {"eval_samples": (eval_samples, 1), "memory_mb": (memory_mb, 0)}
        for name, (value, least) in limits.items():
            if value is not None and value < least:
                raise ValueError(f"data.{name}={value} must be at least {least}")
        self.sampler = ViewSampler(min_views, max_views, max_images, expand_ratio, target_views, seed, view_sets)
        self.eval_views = EvaluationViews(eval_context, eval_target, eval_window)
        self.image_size = _size(image_size)
        self.prepare = partial(resize_to_cover, size=self.image_size)
        self.common = common
        self.train_scenes = train_scenes
        self.eval_scenes = eval_scenes
        self.eval_samples = eval_samples
        self.steps_per_epoch = steps_per_epoch
        self.workers = workers
        self.memory_mb = memory_mb
        self._make_train = train
        self._make_val = val
        self._train: BatchDataset | None = None
        self._val: BatchDataset | None = None

    def setup(self, stage: str | None = None) -> None:
        """Indexes the scenes and checks that training never sees the evaluation targets.

        Training scenes that are unreadable or too short are skipped with a warning. For an evaluation scene this is an
        error, because metrics must not change silently.

        Raises:
            DataError: if data is missing, unusable, or shared by training and evaluation, or if the training scenes
                have no cameras.
        """
        if self._train is not None and self._val is not None:
            return
        train, val = self.train_source(), self.val_source()
        refuse_untrainable(train)
        self._train_names = usable_scenes(train, self.sampler, self.train_scenes)
        names = list(val.scenes)[: self.eval_scenes]
        samples = [views for name in names for views in self.eval_views.choose(val, name)]
        self._val_views = samples if self.eval_samples is None else spread(samples, self.eval_samples)
        refuse_overlap(train, self._train_names, val, self._val_views)
        self._train = BatchDataset(train, self.prepare, self.memory_mb, replace_damaged=True)
        self._val = BatchDataset(val, self.prepare, self.memory_mb)

    @property
    def sources(self) -> tuple[SceneSource, SceneSource]:
        """The training and the evaluation source, after ``setup``."""
        self.setup()
        assert self._train is not None
        assert self._val is not None
        return self._train.source, self._val.source

    def train_source(self) -> SceneSource:
        """Returns the training source, without checks or limits."""
        return made(self._make_train, self.common)

    def val_source(self) -> SceneSource:
        """Returns the evaluation source, without checks or limits."""
        return made(self._make_val, self.common)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Returns batches from the trainer's current step on; one item of the loader is one batch."""
        self.setup()
        assert self._train is not None
        trainer = self.trainer
        sampler = StepSampler(
            self._train.source,
            self._train_names,
            self.sampler,
            self.steps_per_epoch,
            start_step=lambda: trainer.global_step if trainer else 0,
            rank=trainer.global_rank if trainer else 0,
            world_size=trainer.world_size if trainer else 1,
        )
        return self._loader(self._train, sampler)

    def val_dataloader(self) -> DataLoader[Batch]:
        """Returns one batch (B = 1) per sample: context views first, then held-out target views.

        Samples are distributed over the devices in turn. A device without a sample repeats the first one, because
        every device must take part in the evaluation.
        """
        self.setup()
        assert self._val is not None
        trainer = self.trainer
        own = self._val_views[trainer.global_rank :: trainer.world_size] if trainer else self._val_views
        return self._loader(self._val, [(views,) for views in own or self._val_views[:1]])

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Copies a batch to the device, asynchronously from pinned memory on CUDA."""
        return batch.to(device, non_blocking=device.type == "cuda")

    def evaluation_data(self) -> BatchDataset:
        """Returns the evaluation scenes as a dataset that is indexed by tuples of ``SceneSample``, for any views."""
        return BatchDataset(made(self._make_val, self.common), self.prepare, self.memory_mb)

    @property
    def loader_processes(self) -> int:
        """Number of loader processes of this rank; resolves ``workers=None``."""
        trainer = self.trainer
        if self.workers is not None:
            return self.workers
        if trainer is None or trainer.strategy.root_device.type != "cuda":
            return 0  # the cores are busy with training
        height, width = self.image_size
        views = self.sampler.max_images * (1 + self.sampler.target_views / self.sampler.min_views)
        return automatic_workers(trainer.num_devices, self.memory_mb, views * height * width * _PIXEL_BYTES / 1e6)

    def _loader(self, dataset: BatchDataset, sampler: object) -> DataLoader[Batch]:
        trainer, workers = self.trainer, self.loader_processes
        return DataLoader(
            dataset,
            batch_size=None,  # the sampler's items are whole batches
            sampler=sampler,  # pyright: ignore[reportArgumentType]
            num_workers=workers,
            persistent_workers=workers > 0,
            worker_init_fn=_leave_interrupts_to_the_trainer,
            pin_memory=trainer is not None and trainer.strategy.root_device.type == "cuda",
        )


def _size(image_size: Sequence[int]) -> tuple[int, int]:
    pair = isinstance(image_size, Sequence) and len(image_size) == 2
    if not (pair and all(isinstance(side, int) and side > 0 for side in image_size)):
        raise ValueError(f"data.image_size must be [height, width] in pixels, got {image_size}")
    return image_size[0], image_size[1]


def _leave_interrupts_to_the_trainer(worker: int) -> None:
    """Ignores Ctrl-C in a worker, so that the trainer can finish its step while the workers keep loading."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def automatic_workers(ranks: int, memory_mb: int, batch_mb: float) -> int:
    """Returns the number of loader processes per rank: one per core except one, limited by memory.

    Args:
        ranks: training processes on this machine.
        memory_mb: size of the frame cache of each loader process, in MB.
        batch_mb: size of a batch in MB.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limits = [MOST, cores // ranks - 1]
    if hasattr(os, "sysconf"):
        half = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2e6
        limits.append(int(half / ranks / (memory_mb + _PROCESS_MB + _PREFETCHED * batch_mb)))
    if _SHARED_MEMORY.is_dir():  # small in containers; a process that exceeds it dies with a bus error
        free = shutil.disk_usage(_SHARED_MEMORY).free / 1e6
        limits.append(int(free / ranks / (2 * _PREFETCHED * batch_mb)))  # half each for training and evaluation
    return max(0, min(limits))
