"""Scores on held-out photographs, feed-forward and refined: ``python benchmarks/photos.py FOLDER [FOLDER ...]``.

Cameras are estimated once by structure from motion and kept in ``--work``. Every fourth view is held out: no program
sees it, nor points that only it saw. Evaluates the feed-forward scene, and scenes refined from it for each of
``--budgets``: core-seconds of one thread, including the feed-forward pass but not structure from motion. ``--model``
and ``--refine`` change settings for comparison, such as ``--model fine.min_footprint=6.2`` or
``--refine rates.cameras=0``. ``--opensplat BINARY`` trains OpenSplat on the same images, cameras and points with the
same budgets. New rows replace those of the newest file with the same set, size, program, settings, weights and budget;
other rows are kept. Writes JSON and a table to ``benchmarks/results``, and a picture of each set to ``--work``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Any

import torch
from common import MEGABYTE, machine, parser, write_results
from hydra.utils import instantiate
from opensplat import BACKGROUND, train
from photo_sets import PhotoSet, prepare
from torch import Tensor

from vg2gt.config import compose
from vg2gt.evaluation.tables import METRICS, Metric, columns, markdown_table, number
from vg2gt.geometry.alignment import align_cameras
from vg2gt.io import read_gaussian_ply
from vg2gt.io.files import read_json, write_text
from vg2gt.io.images import grid, write_png
from vg2gt.metrics import LPIPS, WeightsNotFoundError, load_lpips, psnr, ssim
from vg2gt.reconstruction.photographs import of_full_size
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.refined import refine_scene
from vg2gt.reconstruction.scene import Scene
from vg2gt.refinement import RefineOptions
from vg2gt.refinement.sharpen import matched
from vg2gt.rendering import Renderer
from vg2gt.runs.load import LoadedModel, load_model
from vg2gt.types import Cameras, Gaussians

OURS, PEER = "VG²GT", "OpenSplat"
FEED_FORWARD = "feed-forward"
PICTURED = 4  # held-out views per picture, evenly spread
KEY = ("set", "size", "program", "settings", "weights", "budget")
Row = dict[str, Any]


@dataclass
class Scores:
    """Scores scenes of one set of photographs.

    Attributes:
        photos: the set.
        lpips: LPIPS metric; None if its weights are missing.
        panels: some held-out views for the picture by label: the photographs, then the scored scenes.
    """

    photos: PhotoSet
    lpips: LPIPS | None
    panels: dict[str, list[Tensor]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.panels["photograph"] = [self.photos.images[view] for view in self._pictured()]

    @torch.no_grad()
    def __call__(self, label: str, gaussians: Gaussians, cameras: Cameras, renderer: Renderer) -> Row:
        """Returns metrics on input views and held-out views; cameras of the latter are aligned with the scene.

        Args:
            label: label of the panels.
            gaussians: the scene.
            cameras: cameras of the input views, in the scene's frame.
            renderer: renderer of the scene.
        """
        photos, plain = self.photos, replace(renderer, geometry=False)
        similarity = align_cameras(photos.cameras.select(torch.tensor(photos.context)), cameras)
        held_out = similarity.apply_cameras(photos.cameras.select(torch.tensor(photos.held_out)))
        row: Row = {"gaussians": len(gaussians)}
        for suffix, views, where in (("_given", photos.context, cameras), ("", photos.held_out, held_out)):
            shown = [plain(gaussians, where.select(slice(k, k + 1))).color[0, 0].clamp(0, 1) for k in range(len(views))]
            rendered, truth = torch.stack(shown), photos.images[list(views)]
            row[f"psnr{suffix}"] = float(psnr(rendered, truth).mean())
            row[f"ssim{suffix}"] = float(ssim(rendered, truth).mean())
            row[f"detail{suffix}"] = float(_detail(rendered) / _detail(truth))
        # after a gain and bias for each view and channel: the exposure of a held-out photograph is unknown
        row["psnr_fitted"] = float(psnr(matched(rendered, truth), truth).mean())
        if self.lpips is not None:
            row["lpips"] = float(self.lpips(rendered, truth).mean())
        self.panels[label] = [rendered[views.index(view)] for view in self._pictured()]
        return row

    def _pictured(self) -> list[int]:
        held_out = self.photos.held_out
        count = min(PICTURED, len(held_out))
        return [held_out[i * (len(held_out) - 1) // max(count - 1, 1)] for i in range(count)]


def _detail(images: Tensor) -> Tensor:
    """Returns the mean difference of neighbouring pixels of images ``[V, 3, H, W]``: what blur takes away."""
    return images.diff(dim=-1).abs().mean() + images.diff(dim=-2).abs().mean()


def given_cameras(scene: Scene, photos: PhotoSet) -> Cameras:
    """Returns the scene's cameras in the order of the input views, with intrinsics for the scored image size."""
    order = torch.tensor([scene.names.index(name) for name in photos.given])
    intrinsics = photos.cameras.intrinsics[:, list(photos.context)].to(scene.cameras.intrinsics)
    return Cameras(scene.cameras.world_to_camera[:, order], intrinsics, photos.cameras.size)


def ours(
    loaded: LoadedModel, scores: Scores, refinement: RefineOptions, budgets: Sequence[float], size: int | None
) -> list[Row]:
    """Scores the feed-forward scene, and scenes refined from it independently for each budget.

    Args:
        loaded: the model.
        scores: scores the scenes.
        refinement: options of refinement, without a limit of time or steps.
        budgets: core-seconds.
        size: longer side of the images to reconstruct from; None uses the scored size.
    """
    photos = scores.photos
    restart_peak_memory()
    began = time.process_time()
    scene = reconstruct_with(loaded.model, photos.folder, size=size or photos.cameras.size, renderer=loaded.renderer)
    taken = time.process_time() - began

    def scored(label: str, scene: Scene, seconds: float, steps: int) -> Row:
        used = {"core_seconds": seconds, "peak_memory_mb": peak_memory(), "steps": steps}
        return {**used, **scores(label, scene.gaussians, given_cameras(scene, photos), scene.renderer)}

    rows = [{"budget": FEED_FORWARD, **scored(FEED_FORWARD, scene, taken, 0)}]
    for budget in budgets:
        if budget <= taken:
            print(f"{photos.folder}: budget {budget:g} skipped, {taken:.0f} core-seconds passed before refinement")
            continue
        restart_peak_memory()
        began = time.process_time()
        steps = None if of_full_size(scene, refinement) is None else refinement.steps  # of the first of two stages
        options = replace(refinement, steps=steps, seconds=budget - taken)
        refined = refine_scene(scene, options, clock=time.process_time)
        seconds = taken + time.process_time() - began
        assert refined.refined is not None
        rows.append({"budget": budget, **scored(_budget(budget), refined, seconds, refined.refined.steps)})
    return rows


def restart_peak_memory() -> None:
    """Resets what :func:`peak_memory` returns to the memory in use."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> float:
    """Returns the largest resident memory of this process in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024 / MEGABYTE


def peer(binary: Path, scores: Scores, budgets: Sequence[float]) -> list[Row]:
    """Trains and scores OpenSplat's scenes, rendered in the same way (agrees with its own images to 53 dB).

    Raises:
        ValueError: if the set has no sparse points.
    """
    photos, rows, pace = scores.photos, [], None
    if not photos.points:
        raise ValueError(f"{PEER} requires sparse points, but {photos.folder} has none: use --poses sfm")
    renderer = Renderer(mode="rasterized", lowpass=0.3, alpha_max=0.999, geometry=False)
    cameras = photos.cameras.select(torch.tensor(photos.context))
    for budget in sorted(budgets):
        target = photos.folder.parent / f"{PEER}-{photos.folder.name}-{budget:g}" / "splat.ply"
        run = train(binary, photos.folder, target, budget, pace)
        pace = run.core_seconds / run.steps
        scene = replace(read_gaussian_ply(target), background=torch.tensor([BACKGROUND]))
        row = {"budget": budget, "core_seconds": run.core_seconds, "peak_memory_mb": run.peak_memory / MEGABYTE}
        rows.append({**row, "steps": run.steps, **scores(f"{PEER}, {_budget(budget)}", scene, cameras, renderer)})
    return rows


def warm_up(loaded: LoadedModel, photos: PhotoSet, refinement: RefineOptions) -> None:
    """Runs once on two small views, so that one-time compilation and loading are not measured."""
    patch = loaded.model.backend.patch_size
    size = (max(2, photos.cameras.size[0] // patch // 4) * patch, max(2, photos.cameras.size[1] // patch // 4) * patch)
    scene = reconstruct_with(loaded.model, photos.folder, size=size, max_images=2, renderer=loaded.renderer)
    full = None if refinement.full is None else replace(refinement.full, steps=9, crop=32)
    refine_scene(scene, replace(refinement, steps=2, seconds=None, full=full))


def merged(folder: Path, rows: Sequence[Row]) -> list[Row]:
    """Returns the rows of the newest file, with ``rows`` added or replacing rows with the same key."""
    newest = max(folder.glob("*-photos.json"), default=None)
    old = [] if newest is None else read_json(newest)["rows"]
    by_key = {tuple(row[name] for name in KEY): row for row in [*old, *rows]}
    return sorted(by_key.values(), key=_order)


def _order(row: Row) -> tuple[Any, ...]:
    budget = 0.0 if row["budget"] == FEED_FORWARD else float(row["budget"])
    return row["size"], row["set"], row["program"] != OURS, row["settings"], row["weights"], budget


def tables(rows: Sequence[Row]) -> str:
    """Returns Markdown tables: held-out PSNR and SSIM by size and budget, then all metrics."""
    parts = ["# Held-out photographs", "PSNR in dB and SSIM of every fourth view, by core-seconds of one thread."]
    for size in sorted({row["size"] for row in rows}):
        some = [row for row in rows if row["size"] == size]
        budgets = list(dict.fromkeys(row["budget"] for row in sorted(some, key=lambda row: _order(row)[-1])))
        lines: dict[tuple[str, ...], dict[Any, str]] = {}
        for row in some:
            lines.setdefault((row["set"], row["program"], row["settings"], row["weights"]), {})[row["budget"]] = _short(
                row
            )
        cells = [[*key, *(of.get(budget, "") for budget in budgets)] for key, of in lines.items()]
        head = ("set", "program", "settings", "weights", *map(_budget, budgets))
        parts += [f"## Longer side {size}", markdown_table(head, cells, 4)]
    shown = columns("psnr", "ssim", "lpips", "gaussians", decimals={"psnr": 2})
    for name in ("psnr", "ssim"):
        shown[f"{name}_given"] = replace(METRICS[name], label=f"{METRICS[name].label}, given")
    shown["psnr_fitted"] = replace(METRICS["psnr"], label="PSNR, exposure fitted")
    shown["detail"] = Metric("detail", 2)
    shown |= {"steps": Metric("steps", 0), "core_seconds": Metric("core-s", 0), "peak_memory_mb": Metric("MB", 0)}
    cells = [
        [str(row[name]) for name in KEY[:-1]]
        + [_budget(row["budget"]), *(number(row.get(name), metric.decimals) for name, metric in shown.items())]
        for row in rows
    ]
    head = (*KEY, *(metric.label for metric in shown.values()))
    return "\n\n".join([*parts, "## All figures", markdown_table(head, cells, len(KEY))]) + "\n"


def _budget(budget: float | str) -> str:
    return budget if isinstance(budget, str) else f"{budget:g} s"


def _short(row: Row) -> str:
    return f"{row['psnr']:.2f} {row['ssim']:.3f}"


def arguments() -> argparse.Namespace:
    """Parses the command line."""
    options = parser(__doc__)
    options.add_argument("folders", nargs="+", metavar="FOLDER", help="folder of photographs, or NAME=FOLDER")
    options.add_argument("--size", type=int, default=280, help="longer side in pixels, such as 280, 1008 or 1600")
    options.add_argument("--working-size", type=int, help="longer side that VG²GT works at; scored at --size")
    options.add_argument("--budgets", type=float, nargs="*", default=[30.0, 100.0, 300.0], metavar="CORE_SECONDS")
    options.add_argument("--poses", choices=("sfm", "given"), default="sfm")
    options.add_argument("--ckpt", help="default: the weights in the package")
    options.add_argument("--model", nargs="+", default=[], metavar="KEY=VALUE", help="overrides of configs/model")
    options.add_argument("--refine", nargs="+", default=[], metavar="KEY=VALUE", help="overrides of configs/refine")
    options.add_argument("--opensplat", type=Path, metavar="BINARY", help="also train OpenSplat")
    options.add_argument("--only-peer", action="store_true", help="skip VG²GT")
    options.add_argument("--work", type=Path, default=Path("outputs/photos"), help="folder of cameras, views, pictures")
    return options.parse_args()


def main() -> None:
    """Measures every set; prints and writes after each."""
    given = arguments()
    torch.set_num_threads(1)
    changes = [f"refine.{change}" for change in given.refine]
    refinement: RefineOptions = instantiate(compose(None, "+refine=photographs", *changes).refine)
    # a leading plus adds a key that the checkpoint's configuration lacks
    of_model = ["+" * change.startswith("+") + f"model.{change.removeprefix('+')}" for change in given.model]
    loaded = load_model(given.ckpt, overrides=of_model, device="cpu")
    size = [f"working-size={given.working_size}"] if given.working_size else []
    weights = (loaded.weights.digest or "none")[:8]  # of the head, which belongs to one backbone
    settings = " ".join(sorted([*size, *of_model, *changes])) or "default"
    try:
        lpips = load_lpips()
    except WeightsNotFoundError:
        lpips = None
    for item in given.folders:
        name, _, folder = item.rpartition("=")
        folder = Path(folder)
        name = name or folder.resolve().name
        photos = prepare(folder, given.work / name, given.size, loaded.model.backend.patch_size, given.poses)
        scores = Scores(photos, lpips)
        common = {"set": name, "size": given.size, "views": [len(photos.context), len(photos.held_out)]}
        common |= {"poses": given.poses, "date": date.today().isoformat(), "machine": machine()}
        rows: list[Row] = []
        if not given.only_peer:
            warm_up(loaded, photos, refinement)
            found = ours(loaded, scores, refinement, given.budgets, given.working_size)
            rows += [{**common, "program": OURS, "settings": settings, "weights": weights, **row} for row in found]
        if given.opensplat:
            found = peer(given.opensplat, scores, given.budgets)
            rows += [{**common, "program": PEER, "settings": "default", "weights": "", **row} for row in found]
        for row in rows:
            spent = f"{row['core_seconds']:.0f} core-seconds, {row['gaussians']} Gaussians"
            print(f"{name}, {row['program']}, {_budget(row['budget'])}: {_short(row)}, {spent}", flush=True)
        print(write_png(given.work / f"{name}-{given.size}.png", grid(list(zip(*scores.panels.values(), strict=True)))))
        rows = merged(given.out, rows)
        path = write_results(given.out, "photos", {"threads": 1, "rows": rows})
        write_text(path.with_suffix(".md"), tables(rows))


if __name__ == "__main__":
    main()
