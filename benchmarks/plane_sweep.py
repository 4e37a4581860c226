"""Depth of the learned plane sweep compared with a classical one and a constant: ``python benchmarks/plane_sweep.py``.

Only cameras are given. Both sweeps use the same depth range, which the network finds from the cameras alone; the
classical sweep is also run with the true range. Scenes are procedural ones on which nothing was trained, with
``--shared FOLDER`` also real recordings, and with ``--infinigen FOLDER`` rooms of Infinigen. Depth is compared after
alignment by one median scale per set of views, except ``raw``. Prints a table and writes a dated JSON file.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from common import machine, parser, write_results
from hydra.utils import instantiate
from torch import Tensor
from torch.nn import functional as F

from backends.sweep import SweepBackend
from backends.sweep.correlate import SourceWarp
from backends.sweep.network import PosedViews
from backends.sweep.views import choose_sources
from backends.sweep.volume import to_inverse
from vg2gt import __version__
from vg2gt.config import compose
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.types import Batch, Hints

MADE = " data.eval_scenes={scenes} data.val.first_seed={seed} data.image_size=[112,224]"
WORLDS = f"hydra.searchpath=[{Path(__file__).parents[1] / 'examples/worlds/configs'}] data=worlds" + MADE
SETS = {
    "rooms": "data=synthetic" + MADE,
    "outdoors": WORLDS + " data.variant=outdoor",
    "objects": WORLDS + " data.variant=object",
    "wide rooms": WORLDS + " data.variant=wide",
    "HoloLens office": "data=rgbd data.root={shared}/hololens_office_a data.image_size=[112,224]",
    "7-Scenes kitchen": "data=rgbd data.root={shared}/seven_scenes_redkitchen_a_registered data.image_size=[112,224]"
    " data.eval_window=10",
    "Infinigen rooms": "data=infinigen data.root={infinigen} data.image_size=[112,224] data.eval_window=10",
}
_WINDOW = 7  # window of the classical matching cost, in pixels at half resolution
_PLANES = 64


def batches(overrides: str) -> Iterator[Batch]:
    """Yields the 8 input views of every evaluation scene, or window, of a data configuration."""
    config = compose("train", *overrides.split(), "data.eval_target=1", "data.eval_context=8")
    data = instantiate(config.data)
    data.setup("validate")
    for batch in data.val_dataloader():
        yield batch.context


def scores(depth: Tensor, truth: Tensor, confidence: Tensor | None) -> dict[str, float]:
    """Computes depth errors over all pixels with known truth.

    Args:
        depth: ``[V, H, W]``.
        truth: ``[V, H, W]``, 0 where unknown.
        confidence: ``[V, H, W]``; None for no ``half`` and ``ause``.

    Returns:
        ``raw``: mean relative error without alignment. With one median scale: ``abs_rel`` and ``median``, the mean and
        median relative error; ``d1.05``, the fraction of pixels within 5 %; ``half``, abs_rel of the more confident
        half relative to that of all; ``ause``, area under the sparsification error relative to abs_rel.
    """
    valid = (truth > 0) & torch.isfinite(depth) & (depth > 0)
    depth, truth = depth[valid], truth[valid]
    scale = (truth / depth).median()
    error = (scale * depth / truth - 1).abs()
    ratio = torch.maximum(scale * depth / truth, truth / (scale * depth))
    result = {
        "raw": float((depth / truth - 1).abs().mean()),
        "abs_rel": float(error.mean()),
        "d1.05": float((ratio < 1.05).float().mean()),
        "median": float(error.median()),
    }
    if confidence is not None:
        order = confidence[valid].argsort(descending=True)
        result["half"] = float(error[order[: len(order) // 2]].mean() / error.mean())
        kept = [max(1, int(len(error) * (1 - k / 20))) for k in range(19)]
        found, best = error[order], error.sort().values
        gaps = [found[:n].mean() - best[:n].mean() for n in kept]
        result["ause"] = float(torch.stack(gaps).mean() / error.mean())
    return result


def classical(views: PosedViews, depth_range: Tensor) -> Tensor:
    """Winner-take-all plane sweep ``[V, H, W]`` by normalised cross-correlation in 7x7 windows, mean of 3 sources."""
    sources = choose_sources(views.world_to_camera, views.intrinsics, views.size, depth_range, 3)
    grey = F.avg_pool2d(views.images.mean(1, keepdim=True), 2)
    size = (grey.shape[-2], grey.shape[-1])
    warp = SourceWarp(views.world_to_camera, resize_intrinsics(views.intrinsics, 0.5, 0.5), sources, size)
    mean, deviation = _moments(grey)
    best = torch.full_like(grey, -torch.inf)
    inverse = torch.zeros_like(grey)
    for t in torch.linspace(0, 1, _PLANES):
        plane = to_inverse(t, depth_range)
        total, seen = torch.zeros_like(grey), torch.zeros_like(grey)
        for source in range(sources.shape[1]):
            grid, inside, _ = warp(source, plane.expand(len(grey), 1, size[0] * size[1]))
            grid = grid.view(len(grey), *size, 2)
            other = F.grid_sample(grey[sources[:, source]], grid, padding_mode="border", align_corners=False)
            other_mean, other_deviation = _moments(other)
            covariance = _box(grey * other) - mean * other_mean
            inside = inside.view_as(grey)
            total += covariance / (deviation * other_deviation) * inside
            seen += inside
        score = torch.where(seen > 0, total / seen.clamp_min(1), -5.0)
        inverse = torch.where(score > best, plane, inverse)
        best = torch.maximum(best, score)
    return F.interpolate(1 / inverse, scale_factor=2)[:, 0]


def _box(x: Tensor) -> Tensor:
    return F.avg_pool2d(x, _WINDOW, 1, _WINDOW // 2, count_include_pad=False)


def _moments(x: Tensor) -> tuple[Tensor, Tensor]:
    mean = _box(x)
    return mean, ((_box(x.square()) - mean.square()).clamp_min(0) + 1e-4).sqrt()


@torch.no_grad()
def measure(backend: SweepBackend, batch: Batch, old: bool) -> dict[str, dict[str, float]]:
    """Scores all methods on a batch of one scene; only the network unless ``old``."""
    truth = batch.depth[0]
    cameras = batch.cameras
    start = time.process_time()
    geometry = backend.decode(backend.encode(batch.images, Hints(cameras=cameras)))
    spent = time.process_time() - start
    results = {"network": scores(geometry.depth[0], truth, geometry.depth_conf[0])}
    results["network"]["cpu_s_per_view"] = spent / len(truth)
    if old:
        views = PosedViews(batch.images[0], cameras.world_to_camera[0].float(), cameras.intrinsics[0].float())
        found = backend.network.find_range(backend.network.features(views.images), views, backend.sources)
        known = truth[truth > 0]
        true = torch.stack((known.quantile(0.01) * 0.75, known.quantile(0.99) * 1.5)) if len(known) < 2**24 else found
        results["NCC, same range"] = scores(classical(views, found), truth, None)
        results["NCC, true range"] = scores(classical(views, true), truth, None)
        results["constant"] = scores(torch.full_like(truth, float(known.median())), truth, None)
    return results


def average(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Returns the mean of every score."""
    return {name: math.fsum(row[name] for row in rows) / len(rows) for name in rows[0]}


def main() -> None:
    """Measures all sets."""
    arguments = parser(__doc__, threads=1)
    arguments.add_argument("--shared", type=Path, help="folder with the real recordings")
    arguments.add_argument("--infinigen", type=Path, help="folder with rooms made by recipes/infinigen")
    arguments.add_argument("--weights", help="safetensors file instead of the shipped weights")
    arguments.add_argument("--scenes", type=int, default=16, help="number of rooms")
    arguments.add_argument("--seed", type=int, default=1_000_000, help="seed of the first room")
    arguments.add_argument("--only-network", action="store_true")
    options = arguments.parse_args()
    torch.set_num_threads(options.threads)
    backend = SweepBackend(path=options.weights)
    table: dict[str, dict[str, dict[str, float]]] = {}
    for name, overrides in SETS.items():
        given = vars(options)
        if any(f"{{{place}}}" in overrides and given[place] is None for place in ("shared", "infinigen")):
            continue
        rows = [measure(backend, batch, not options.only_network) for batch in batches(overrides.format(**given))]
        table[name] = {method: average([row[method] for row in rows]) for method in rows[0]}
        for method, figures in table[name].items():
            print(
                f"{name:18} {method:16}", " ".join(f"{key} {value:.4f}" for key, value in figures.items()), flush=True
            )
    content = {"machine": machine(), "version": __version__, "weights": backend.identity()["weights"], "sets": table}
    write_results(options.out, "plane_sweep", content)


if __name__ == "__main__":
    main()
