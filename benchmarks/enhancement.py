"""Decoded depth before and after enhancement, at several noise levels: ``python benchmarks/enhancement.py CKPT``.

Takes a model trained on the simulated backbone (``CKPT``: a checkpoint or a run's folder) and lets the backbone err
more or less than it did in training: on rooms that the model was not trained on and, with ``--shared FOLDER``, on real
recordings. To tell what carries the gain, PTv3's features are replaced by their mean over the views, and the surface
evidence (:mod:`vg2gt.method.additions.surface_evidence`) by zero. Prints a table and writes a dated JSON file.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from common import RECORDINGS, evaluation_scenes, machine, parser, write_results
from torch import Tensor, nn

from backends.oracle import OracleBackend
from vg2gt import load_model
from vg2gt.method import CoarseModule, PTv3
from vg2gt.method.additions.surface_evidence import SURFACE_CHANNELS
from vg2gt.metrics import depth_metrics
from vg2gt.model import VG2GT
from vg2gt.types import Batch

SETS = {"rooms": "data=synthetic data.eval_scenes={scenes}"} | RECORDINGS
VARIANTS = ("before", "after", "PTv3's features averaged", "no surface evidence")


def fused_inputs(model: VG2GT, variant: str) -> tuple[slice, bool]:
    """Which channels of the fusion's input a variant changes, and whether their mean replaces them, else zero."""
    assert isinstance(model.coarse, CoarseModule)
    assert isinstance(model.coarse.ptv3, PTv3)
    width = model.coarse.ptv3.out_channels
    if variant == "PTv3's features averaged":
        return slice(0, width), True
    if not model.coarse.surface_evidence:
        raise SystemExit("this model has no surface evidence (model.coarse.surface_evidence): nothing to leave out")
    return slice(width, width + SURFACE_CHANNELS - 1), False  # the last one is the point's confidence


@contextmanager
def changed(model: VG2GT, variant: str) -> Iterator[None]:
    """Within it the fusion of the coarse module is told what the variant says."""
    assert isinstance(model.coarse, CoarseModule)
    if variant == "after":
        yield
        return
    channels, mean = fused_inputs(model, variant)

    def replace(_: nn.Module, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        maps = inputs[0].clone()
        average = maps[:, channels].mean((0, 2, 3), keepdim=True)
        maps[:, channels] = average if mean else 0
        return (maps,)

    handle = model.coarse.fuse.register_forward_pre_hook(replace)
    try:
        yield
    finally:
        handle.remove()


@torch.no_grad()
def measure(model: VG2GT, batch: Batch) -> dict[str, float]:
    """abs_rel of one scene after one median scale, by variant."""
    found: dict[str, float] = {}
    for variant in VARIANTS[1:]:
        with changed(model, variant):
            prediction = model(batch.images, batch.hints)
        found[variant] = depth_metrics(prediction.geometry.depth[0], batch.depth[0], "scene")["abs_rel"]
        found["before"] = depth_metrics(prediction.initial.depth[0], batch.depth[0], "scene")["abs_rel"]
    return found


def main() -> None:
    """Measures all sets at all levels."""
    arguments = parser(__doc__, threads=1)
    arguments.add_argument("ckpt", help="a checkpoint or a run's folder")
    arguments.add_argument("--shared", type=Path, help="folder with the real recordings")
    arguments.add_argument("--scenes", type=int, default=16, help="rooms")
    arguments.add_argument("--noise", type=float, nargs="+", default=[0, 0.005, 0.01, 0.02, 0.05], help="relative")
    options = arguments.parse_args()
    torch.set_num_threads(options.threads)
    model = load_model(options.ckpt, device="cpu").model
    backend = model.backend
    if not isinstance(model, VG2GT) or model.coarse is None or not isinstance(backend, OracleBackend):
        raise SystemExit(f"{options.ckpt}: expected a model with a coarse module on the simulated backbone")
    table: dict[str, dict[str, dict[str, float]]] = {}
    for name, overrides in SETS.items():
        if "{shared}" in overrides and options.shared is None:
            continue
        data = overrides.format(shared=options.shared, scenes=options.scenes)
        scenes = [scene.context for scene in evaluation_scenes(data)]
        table[name] = {}
        for noise in options.noise:
            backend.depth_noise, backend.pose_noise = noise, 0.1 * noise
            rows = [measure(model, batch) for batch in scenes]
            mean = {variant: sum(row[variant] for row in rows) / len(rows) for variant in VARIANTS}
            table[name][f"{noise:g}"] = mean
            print(f"{name:18} noise {noise:<6g}", " | ".join(f"{k} {v:.4f}" for k, v in mean.items()), flush=True)
    content = {"machine": machine(), "ckpt": Path(options.ckpt).name, "scenes": options.scenes, "sets": table}
    write_results(options.out, "enhancement", content)


if __name__ == "__main__":
    main()
