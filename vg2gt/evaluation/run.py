"""Runs an evaluation, from its configuration to its report.

Results of single scenes are written as they are computed, so that an interrupted evaluation can resume.
"""

from __future__ import annotations

import logging
import shutil
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from vg2gt.config import flatten
from vg2gt.data.base import SceneSource
from vg2gt.data.batches import BatchDataset
from vg2gt.data.datamodule import SceneDataModule
from vg2gt.data.views import SceneSample
from vg2gt.evaluation import paper
from vg2gt.evaluation.checks import refuse_training_views, refuse_without_hints
from vg2gt.evaluation.evaluator import EvaluationOptions, SceneEvaluator
from vg2gt.evaluation.pictures import PANELS, scene_picture
from vg2gt.evaluation.sections import report_markdown
from vg2gt.io.files import read_json, write_json, write_text
from vg2gt.io.images import write_png
from vg2gt.memory import EVALUATION, memory_advice
from vg2gt.metrics import LPIPS, WeightsNotFoundError, load_lpips
from vg2gt.model import Reconstructor
from vg2gt.runs.checkpoints import checkpoint_path
from vg2gt.runs.load import TrainedWeights, build_model, choose_device, find_calibration, load_weights, resolve_parts
from vg2gt.runs.lock import only_process_in
from vg2gt.runs.pretrained import MODELS

log = logging.getLogger(__name__)

# Settings of samples, pictures and folders. All others affect the metrics and must be the same within a folder.
_NOT_COMPARED = (
    "views",
    "name",
    "output_dir",
    "overwrite",
    "ckpt",
    "device",
    "evaluation.pictures",
    "data.eval_scenes",
)
_NOT_COMPARED += ("data.workers", "data.memory_mb", "data.steps_per_epoch")
_REFINEMENT = ("refine.", "evaluation.refine")  # have no effect without refinement

IDENTITY = "identity.json"
_FOLDERS = ("scenes", "pictures")
_REPORTS = ("metrics.json", "metrics.md")
_WRITTEN = (*_FOLDERS, *_REPORTS, "config.yaml")


@memory_advice(EVALUATION)
def evaluate(config: DictConfig) -> dict[str, Any]:
    """Evaluates a model on the scenes of a data set, for each requested number of input views.

    Writes the resolved configuration, one file per finished scene, ``metrics.json``, ``metrics.md`` and pictures.
    Scenes already in the folder are not evaluated again.

    Returns:
        The content of ``metrics.json``: ``settings``, and ``views`` with ``mean`` and ``scenes`` per number of views.

    Raises:
        BlockingIOError: if another process uses the folder.
        FileExistsError: if the folder holds another evaluation.
        FileNotFoundError: if the checkpoint, its configuration or the data is missing.
        ValueError: if an option is wrong or the checkpoint does not fit.
    """
    folder = Path(config.output_dir)
    with only_process_in(folder):
        counts = view_counts(config.views)
        options: EvaluationOptions = instantiate(config.evaluation, _convert_="all")
        checkpoint = checkpoint_path(MODELS.get(config.ckpt, config.ckpt))
        parts = resolve_parts(config, checkpoint)
        datamodule: SceneDataModule = instantiate(config.data)
        data = datamodule.evaluation_data()
        scenes = list(data.source.scenes)[: datamodule.eval_scenes]
        samples = {count: options.selection.choose(data.source, scenes, count) for count in counts}
        refuse_training_views(checkpoint, data.source, [view for views in samples.values() for view in views])

        device = choose_device(config.device)
        model = build_model(parts, config.seed, device)
        refuse_without_hints(model, data.source)
        weights = load_weights(model, checkpoint)
        lpips, lpips_label = _lpips(options.lpips, device)
        resolved = OmegaConf.merge(OmegaConf.to_container(config, resolve=True), parts)
        calibration = find_calibration(model, weights)
        identity = _identity(resolved, weights, lpips is not None, model, device)
        if calibration is not None:
            identity["calibration.sha256"] = calibration.digest
        store = ResultStore(folder, identity, config.overwrite)
        write_text(folder / "config.yaml", OmegaConf.to_yaml(resolved, resolve=True))

        refinement = replace(instantiate(config.refine), steps=options.refine, seconds=None) if options.refine else None
        evaluator = SceneEvaluator(model, instantiate(parts["renderer"]), options, lpips, refinement, calibration)
        results = {count: _evaluate_all(evaluator, data, views, store, device) for count, views in samples.items()}
        settings = _settings(config, evaluator, weights, data.source, len(samples[counts[0]]))
        report = {
            "settings": settings | {"lpips": lpips_label, "device": str(device)},
            "views": {
                str(count): {"mean": mean_metrics(metrics), "scenes": dict(sorted(metrics.items()))}
                for count, metrics in results.items()
            },
        }
        write_json(folder / "metrics.json", report)
        text = report_markdown(report)
        write_text(folder / "metrics.md", text)
        print(text)
        if options.pictures:
            print(f"pictures ({PANELS}): {folder / 'pictures'}")
        print(f"metrics: {folder / 'metrics.json'}, {folder / 'metrics.md'}")
        return report


def mean_metrics(scenes: Mapping[str, Mapping[str, float | None]]) -> dict[str, float | None]:
    """Averages each metric over the scenes that have it.

    Times and memory use the lower median, because the first scene includes compilation.
    """
    names = dict.fromkeys(name for metrics in scenes.values() for name in metrics)
    means: dict[str, float | None] = {}
    for name in names:
        values = [value for metrics in scenes.values() if (value := metrics.get(name)) is not None]
        average = statistics.median_low if name.endswith(("_seconds", "_mib")) else statistics.fmean
        means[name] = average(values) if values else None
    return means


def view_counts(views: Any) -> list[int]:
    """Returns the requested numbers of input views, sorted and unique; ValueError if one is not a positive integer."""
    counts = list(views) if isinstance(views, Sequence) else [views]
    if not counts or not all(type(count) is int and count > 0 for count in counts):
        raise ValueError(f"views={views}: give numbers of input views, such as 'views=[3,10,20]'")
    return sorted(set(counts))


def _lpips(source: str | None, device: torch.device) -> tuple[LPIPS | None, str]:
    """The network and its description in the report; raises only if weights given by path are missing."""
    if source is None:
        return None, "n/a (evaluation.lpips=null)"
    try:
        return load_lpips(source).to(device), "VGG-16, version 0.1"
    except WeightsNotFoundError as error:
        if source not in ("auto", "download"):
            raise
        log.warning("LPIPS: %s", error)
        return None, f"n/a ({error})"


def _identity(
    config: Any, weights: TrainedWeights, has_lpips: bool, model: Reconstructor, device: torch.device
) -> dict[str, Any]:
    """All settings that affect the metrics of a sample, flattened; the device affects times."""
    settings = flatten(OmegaConf.to_container(config, resolve=True))
    free = _NOT_COMPARED if config.evaluation.refine else (*_NOT_COMPARED, *_REFINEMENT)
    kept = {key: value for key, value in settings.items() if not key.startswith(free)}
    kept |= {f"weights.{key}": value for key, value in model.backend.identity().items()}
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    return kept | {"checkpoint.sha256": weights.digest, "lpips.found": has_lpips, "device": where}


def _evaluate_all(
    evaluator: SceneEvaluator,
    data: BatchDataset,
    samples: Sequence[SceneSample],
    store: ResultStore,
    device: torch.device,
) -> dict[str, dict[str, float | None]]:
    """Metrics per scene; stored ones are reused unless a requested picture is missing."""
    results = {}
    for number, views in enumerate(samples):
        wanted = number < evaluator.options.pictures
        metrics = store.read(views)
        if metrics is None or (wanted and not store.picture(views).is_file()):
            batch = data[(views,)].to(device)
            result = evaluator(batch)
            if wanted:
                protocol = next(name for name in ("gt_pose", "novel", "context") if name in result.renders)
                truth = batch.context if protocol == "context" else batch.target
                write_png(store.picture(views), scene_picture(batch, result.renders[protocol], truth))
            metrics = result.metrics
            store.write(views, metrics)
            log.info("%d views, scene %d of %d: %s", len(views.context), number + 1, len(samples), views.scene)
        results[views.scene] = metrics
    return results


def _settings(
    config: DictConfig, evaluator: SceneEvaluator, weights: TrainedWeights, source: SceneSource, scenes: int
) -> dict[str, Any]:
    """What the report says about an evaluation."""
    options, model = evaluator.options, evaluator.model
    settings = {
        "name": Path(config.output_dir).name,
        "weights": str(weights) if model.trained_parameters() else "none: the model has no trained part",
        "model": type(model).__name__,
        "backend": model.backend.identity(),
        "data": type(source).__name__,
        "scenes": scenes,
        "index": options.selection.index or f"drawn with seed {options.selection.seed}",
        "size": [int(side) for side in config.data.image_size],
        "alignment": options.alignment,
        "depth_range": list(options.depth_range),
        "neighbors": options.neighbors,
        "points": asdict(options.points),
        "refinement": options.refine,
        "told": model.backend.needs_hints,
    }
    obstacle = options.table and paper.obstacle(options.table, settings)
    return settings | {"paper": None if obstacle else options.table, "paper_obstacle": obstacle}


class ResultStore:
    """Results of one evaluation, one JSON file per scene.

    Args:
        folder: the evaluation's folder.
        identity: flat settings that affect the metrics; an evaluation already in the folder must have the same.
        overwrite: remove the results that the folder holds, of this or another evaluation.

    Raises:
        FileExistsError: if the folder holds an evaluation with other settings, or files that do not belong to an
            evaluation, which are never replaced.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any], overwrite: bool = False) -> None:
        self.folder = folder
        if not (folder / IDENTITY).is_file():
            foreign = [name for name in _WRITTEN if (folder / name).exists()]
            if foreign:
                raise FileExistsError(
                    f"{folder} holds {', '.join(foreign)}, which do not belong to an evaluation (no {IDENTITY}): "
                    "choose another output_dir= or name="
                )
        elif overwrite:
            # the report first: an interruption must not leave it next to other settings
            for name in _REPORTS:
                (folder / name).unlink(missing_ok=True)
            for name in _FOLDERS:
                shutil.rmtree(folder / name, ignore_errors=True)
        else:
            before = read_json(folder / IDENTITY)
            different = sorted(key for key in before.keys() | identity.keys() if before.get(key) != identity.get(key))
            if different:
                told = ", ".join(f"{key} ({before.get(key)} -> {identity.get(key)})" for key in different)
                raise FileExistsError(
                    f"{folder} holds an evaluation with other settings: {told}; choose another name=, or replace it "
                    "with overwrite=true"
                )
        write_json(folder / IDENTITY, dict(identity))

    def read(self, views: SceneSample) -> dict[str, float | None] | None:
        """Stored metrics of a sample; None if it was not evaluated, or with other frames."""
        path = self._path(views)
        if not path.is_file():
            return None
        stored = read_json(path)
        same = stored["context"] == list(views.context) and stored["target"] == list(views.target)
        return stored["scores"] if same else None

    def write(self, views: SceneSample, metrics: Mapping[str, float | None]) -> None:
        """Writes the metrics of a sample, atomically."""
        frames = {"context": list(views.context), "target": list(views.target)}
        write_json(self._path(views), {"scene": views.scene, **frames, "scores": dict(metrics)})

    def picture(self, views: SceneSample) -> Path:
        """Path of a sample's picture."""
        return self.folder / "pictures" / f"{_file_name(views.scene)}-{len(views.context)}.png"

    def _path(self, views: SceneSample) -> Path:
        return self.folder / "scenes" / str(len(views.context)) / f"{_file_name(views.scene)}.json"


def _file_name(scene: str) -> str:
    """Encodes a scene's name as a file name without slashes, unique per scene."""
    return scene.replace("%", "%25").replace("/", "%2F")
