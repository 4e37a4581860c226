"""Depth of the learned plane sweep: ``python benchmarks/plane_sweep.py``.

Only cameras are given. Scenes are procedural ones on which nothing was trained, with ``--shared FOLDER`` also real
recordings, and with ``--infinigen FOLDER`` rooms of Infinigen. ``--itermvs FOLDER`` runs IterMVS
(``examples/backends``) on the same views, and ``--ckpt RUN`` the backbone of a trained model, before and after its
coarse module.
Depth is compared after alignment by one median scale per set of views, except ``raw``. Prints a table and writes a
dated JSON file.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TypeAlias

import torch
from common import machine, parser, write_results
from hydra.utils import instantiate

from backends.base import Backend
from backends.sweep import SweepBackend
from examples.backends.itermvs import IterMVSBackend
from vg2gt import __version__
from vg2gt.config import compose
from vg2gt.metrics.kinds import KINDS, pixel_kinds
from vg2gt.model import VG2GT
from vg2gt.runs.load import load_model
from vg2gt.types import Batch, Geometry, Hints

Depth: TypeAlias = Callable[[Batch], Geometry]

MADE = " data.eval_scenes={scenes} data.image_size={size}"
WORLDS = f"hydra.searchpath=[{Path(__file__).parents[1] / 'examples/worlds/configs'}] data=worlds" + MADE
SETS = {
    "rooms": "data=synthetic" + MADE,
    "outdoors": WORLDS + " data.variant=outdoor",
    "objects": WORLDS + " data.variant=object",
    "wide rooms": WORLDS + " data.variant=wide",
    "HoloLens office": "data=rgbd data.root={shared}/hololens_office_a data.image_size={size}",
    "7-Scenes kitchen": "data=rgbd data.root={shared}/seven_scenes_redkitchen_a_registered data.image_size={size}"
    " data.eval_window=10",
    "Infinigen rooms": "data=infinigen data.root={infinigen} data.image_size=[112,224] data.eval_window=10",
}


def batches(overrides: str) -> Iterator[Batch]:
    """Yields the 8 input views of every evaluation scene, or window, of a data configuration."""
    config = compose("train", *overrides.split(), "data.eval_target=1", "data.eval_context=8")
    data = instantiate(config.data)
    data.setup("validate")
    for batch in data.val_dataloader():
        yield batch.context


def of_backbone(backend: Backend) -> Depth:
    """Returns what predicts the depth of a backbone."""
    return lambda batch: backend.decode(backend.encode(batch.images, Hints(cameras=batch.cameras)))


def enhanced(model: VG2GT) -> Depth:
    """Returns what predicts the depth of a model after its coarse module, in the unit of its backbone."""

    def predict(batch: Batch) -> Geometry:
        found = model.enhance(batch.images, Hints(cameras=batch.cameras))[1]
        return replace(found.geometry, depth=found.geometry.depth / found.unit[:, None, None, None])

    return predict


@torch.no_grad()
def measure(depth_of: Depth, batch: Batch) -> dict[str, float]:
    """Computes depth errors of a batch of one scene over all pixels with known truth (not 0).

    Args:
        depth_of: predicts the geometry of a batch.
        batch: input views with their true depth.

    Returns:
        ``raw``: mean relative error without alignment. With one median scale: ``abs_rel`` and ``median``, the mean and
        median relative error; ``d1.05``, the fraction of pixels within 5 %; ``half``, abs_rel of the more confident
        half relative to that of all. Of each of :func:`pixel_kinds`: ``share``, the fraction of the pixels, and
        ``error``, the part of abs_rel that these pixels make up. ``cpu_s_per_view``: processor time.
    """
    start = time.process_time()
    geometry = depth_of(batch)
    spent = time.process_time() - start
    depth, truth = geometry.depth[0], batch.depth[0]
    valid = (truth > 0) & torch.isfinite(depth) & (depth > 0)
    aligned = (truth / depth)[valid].median() * depth / truth
    error = (aligned - 1).abs()
    ordered = error[valid][geometry.depth_conf[0][valid].argsort(descending=True)]
    kinds = pixel_kinds(batch.images[0], truth, batch.cameras)
    return {
        "raw": float((depth / truth - 1)[valid].abs().mean()),
        "abs_rel": float(ordered.mean()),
        "d1.05": float((torch.maximum(aligned, 1 / aligned)[valid] < 1.05).float().mean()),
        "median": float(ordered.median()),
        "half": float(ordered[: len(ordered) // 2].mean() / ordered.mean()),
        **{f"share {name}": float(mask[valid].float().mean()) for name, mask in kinds.items()},
        **{f"error {name}": float((mask * error)[valid].mean()) for name, mask in kinds.items()},
        "cpu_s_per_view": spent / len(truth),
    }


def main() -> None:
    """Measures all sets."""
    arguments = parser(__doc__)
    arguments.add_argument("--shared", type=Path, help="folder with the real recordings")
    arguments.add_argument("--infinigen", type=Path, help="folder with rooms made by recipes/infinigen")
    arguments.add_argument("--weights", help="safetensors file instead of the shipped weights")
    arguments.add_argument("--scenes", type=int, default=16, help="number of procedural scenes of a kind")
    arguments.add_argument("--size", default="[160,288]", help="[height,width] of all but Infinigen's views")
    arguments.add_argument("--itermvs", type=Path, help="checkout of FangjinhuaWang/IterMVS: measures it as well")
    arguments.add_argument("--ckpt", help="run: measures its backbone, and the depth after its coarse module, as well")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    backend = SweepBackend(path=options.weights)
    backends: dict[str, Backend] = {"": backend}
    if options.itermvs:
        weights = options.itermvs / "checkpoints/blendedmvs/model_000015.ckpt"
        backends[", IterMVS"] = IterMVSBackend(path=str(weights))
    predictors = {suffix: of_backbone(network) for suffix, network in backends.items()}
    if options.ckpt:
        model = load_model(options.ckpt, device="cpu").model
        if not isinstance(model, VG2GT):
            raise SystemExit(f"{options.ckpt} has no coarse module")
        backends[", run"] = model.backend
        predictors |= {", run": of_backbone(model.backend), ", run enhanced": enhanced(model)}
    sets: dict[str, dict[str, float]] = {}
    for (name, overrides), (suffix, depth_of) in product(SETS.items(), predictors.items()):
        if any(f"{{{place}}}" in overrides and not getattr(options, place) for place in ("shared", "infinigen")):
            continue
        rows = [measure(depth_of, batch) for batch in batches(overrides.format(**vars(options)))]
        figures = {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]}
        for kind in KINDS:  # the parts of abs_rel of all windows, to means over the pixels of that kind
            figures[f"abs_rel {kind}"] = figures.pop(f"error {kind}") / max(figures[f"share {kind}"], 1e-9)
        sets[name + suffix] = figures
        print(f"{name + suffix:18}", " ".join(f"{key} {value:.4f}" for key, value in figures.items() if " " not in key))
        kinds = (f"{kind} {figures[f'share {kind}']:.0%} {figures[f'abs_rel {kind}']:.3f}" for kind in KINDS)
        print(" " * 18, ", ".join(kinds), flush=True)
    weights = {suffix.strip(", ") or "sweep": network.identity()["weights"] for suffix, network in backends.items()}
    content = {"machine": machine(), "version": __version__, "size": options.size, "weights": weights, "sets": sets}
    write_results(options.out, "plane_sweep", content)


if __name__ == "__main__":
    main()
