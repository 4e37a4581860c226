"""Whether loading keeps up with training: ``python benchmarks/data_loading.py [--quick]``.

Writes synthetic RGB-D recordings of 640x480 (PNG and JPEG colour, 16-bit PNG depth) to a temporary folder and reads
them as training batches of 8 images of 224x448: from the files, from the cache of resized frames, from shards, and from
memory, with 0, 1 and 2 worker processes. Then takes steps of the default training (images of 112x224) on a CPU and
measures how long each waits for its batch. Beside that stands what the paper's training took in a second on each of its
devices. Prints tables and writes a
dated JSON file to ``benchmarks/results``.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from common import machine, parser, training_step, write_results
from hydra.utils import instantiate
from PIL import Image

from vg2gt.config import compose
from vg2gt.data import RGBDFolder
from vg2gt.data.shards import Encoding, write_shards
from vg2gt.data.synthetic.export import SceneSettings, missing_scenes, write_scenes
from vg2gt.data.views.sampling import ViewSampler
from vg2gt.evaluation.tables import print_table
from vg2gt.training.loop import build
from vg2gt.types import Batch

SIZE, STEP_SIZE, STORED, VIEWS = (224, 448), (112, 224), (480, 640), 8
PAPER_SECONDS = 49.5 * 3600 / 420_000
"""Of a step (paper, Implementation Details)."""


def write_data(folder: Path, scenes: int) -> dict[str, list[str]]:
    """Writes the recordings in every form; returns the overrides by which each is read."""
    settings = SceneSettings(size=STORED)
    for _ in write_scenes(folder / "png", missing_scenes(folder / "png", scenes, 0, settings), settings):
        pass
    for path in sorted((folder / "png").rglob("*")):
        target = folder / "jpeg" / path.relative_to(folder / "png")
        if path.is_dir():
            target.mkdir(parents=True)
        elif path.parent.name == "images":
            Image.open(path).save(target.with_suffix(".jpg"), quality=90)
        elif path.parent != folder / "png":
            target.write_bytes(path.read_bytes())
    recordings = RGBDFolder(str(folder / "png"), holdout=None)
    write_shards(recordings, folder / "shards" / "train", Encoding(SIZE))
    write_shards(recordings, folder / "jpeg_shards" / "train", Encoding(SIZE, quality=90))
    files = ["data=rgbd", "data.holdout=null", "data.memory_mb=0"]
    shards = ["data=shards", "data.memory_mb=0"]
    return {
        "PNG files": [*files, f"data.root={folder / 'png'}"],
        "JPEG files": [*files, f"data.root={folder / 'jpeg'}"],
        "shards, PNG": [*shards, f"data.root={folder / 'shards'}"],
        "shards, JPEG": [*shards, f"data.root={folder / 'jpeg_shards'}"],
        "memory": [*files, f"data.root={folder / 'png'}", "data.memory_mb=4096"],
    }


def configure(overrides: list[str], workers: int, steps: int, size: tuple[int, int]) -> Any:
    """The training configuration of one measurement."""
    views = [f"data.{name}_views={VIEWS}" for name in ("min", "max")]
    fixed = [f"data.image_size=[{size[0]},{size[1]}]", f"data.max_images={VIEWS}", "data.target_views=0"]
    fixed += [f"data.workers={workers}", f"data.steps_per_epoch={steps}", "trainer.accelerator=cpu"]
    return compose("train", "output_dir=.", *overrides, *views, *fixed)


def batches(overrides: list[str], workers: int, steps: int, size: tuple[int, int] = SIZE) -> Iterator[Batch]:
    """Training batches; evaluation, for which the temporary data has no scenes, is left out."""
    data = configure(overrides, workers, steps, size).data
    data.val = {"_target_": "vg2gt.data.SyntheticScenes", "num_scenes": 1, "num_frames": 12}
    data.eval_scenes = 0
    return iter(instantiate(data).train_dataloader())


def speed(overrides: list[str], workers: int, steps: int) -> dict[str, float]:
    """Images per second by the clock, and per second of processor time where the process itself decodes."""
    list(batches(overrides, 0, 3))  # warms the disk's cache
    loader = batches(overrides, workers, steps)
    warm = 2 + 2 * workers  # workers begin by reading ahead
    for _ in range(warm):
        next(loader)
    clock, used = time.perf_counter(), time.process_time()
    count = sum(batch.images.shape[0] * batch.images.shape[1] for batch in loader)
    found = {"images_per_second": count / (time.perf_counter() - clock)}
    if not workers:
        found["images_per_core_second"] = count / (time.process_time() - used)
    return found


def waiting(overrides: list[str], workers: int, steps: int) -> dict[str, float]:
    """Seconds of a training step of the default model on a CPU, and seconds that it waits for its batch before."""
    run = build(configure(overrides, workers, steps, STEP_SIZE))
    step_loss = training_step(run)
    optimizer = torch.optim.AdamW(run.module.model.trained_parameters(), lr=1e-4)
    loader, waits, works = batches(overrides, workers, steps, STEP_SIZE), [], []
    for _ in range(steps):
        start = time.perf_counter()
        batch = next(loader)
        ready = time.perf_counter()
        step_loss(batch).backward()
        optimizer.step()
        optimizer.zero_grad()
        waits.append(ready - start)
        works.append(time.perf_counter() - ready)
    kept = range(2, steps)
    return {name: sum(times[i] for i in kept) / len(kept) for name, times in (("wait", waits), ("step", works))}


def paper_demand() -> float:
    """Images per second that a device of the paper took, with our sampler's filling of a step (18 images at most)."""
    sampler = ViewSampler(3, 18, 18)
    drawn = [sampler.num_views(step) * sampler.num_scenes(step) for step in range(5000)]
    return sum(drawn) / len(drawn) / PAPER_SECONDS


def main() -> None:
    """Measures, prints and writes."""
    options = parser(__doc__)
    options.add_argument("--quick", action="store_true", help="few batches, no training steps")
    options.add_argument("--workers", type=int, nargs="*", default=[0, 1, 2])
    options.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="of the training step")
    arguments = options.parse_args()
    torch.set_num_threads(1)  # as in a worker process
    steps = 12 if arguments.quick else 30
    with tempfile.TemporaryDirectory() as folder:
        forms = write_data(Path(folder), scenes=2 if arguments.quick else 4)
        list(batches(forms["resized frames"], 0, steps))  # fills the cache
        speeds = {
            form: {str(workers): speed(overrides, workers, steps) for workers in arguments.workers}
            for form, overrides in forms.items()
        }
        torch.set_num_threads(arguments.threads)
        pairs = (
            []
            if arguments.quick
            else [("PNG files", 0), ("PNG files", 1), ("resized frames", 0), ("resized frames", 1)]
        )
        waits = {f"{form}, {workers} workers": waiting(forms[form], workers, 8) for form, workers in pairs}

    rows = []
    for form, found in speeds.items():
        row = [f"{values['images_per_second']:.0f}" for values in found.values()]
        rows.append([form, *row, f"{found['0']['images_per_core_second']:.0f}" if "0" in found else ""])
    title = f"images per second, {STORED[1]}x{STORED[0]} RGB-D to {SIZE[0]}x{SIZE[1]}, by workers"
    print_table(["read from", *map(str, arguments.workers), "per core second"], rows, title=title)
    demand = paper_demand()
    print(f"the paper's training takes about {demand:.0f} images per second on each of two devices")
    for name, value in waits.items():
        print(f"{name}: a step of {VIEWS} images takes {value['step']:.2f} s and waits {value['wait']:.3f} s")
    content = {
        "machine": machine(),
        "speeds": speeds,
        "training_step_seconds": waits,
        "images_per_step": VIEWS,
        "paper_images_per_second": demand,
        "threads": arguments.threads,
        "load_average": os.getloadavg(),
    }
    write_results(arguments.out, "data-loading-cpu", content)


if __name__ == "__main__":
    main()
