"""Refinement from four starts at equal budgets: ``python benchmarks/refine.py [--scenes N] [--seconds S] [overrides]``.

The same refinement (``configs/refine/default.yaml``) from VG²GT's scene, from one Gaussian per pixel, from pixel
Gaussians merged by voxels, and from a point cloud as 3DGS starts (``model=pointcloud`` with neighbours' spacing,
opacity 0.1), on the same backbone, scenes and seconds: core-seconds on a CPU, the clock's on a GPU, evaluation not
counted. Held-out views at true poses, brought into the scene's frame by its present cameras; depth aligned by one scale
a scene; cameras: root mean square distance of the input views' centres to the true ones after one similarity, in per
cent of the median depth. Heads are untrained, which the labels say, but for those of ``--ckpt LABEL=PATH``. Procedural
rooms or, with ``data=rgbd data.root=FOLDER``, a recording; ``backend.pose_noise=0.01`` starts from wrong cameras and
``--options rates.cameras=0.1`` says how they move; ``--exposure 0.2`` brightens and darkens the input views by up to a
fifth. Writes a dated JSON file to ``benchmarks/results`` and curves to ``docs/figures``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from common import RESULTS, machine, parser, used_seconds, write_results
from hydra.utils import instantiate

from vg2gt.config import compose
from vg2gt.evaluation.protocols import ground_truth_target_cameras
from vg2gt.evaluation.scene_metrics import image_metrics, rendered_normal_metrics
from vg2gt.evaluation.tables import print_table
from vg2gt.geometry.alignment import align_cameras
from vg2gt.geometry.cameras import camera_centers
from vg2gt.metrics import depth_metrics
from vg2gt.refinement import Observations, Progress, RefinedScene, RefineOptions, refine
from vg2gt.rendering import Renderer
from vg2gt.runs.load import LoadedModel, load_model
from vg2gt.types import Batch, Cameras, Prediction

FIGURES = RESULTS.parents[1] / "docs" / "figures"
STARTS = {
    "VG²GT": ["model=tiny"],
    "pixel-aligned": ["model=pixel_aligned"],
    "voxel-merged": ["model=voxel_merged"],
    "point cloud": ["model=pointcloud", "model.spacing=neighbors", "model.width=1", "model.opacity=0.1"],
}
COLUMNS = ("cameras", "gaussians")
FIGURE = {"psnr": "PSNR [dB]", "ssim": "SSIM", "abs_rel": "abs_rel", "normal_mean": "normals [deg]"}
Curve = list[dict[str, float]]


@dataclass
class Stopwatch:
    """Seconds used, but for those in which it was stopped."""

    device: torch.device
    spared: float = 0.0

    def __call__(self) -> float:
        """Seconds so far, from any beginning."""
        return used_seconds(self.device) - self.spared

    def spare(self, work: Callable[[], Any]) -> Any:
        """Does something that is not counted."""
        began = used_seconds(self.device)
        try:
            return work()
        finally:
            self.spared += used_seconds(self.device) - began


@torch.no_grad()
def score(batch: Batch, prediction: Prediction, state: RefinedScene, renderer: Renderer) -> dict[str, float]:
    """Figures of the held-out views."""
    geometry = replace(prediction.geometry, cameras=state.cameras)
    cameras = ground_truth_target_cameras(batch, replace(prediction, geometry=geometry))
    rendered, truth = renderer(state.gaussians, cameras), batch.target
    depth = depth_metrics(rendered.depth[0], truth.depth[0], "scene")
    found = image_metrics(rendered, truth) | {name: depth[name] for name in ("abs_rel", "coverage")}
    found["normal_mean"] = rendered_normal_metrics(rendered, truth)["normal_mean"]
    found["cameras"] = camera_error(batch.context, state.cameras)
    return found | {"gaussians": float(len(state.gaussians))}


def camera_error(truth: Batch, found: Cameras) -> float:
    """Root mean square distance of the cameras' centres to the true ones, per cent of the median depth."""
    similarity = align_cameras(found, truth.cameras)
    centers = similarity.apply(camera_centers(found))
    apart = (centers - camera_centers(truth.cameras)).square().sum(-1).mean().sqrt()
    return float(100 * apart / truth.depth[truth.depth > 0].median())


def curve(loaded: LoadedModel, batch: Batch, options: RefineOptions, marks: list[float]) -> Curve:
    """Figures of one scene before refinement, after about so many seconds, and at the end."""
    watch = Stopwatch(batch.images.device)
    began = watch()
    with torch.no_grad():
        prediction = loaded.model(batch.context.images, batch.context.hints)
    reconstruct_seconds = watch() - began
    geometry, left, found = prediction.geometry, list(marks), []
    began = watch()

    def note(state: RefinedScene, step: int, mark: float) -> None:
        seconds = watch() - began
        scores = watch.spare(lambda: score(batch, prediction, state, loaded.renderer))
        found.append({"mark": mark, "seconds": seconds, "step": float(step), **scores})

    def observe(progress: Progress) -> None:
        if left and watch() - began >= left[0]:
            note(progress.scene(), progress.step, left.pop(0))

    nothing = torch.ones_like(batch.context.images[0, :, :, 0, 0])
    note(RefinedScene(prediction.gaussians, geometry.cameras, nothing, 0 * nothing), 0, 0.0)
    seen = Observations(batch.context.images[0], geometry.depth[0], geometry.depth_conf[0])
    refined = refine(prediction.gaussians, geometry.cameras, seen, loaded.renderer, options, observe, watch)
    assert options.seconds is not None
    note(refined.scene, refined.steps, options.seconds)
    return [point | {"reconstruct_seconds": reconstruct_seconds} for point in found]


def exposed(batch: Batch, spread: float) -> Batch:
    """Input views with gains spread evenly over ``1 - spread`` to ``1 + spread``, neighbours unlike each other."""
    gains = torch.ones(batch.images.shape[1], device=batch.images.device)
    steps = torch.linspace(-spread, spread, batch.num_context, device=batch.images.device)
    gains[: batch.num_context] += torch.cat((steps[::2], steps[1::2]))
    return replace(batch, images=(batch.images * gains[:, None, None, None]).clamp(0, 1))


def mean_curve(curves: list[Curve]) -> Curve:
    """Means over scenes at every mark that all scenes have."""
    marks = list(dict.fromkeys(p["mark"] for c in curves for p in c))
    rows = [[p for c in curves for p in c if p["mark"] == mark] for mark in marks]
    return [
        {key: sum(p[key] for p in points) / len(points) for key in points[0]}
        for points in rows
        if len(points) == len(curves)
    ]


def plot(curves: dict[str, Curve], title: str, unit: str, path: Path) -> Path | None:
    """Writes the curves as a picture; None without matplotlib."""
    try:
        from matplotlib import pyplot  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    figure, panels = pyplot.subplots(1, len(FIGURE), figsize=(14, 3.4))
    for panel, (name, label) in zip(panels, FIGURE.items(), strict=True):
        for start, points in curves.items():
            panel.plot([p["seconds"] for p in points], [p[name] for p in points], "o-", markersize=3, label=start)
        panel.set(xlabel=f"refinement [{unit}]", title=label)
    panels[0].legend(fontsize=8)
    figure.suptitle(title, fontsize=9)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    return path


def main() -> None:
    """Measures, prints, writes and plots."""
    options = parser(__doc__, device=True, threads=1, overrides="Hydra overrides of data and backend")
    options.add_argument("--scenes", type=int, default=4)
    options.add_argument("--seconds", type=float, default=20.0)
    options.add_argument("--starts", nargs="+", choices=STARTS, default=list(STARTS), metavar="LABEL")
    options.add_argument("--ckpt", nargs="+", default=[], metavar="LABEL=PATH", help="a start's trained part")
    options.add_argument("--options", nargs="+", default=[], metavar="KEY=VALUE", help="of configs/refine")
    options.add_argument("--exposure", type=float, default=0.0, help="spread of the input views' gains")
    options.add_argument("--name", default="rooms", help="part of the files' names")
    options.add_argument("--figures", type=Path, default=FIGURES)
    arguments = options.parse_args()
    torch.set_num_threads(arguments.threads)
    device = torch.device(arguments.device)
    trained = dict(item.split("=", 1) for item in arguments.ckpt)
    if unknown := set(trained) - set(arguments.starts):
        options.error(f"--ckpt {', '.join(unknown)}: no such start among {', '.join(arguments.starts)}")
    config = compose("train", "output_dir=.", *arguments.overrides)
    data = instantiate(config.data)
    data.setup("validate")
    loader = zip(data.val_dataloader(), range(arguments.scenes), strict=False)
    batches = [exposed(batch.to(device), arguments.exposure) for batch, _ in loader]
    changes = [f"refine.{item}" for item in arguments.options]
    how = replace(instantiate(compose(None, "+refine=default", *changes).refine), steps=None, seconds=arguments.seconds)
    marks = [arguments.seconds * share for share in (1 / 16, 1 / 8, 1 / 4, 1 / 2)]
    noise = {key: config.backend.get(key) for key in ("depth_noise", "pose_noise")}
    backend = [f"backend.{key}={value}" for key, value in noise.items() if value is not None]
    curves: dict[str, Curve] = {}
    names = {}
    for label in arguments.starts:
        kind = "" if label == "point cloud" else ", trained" if label in trained else ", untrained"
        names[label + kind] = (label, trained.get(label))
    for name, (label, ckpt) in names.items():
        loaded = load_model(ckpt, None if ckpt else "oracle", [*([] if ckpt else STARTS[label]), *backend], str(device))
        curve(loaded, batches[0], replace(how, steps=1), [])  # compiles
        curves[name] = mean_curve([curve(loaded, batch, how, marks) for batch in batches])
        last = curves[name][-1]
        print(f"{name}: {curves[name][0]['psnr']:.2f} -> {last['psnr']:.2f} dB", flush=True)
    unit = "seconds" if device.type == "cuda" else "core-seconds"
    head = ("start", unit, "steps", *FIGURE.values(), "cameras [%]", "Gaussians")
    cells = [
        [name, f"{p['seconds']:.1f}", f"{p['step']:.0f}", *(f"{p[key]:.4g}" for key in (*FIGURE, *COLUMNS))]
        for name, points in curves.items()
        for p in points
    ]
    height, width = batches[0].images.shape[-2:]
    title = f"{arguments.name}: {len(batches)} scene(s), {batches[0].num_context} views of {height}x{width}"
    print_table(head, cells, title=title)
    content = {
        "machine": machine(device),
        "unit": unit,
        "overrides": [item for item in arguments.overrides if not item.startswith("data.root=")],
        "scenes": [batch.scene[0] for batch in batches],
        "trained": sorted(trained),
        "seconds": arguments.seconds,
        "options": arguments.options,
        "exposure": arguments.exposure,
        "curves": curves,
    }
    write_results(arguments.out, f"refine-{arguments.name}-{device.type}", content)
    if picture := plot(curves, title, unit, arguments.figures / f"refine-{arguments.name}.png"):
        print(picture)


if __name__ == "__main__":
    main()
