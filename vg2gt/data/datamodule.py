"""Scenes in, batches out: training steps and evaluation samples as Lightning takes them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from vg2gt.data.base import DataError, SceneSource, SourceMaker, training_frames
from vg2gt.data.evaluation_views import EvaluationViews
from vg2gt.data.frame_cache import FrameCache
from vg2gt.data.sampling import SceneViews, StepSampler, ViewSampler, usable_scenes
from vg2gt.types import Batch, Cameras

log = logging.getLogger(__name__)


class BatchDataset(Dataset[Batch]):
    """Turns the views of a step into a batch; indexed by what ``StepSampler`` yields.

    Args:
        source: the scenes.
        image_size: ``(height, width)`` of the batches.
        memory_mb: decoded frames kept in memory, in each process.
    """

    def __init__(self, source: SceneSource, image_size: tuple[int, int], memory_mb: int) -> None:
        self.source = source
        self.cache = FrameCache(source, image_size, memory_mb * 2**20)

    def __getitem__(self, views: tuple[SceneViews, ...]) -> Batch:
        scenes = [self.cache.load(view.scene, (*view.context, *view.target)) for view in views]

        def stack(name: str) -> torch.Tensor:
            return torch.stack([getattr(scene, name) for scene in scenes])

        depth = stack("depth")
        return Batch(
            images=stack("images"),
            depth=depth,
            cameras=Cameras(stack("world_to_camera"), stack("intrinsics"), (depth.shape[-2], depth.shape[-1])),
            is_metric=torch.tensor([self.source.scene_is_metric(view.scene) for view in views]),
            frame_ids=torch.tensor([(*view.context, *view.target) for view in views], dtype=torch.int64),
            scene=tuple(view.scene for view in views),
            num_context=len(views[0].context),
        )


class SceneDataModule(LightningDataModule):
    """Training and evaluation batches from any two scene sources.

    A training batch depends on the seed and on the number of the step alone, so a resumed run sees what the
    uninterrupted one would have seen, with any number of workers.

    Args:
        train: training scenes, or what makes them (``_partial_: true``): then called with ``common``.
        val: evaluation scenes, likewise.
        image_size: ``(height, width)`` of every image, best a multiple of the backbone's patch size; frames are resized
            until they cover it and cropped at the centre.
        train_scenes: use at most this many training scenes; None: all.
        eval_scenes: use at most this many evaluation scenes; None: all.
        min_views: fewest context views of a training step.
        max_views: most context views of a training step.
        max_images: context images of a step on one device; a step with N views holds ``max_images // N`` scenes.
        expand_ratio: the N views are drawn from a window of ``expand_ratio * N`` frames.
        target_views: held-out views added to every training scene.
        eval_context: positions, or number, of the evaluation's input views (``EvaluationViews``).
        eval_target: positions, or number, of the evaluation's held-out views.
        eval_window: evaluate long scenes in stretches of this many frames; None: whole.
        steps_per_epoch: training steps in an epoch.
        seed: seeds the choice of scenes and views.
        workers: loader processes; 0 decodes in the training process.
        memory_mb: decoded frames kept in memory by each process.
        common: arguments that ``train`` and ``val`` share, such as the dataset's ``root``.
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
        eval_context: int | Sequence[int] = 8,
        eval_target: int | Sequence[int] = 3,
        eval_window: int | None = None,
        steps_per_epoch: int = 1000,
        seed: int = 0,
        workers: int = 0,
        memory_mb: int = 1024,
        **common: Any,
    ) -> None:
        super().__init__()
        self.sampler = ViewSampler(min_views, max_views, max_images, expand_ratio, target_views, seed)
        self.eval_views = EvaluationViews(eval_context, eval_target, eval_window)
        self.image_size = (int(image_size[0]), int(image_size[1]))
        self.common = common
        self.train_scenes = train_scenes
        self.eval_scenes = eval_scenes
        self.steps_per_epoch = steps_per_epoch
        self.workers = workers
        self.memory_mb = memory_mb
        self._make_train = train
        self._make_val = val
        self._train: BatchDataset | None = None
        self._val: BatchDataset | None = None

    def setup(self, stage: str | None = None) -> None:
        """Indexes the scenes and refuses evaluation targets that training would see.

        Raises:
            DataError: if the data is missing, unusable, or shared by training and evaluation.
        """
        if self._train is not None and self._val is not None:
            return
        train, val = self._source(self._make_train), self._source(self._make_val)
        self._train_names = usable_scenes(train, self.sampler, self.train_scenes)
        names = list(val.scenes)[: self.eval_scenes]
        self._val_views = [views for name in names for views in self.eval_views.choose(val, name)]
        refuse_overlap(train, self._train_names, self._val_views)
        self._train = BatchDataset(train, self.image_size, self.memory_mb)
        self._val = BatchDataset(val, self.image_size, self.memory_mb)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Batches from the trainer's current step on; one item of the loader is one batch.

        Raises:
            DataError: if the training scenes have no depth or no cameras.
        """
        self.setup()
        assert self._train is not None
        refuse_untrainable(self._train.source)
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
        """One batch (B = 1) a sample: context views, then held-out target views. The same on every device."""
        self.setup()
        assert self._val is not None
        return self._loader(self._val, [(views,) for views in self._val_views])

    def test_dataloader(self) -> DataLoader[Batch]:
        """The evaluation batches."""
        return self.val_dataloader()

    def _source(self, make: SceneSource | SourceMaker) -> SceneSource:
        return make if isinstance(make, SceneSource) else make(**self.common)

    def _loader(self, dataset: BatchDataset, sampler: object) -> DataLoader[Batch]:
        return DataLoader(
            dataset,
            batch_size=None,  # the sampler's items are whole batches
            sampler=sampler,  # pyright: ignore[reportArgumentType]
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
        )


def refuse_untrainable(source: SceneSource) -> None:
    """Refuses to train on scenes without depth or cameras, which the losses compare with.

    Raises:
        DataError: saying what the source lacks.
    """
    lacking = [name for name, there in (("depth", source.has_depth), ("cameras", source.has_cameras)) if not there]
    if lacking:
        raise DataError(
            f"{type(source).__name__} has no {' and no '.join(lacking)}: it serves reconstruction and cannot be "
            "trained on; choose another dataset for data.train, or the loader's depth option"
        )


def refuse_overlap(train: SceneSource, scenes: Sequence[str], evaluation: Sequence[SceneViews]) -> None:
    """Refuses evaluation targets that are training frames.

    Scenes should differ altogether. Where one recording serves both ends, its targets must be frames held out of
    training, which is said in the log.

    Raises:
        DataError: naming the first scene whose targets, or whole scene without targets, training would see.
    """
    names = set(scenes)
    shared = sorted({views.scene for views in evaluation} & names)
    for views in evaluation:
        if views.scene not in names:
            continue
        seen = set(training_frames(train, views.scene)) & set(views.target or views.context)
        if seen:
            raise DataError(
                f"scene {views.scene} is used for training and for evaluation: {len(seen)} of its evaluation frames "
                "are trained on; give disjoint scenes (data.train..., data.val...) or hold frames out of training"
            )
    if shared:
        log.info("%d scenes serve training and evaluation; scored are frames held out of training", len(shared))
