"""Primitives and decoding time by number of views: ``python benchmarks/primitives.py [--views N ...]``.

Compares VG²GT at several voxel sizes with one Gaussian per pixel (``--reference da3_gs``: DA3's own Gaussians) and with
pixel Gaussians merged by voxels, on procedural rooms or, with ``data=rgbd data.root=FOLDER``, on a recording (paper,
figure on the number of primitives and the time of the decoding head). Models are untrained: counts follow from the
geometry of the backbone, by default the simulated one, whose noise is printed. Training reduces the counts of VG²GT, as
enhanced depth agrees better between views. Times are the best of several passes: core-seconds on a CPU, CUDA events on
a GPU. Prints a table and writes a dated JSON file to ``benchmarks/results``.
"""

from __future__ import annotations

import gc
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from common import machine, parser, write_results
from hydra.utils import instantiate
from stage_clock import StageClock

from vg2gt.evaluation.tables import print_table
from vg2gt.method.grid import scene_voxel_size
from vg2gt.studies.study import compose_run
from vg2gt.types import Batch

LABELS = {
    "pixel_aligned": "pixel-aligned",
    "da3_gs": "DA3",
    "voxel_merged": "voxel-merged",
    "tiny": "VG²GT",
    "vg2gt": "VG²GT (large)",
}


@dataclass(frozen=True)
class Method:
    """A model and the minimum edge of its voxels in pixels; None for models without voxels."""

    model: str
    footprint: float | None

    @property
    def label(self) -> str:
        """Name in tables, with the edge of the voxels."""
        name = LABELS[self.model]
        return name if self.footprint is None else f"{name}, {self.footprint:g} px"

    @property
    def overrides(self) -> list[str]:
        """Hydra overrides for the method."""
        key = "model.fine.min_footprint" if self.model in ("tiny", "vg2gt") else "model.min_footprint"
        return [f"model={self.model}", *([] if self.footprint is None else [f"{key}={self.footprint}"])]


@dataclass
class Row:
    """Results of a method for one number of views, means over scenes.

    Attributes:
        method: label of the method.
        views: number of input views.
        primitives: Gaussians per scene.
        head_seconds: time from tokens and geometry to Gaussians, including the dense head.
        seconds: time of everything except the backbone and its first decode.
        voxel_size: edge of voxels in scene units (median depth 1); 0 without voxels.
    """

    method: str
    views: int
    primitives: float
    head_seconds: float
    seconds: float
    voxel_size: float


def load_scenes(overrides: list[str], views: int, scenes: int) -> list[Batch]:
    """Returns evaluation scenes with the given number of input views, evenly spread over each scene."""
    chosen = [f"data.eval_context={views}", "data.eval_target=0", f"data.eval_scenes={scenes}"]
    with tempfile.TemporaryDirectory() as folder:
        data = instantiate(compose_run([*overrides, *chosen], Path(folder)).data)
    data.setup("validate")
    return [batch.context for batch, _ in zip(data.val_dataloader(), range(scenes), strict=False)]


@torch.no_grad()
def measure(method: Method, batches: list[Batch], overrides: list[str], passes: int, device: torch.device) -> Row:
    """Reconstructs the scenes and averages the results."""
    with tempfile.TemporaryDirectory() as folder:
        config = compose_run([*overrides, *method.overrides], Path(folder))
    torch.manual_seed(0)
    model = instantiate(config.model, backend=instantiate(config.backend)).to(device).eval()
    counts, heads, totals, sizes = [], [], [], []
    for batch in batches:
        batch = batch.to(device)
        clock = StageClock(device)
        for _ in range(passes + 1):
            with clock.listening():
                prediction = model(batch.images, batch.hints)
        best = {name: min(stage.seconds[1:]) for name, stage in clock.stages.items()}
        counts.append(len(prediction.gaussians))
        heads.append(best.get("fine", 0.0) + best["gaussians"])
        totals.append(sum(value for name, value in best.items() if name not in ("encode", "decode")))
        options = model.fine if hasattr(model, "fine") else model
        if method.footprint is not None:
            size = scene_voxel_size(prediction.geometry, options.voxel_size, options.min_footprint)
            sizes.append(float(size[0]))

    def mean(values: list[float]) -> float:
        return sum(values) / len(values) if values else 0.0

    return Row(method.label, batches[0].num_context, mean(counts), mean(heads), mean(totals), mean(sizes))


def print_rows(title: str, rows: list[Row], pixels: int) -> None:
    """Prints one row per method and number of views, with ratios to the first method."""
    first = rows[0].method
    head = ("method", "views", "primitives", "of pixels", f"of {first}", "head, s", f"of {first}", "all, s")
    reference = {row.views: row for row in rows if row.method == first}
    cells = [
        [
            row.method,
            str(row.views),
            f"{row.primitives:,.0f}",
            f"{row.primitives / (pixels * row.views):.0%}",
            f"{row.primitives / reference[row.views].primitives:.1%}",
            f"{row.head_seconds:.2f}",
            f"{row.head_seconds / reference[row.views].head_seconds:.0%}",
            f"{row.seconds:.2f}",
        ]
        for row in rows
    ]
    print_table(head, cells, title=title, width=120)


def describe(overrides: list[str], batch: Batch) -> dict[str, Any]:
    """Describes the data, the backbone and its noise."""
    with tempfile.TemporaryDirectory() as folder:
        config = compose_run(overrides, Path(folder))
    return {
        "first scene": batch.scene[0],
        "size": list(batch.images.shape[-2:]),
        "backend": str(config.backend.get("name", "oracle")),
        "depth noise": config.backend.get("depth_noise"),
    }


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__, device=True, passes=1, overrides="Hydra overrides; default for rooms: data.num_frames=64")
    options.add_argument("--views", type=int, nargs="+", default=[4, 10, 20, 50])
    options.add_argument("--footprints", type=float, nargs="+", default=[1.0, 2.0, 3.3], help="voxel edges in pixels")
    options.add_argument("--model", default="tiny", choices=("tiny", "vg2gt"))
    options.add_argument("--reference", default="pixel_aligned", choices=("pixel_aligned", "da3_gs"))
    options.add_argument("--scenes", type=int, default=1)
    options.add_argument("--name", default="rooms", help="used in the file name and the table's title")
    arguments = options.parse_args()
    torch.set_num_threads(1)
    device = torch.device(arguments.device)
    overrides = list(arguments.overrides)
    if weights := [override for override in overrides if override.startswith(("ckpt=", "init_from="))]:
        options.error(f"{weights[0]}: only untrained models are measured here; vg2gt evaluate counts trained ones")
    if not any(override.startswith("data=") for override in overrides):
        overrides = ["data.num_frames=64", *overrides]
    methods = [Method(arguments.reference, None)]
    methods += [Method("voxel_merged", arguments.footprints[-1])]
    methods += [Method(arguments.model, footprint) for footprint in arguments.footprints]
    rows: list[Row] = []
    batches: list[Batch] = []
    for views in arguments.views:
        batches = load_scenes(overrides, views, arguments.scenes)
        for method in methods:
            rows.append(measure(method, batches, overrides, arguments.passes, device))
            print(f"{rows[-1].method}, {views} views: {rows[-1].primitives:,.0f} primitives")
            gc.collect()
    about = describe(overrides, batches[0])
    height, width = about["size"]
    noise = about["depth noise"]
    title = f"{arguments.name}, {height}x{width}, voxel edges in pixels at the median depth, backend {about['backend']}"
    title += "" if noise is None else f" with {noise:.1%} depth noise"
    rows.sort(key=lambda row: ([method.label for method in methods].index(row.method), row.views))
    print_rows(title, rows, height * width)
    unit = "seconds" if device.type == "cuda" else "core-seconds"
    content = {
        "machine": machine(device),
        "unit": unit,
        "overrides": [override for override in overrides if not override.startswith("data.root=")],
        "scenes": arguments.scenes,
        "passes": arguments.passes,
        "data": about,
        "rows": [asdict(row) for row in rows],
    }
    write_results(arguments.out, f"primitives-{arguments.name}-{device.type}", content)


if __name__ == "__main__":
    main()
