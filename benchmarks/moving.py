"""PSNR of static parts when an object moves, with and without motion check: ``python benchmarks/moving.py``.

A chair moves across procedural rooms (``examples/worlds``) by ``--distances`` metres in the time interval ``--during``
(0 is the first frame, 1 the last). Every second frame is an input view; some of the others are held out. PSNR is that
of pixels in held-out views that do not show the chair. ``chair left`` is the fraction of the chair's input pixels that
enter the scene, ``static lost`` the fraction of all other input pixels that the check drops. Overrides are those of
``vg2gt reconstruct``, such as ``backend=oracle model=tiny_ungated backend.depth_noise=0.005``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from common import parser, write_results
from torch import Tensor

from examples.worlds.moving import SyntheticMovingRoom
from vg2gt.data.transforms import from_bytes
from vg2gt.evaluation.protocols import ground_truth_target_cameras
from vg2gt.evaluation.tables import markdown_table
from vg2gt.method.additions.visibility import ViewCheck
from vg2gt.metrics import psnr
from vg2gt.runs.load import LoadedModel, load_model
from vg2gt.types import Batch, Cameras

TARGETS = 4
SEEN = 0.01  # relative depth difference to the empty room above which a pixel shows the chair
FIRST_SEED = 1_000_000
Checks = dict[str, ViewCheck | None]


def scene(
    seed: int, views: int, size: tuple[int, int], distance: float, during: Sequence[float]
) -> tuple[Batch, Tensor]:
    """Renders a room; also returns where its frames show the chair, bool ``[V, H, W]``."""
    room = SyntheticMovingRoom(seed, 2 * views, size, distance=distance, during=(during[0], during[1]))
    order = [*range(0, 2 * views, 2), *torch.linspace(1, 2 * views - 1, TARGETS).round().int().tolist()]
    frames = room.render(order, 1)
    room.world_at = lambda frame: room.world
    empty = torch.stack([torch.from_numpy(frame.depth) for frame in room.render(order, 1, samples=1)])
    images = torch.stack([from_bytes(torch.from_numpy(frame.image)).permute(2, 0, 1) for frame in frames])
    depth = torch.stack([torch.from_numpy(frame.depth) for frame in frames])
    poses = torch.from_numpy(room.world_to_camera[order]).float()
    cameras = Cameras(poses[None], torch.from_numpy(room.intrinsics).float().expand(1, len(order), 3, 3), size)
    name, ids = (f"moving-{seed}",), torch.tensor([order])
    batch = Batch(images[None], depth[None], cameras, torch.tensor([True]), ids, name, views)
    return batch, (empty - depth).abs() > SEEN * depth


@torch.no_grad()
def score(loaded: LoadedModel, batch: Batch, chair: Tensor) -> dict[str, float]:
    """Scores one reconstruction; ``chair`` is the mask from :func:`scene`."""
    prediction, truth = loaded.model(batch.context.images, batch.context.hints), batch.target
    cameras = ground_truth_target_cameras(batch, prediction)
    shown = loaded.renderer(prediction.gaussians, cameras).color[0]
    static = ~chair[batch.num_context :, None]
    kept = prediction.surface.depth[0] > 0
    here = chair[: batch.num_context]
    return {
        "psnr": float(psnr(torch.where(static, shown, truth.images[0]), truth.images[0]).mean()),
        "chair left": float(kept[here].float().mean()) if here.any() else 0.0,
        "static lost": 1 - float(kept[~here].float().mean()),
    }


def rows(loaded: LoadedModel, checks: Checks, cases: Sequence[tuple], seeds: range) -> Iterator[dict[str, float]]:
    """Yields the means over rooms of every case, with every check."""
    for distance, during, views, size in cases:
        found: dict[str, list[dict[str, float]]] = {name: [] for name in checks}
        for seed in seeds:
            batch, chair = scene(seed, views, size, distance, during)
            for name, scores in found.items():
                loaded.model.visibility = checks[name]
                scores.append(score(loaded, batch, chair))
        row: dict[str, float] = {"metres": distance, "from": during[0], "to": during[1]}
        for figure in ("psnr", "chair left", "static lost"):
            for name, scores in found.items():
                row[f"{figure}, {name}"] = sum(one[figure] for one in scores) / len(scores)
        print(" ".join(f"{name} {value:.3f}" for name, value in row.items()), flush=True)
        yield row


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__, threads=1, overrides="Hydra overrides of backend, model and renderer")
    options.add_argument("--distances", type=float, nargs="+", default=[0.0, 0.25, 0.5, 1.0, 2.0], metavar="METRES")
    options.add_argument("--during", type=float, nargs=2, action="append", metavar=("FROM", "TO"))
    options.add_argument("--views", type=int, default=12)
    options.add_argument("--size", type=int, nargs=2, default=(112, 168), metavar=("HEIGHT", "WIDTH"))
    options.add_argument("--scenes", type=int, default=4)
    options.add_argument("--moment", type=int, default=3)
    options.add_argument("--name", default="moving", help="name of the result file")
    given = options.parse_args()
    torch.set_num_threads(given.threads)
    loaded = load_model(overrides=given.overrides, device="cpu")
    check = loaded.model.visibility or ViewCheck()
    checks: Checks = {"all": None, "checked": replace(check, moment=None), "moved": replace(check, moment=given.moment)}
    during = given.during or [(0.7, 0.7), (0.5, 0.8), (0.0, 1.0)]
    cases = [(d, s, given.views, tuple(given.size)) for s in during for d in given.distances if d or s == during[0]]
    seeds = range(FIRST_SEED, FIRST_SEED + given.scenes)
    table = list(rows(loaded, checks, cases, seeds))
    names = list(table[0])
    print(markdown_table(names, [[f"{row[name]:.3f}" for name in names] for row in table]))
    settings = {name: getattr(given, name) for name in ("views", "size", "scenes", "moment", "overrides")}
    write_results(given.out, given.name, {**settings, "rows": table})


if __name__ == "__main__":
    main()
