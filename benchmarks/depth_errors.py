"""Where decoded depth errs, and what coarse enhancement mends of it: ``python benchmarks/depth_errors.py``.

The pixels of the input views are told apart by the truth: whether another input view sees the same point, and whether
they are within three pixels of a depth edge. For each kind: its share of the pixels and of the error (relative, after
one median scale per scene, as everywhere), its error before the coarse enhancement and what the enhancement changes.
The model is the one that ships, or ``--ckpt``; the scenes are 16 unseen rooms and, with ``--shared FOLDER``, real
recordings. Prints a table and writes a dated JSON file.
"""

from __future__ import annotations

from pathlib import Path

import torch
from common import RECORDINGS, evaluation_scenes, machine, parser, write_results
from torch import Tensor

from vg2gt.evaluation.tables import print_table
from vg2gt.geometry.cameras import project, unproject
from vg2gt.metrics import near_depth_edges
from vg2gt.runs.load import load_model
from vg2gt.types import Cameras

SETS = {"16 rooms": "data=synthetic data.image_size=[112,224]"} | RECORDINGS
SAME = 0.03  # relative difference of depth up to which another view sees the same point


def seen_by_others(depth: Tensor, cameras: Cameras) -> Tensor:
    """Which pixels of ``depth [V, H, W]`` show a point that another view shows as well, ``[V, H, W]`` bool."""
    views, height, width = depth.shape
    points = unproject(depth[None], cameras)[0]  # [V, H, W, 3]
    seen = torch.zeros_like(depth, dtype=torch.bool)
    for view in range(views):
        pixels, z = (found[0] for found in project(points[view].expand(1, views, -1, -1, -1), cameras))
        column, row = pixels.round().long().unbind(-1)
        inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        index = torch.where(inside, row * width + column, 0).flatten(1)
        there = depth.flatten(1).gather(1, index).view_as(z)
        same = inside & ((there - z).abs() < SAME * z)
        same[view] = False
        seen[view] = same.any(0)
    return seen & (depth > 0)


def relative_error(depth: Tensor, truth: Tensor) -> Tensor:
    """``|s d / d* - 1|`` with the scene's median scale s; 0 where the truth is unknown."""
    valid = (truth > 0) & (depth > 0)
    scale = (truth[valid] / depth[valid]).median()
    return torch.where(valid, (scale * depth / truth.clamp(min=1e-9) - 1).abs(), 0.0)


def kinds(truth: Tensor, cameras: Cameras) -> dict[str, Tensor]:
    """Masks ``[V, H, W]`` of the kinds of pixels."""
    known, seen, edge = truth > 0, seen_by_others(truth, cameras), near_depth_edges(truth[None])[0]
    return {
        "all": known,
        "seen by another view, off edges": seen & ~edge,
        "seen by another view, at edges": seen & edge,
        "seen by no other view, off edges": known & ~seen & ~edge,
        "seen by no other view, at edges": known & ~seen & edge,
    }


@torch.no_grad()
def main() -> None:
    """Measures all sets."""
    arguments = parser(__doc__, threads=1)
    arguments.add_argument("--shared", type=Path, help="folder with the real recordings")
    arguments.add_argument("--ckpt", help="a run trained on backend=sweep instead of the weights that ship")
    options = arguments.parse_args()
    torch.set_num_threads(options.threads)
    model = load_model(options.ckpt, "sweep", device="cpu").model
    results: dict[str, dict[str, dict[str, float]]] = {}
    for name, overrides in SETS.items():
        if "{shared}" in overrides and options.shared is None:
            continue
        sums: dict[str, Tensor] = {}
        for scene in evaluation_scenes(overrides.format(shared=options.shared)):
            batch = scene.context
            prediction, truth = model(batch.images, batch.hints), batch.depth[0]
            errors = [relative_error(g.depth[0], truth) for g in (prediction.initial, prediction.geometry)]
            count = (truth > 0).sum()
            for kind, mask in kinds(truth, batch.cameras).items():
                figures = torch.stack([mask.sum(), *(error[mask].sum() for error in errors)]).double() / count
                sums[kind] = sums.get(kind, torch.zeros(3)) + figures
        whole = sums["all"]
        results[name] = {
            kind: {
                "pixels": float(figures[0] / whole[0]),
                "share_of_error": float(figures[1] / whole[1]),
                "abs_rel_before": float(figures[1] / figures[0]),
                "abs_rel": float(figures[2] / figures[0]),
            }
            for kind, figures in sums.items()
        }
        rows = [
            [kind, f"{f['pixels']:.3f}", f"{f['share_of_error']:.2f}", f"{f['abs_rel_before']:.4f}",
             f"{100 * (f['abs_rel'] / f['abs_rel_before'] - 1):+.1f} %"]
            for kind, f in results[name].items()
        ]  # fmt: skip
        print_table([name, "pixels", "share of the error", "abs_rel before", "enhanced"], rows, title=name)
    write_results(options.out, "depth-errors", {"machine": machine(), "ckpt": options.ckpt, "sets": results})


if __name__ == "__main__":
    main()
