"""Calibrates a model's error bounds on the scenes of a data set."""

from __future__ import annotations

import logging
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from vg2gt.data.datamodule import SceneDataModule
from vg2gt.data.views.drawn import ViewSelection
from vg2gt.evaluation.checks import refuse_training_views, refuse_without_hints
from vg2gt.evaluation.run import view_counts
from vg2gt.evaluation.scene_metrics import pixels_with_errors
from vg2gt.geometry.pose_noise import with_pose_noise
from vg2gt.geometry.precision import half_precision_on_gpu
from vg2gt.runs.checkpoints import checkpoint_path
from vg2gt.runs.load import build_model, calibration_path, choose_device, load_weights, made_for, resolve_parts
from vg2gt.uncertainty import Samples, calibrate

log = logging.getLogger(__name__)

_SPREAD = 1.5  # N views are chosen from _SPREAD * N consecutive frames
_PIXELS = 10_000  # of a scene, at most


def make_calibration(config: DictConfig) -> Path:
    """Calibrates a model's error bounds on a data set and writes them to ``out``, by default next to the checkpoint.

    The scenes are divided evenly among the requested numbers of views.

    Raises:
        FileNotFoundError: if the checkpoint, its configuration or the data is missing.
        ValueError: if an option is wrong, the data has no dense depth, or there are too few scenes.
    """
    counts, checkpoint = view_counts(config.views), checkpoint_path(config.ckpt)
    if config.out is None and checkpoint is None:
        raise ValueError("without a checkpoint there is no place for the calibration: give out=FILE.json")
    selection = ViewSelection(targets=0, spread=_SPREAD)
    parts = resolve_parts(config, checkpoint)
    datamodule: SceneDataModule = instantiate(config.data)
    data = datamodule.evaluation_data()
    scenes = list(data.source.scenes)[: datamodule.eval_scenes]
    if not data.source.has_depth or not data.source.dense_depth:
        raise ValueError(f"{type(data.source).__name__} has no dense depth to calibrate on; choose other data=")
    chosen = [
        sample
        for place, count in enumerate(counts)
        for sample in selection.choose(data.source, scenes[place :: len(counts)], count)
    ]
    refuse_training_views(checkpoint, data.source, chosen)
    device = choose_device(config.device)
    model = build_model(parts, config.seed, device)
    refuse_without_hints(model, data.source)
    load_weights(model, checkpoint)
    found = []
    for number, sample in enumerate(chosen):
        batch = data[(sample,)].to(device)
        with torch.no_grad(), half_precision_on_gpu(batch.images):
            prediction = model(batch.images, with_pose_noise(batch, config.pose_noise))
        pixels = pixels_with_errors(prediction, prediction.supported, batch, model.backend.predicts_cameras, number)
        drawn = torch.randperm(len(pixels.error), generator=torch.Generator().manual_seed(number))
        found.append(pixels.select(drawn[:_PIXELS].sort().values))
        log.info("scene %d of %d: %s, %d views", number + 1, len(chosen), sample.scene, len(sample.context))
    path = Path(config.out) if config.out is not None else calibration_path(checkpoint)  # pyright: ignore
    made = calibrate(Samples.joined(found), made_for(model))
    made.write(path)
    print(f"{path}: from {made.scenes} scenes, {sum(len(each.error) for each in found)} pixels")
    return path
