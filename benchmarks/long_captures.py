"""Long captures: ``python benchmarks/long_captures.py make|run|alone FOLDER``.

``make`` renders a walk through a corridor of furnished rooms as an RGB-D recording, and holds out every twentieth
frame. It can resume. ``run`` reconstructs the walk in windows, and measures peak memory, CPU time of every window, and
PSNR on the held-out frames. ``alone`` reconstructs some rooms, each at once from its own frames, and compares PSNR on
the same held-out frames; it needs the result of ``run``. Each prints JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from examples.write_recordings import stored_depth
from vg2gt.data.sources.rgbd import RGBDFolder
from vg2gt.data.synthetic.builder import Builder
from vg2gt.data.synthetic.furniture import MAKERS
from vg2gt.data.synthetic.renderer import World
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene, level_poses
from vg2gt.metrics import psnr
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.scene import Scene, render_views
from vg2gt.runs.load import load_model

LENGTH, WIDTH, HEIGHT = 4.0, 5.0, 2.6  # metres of a room
DOOR, LINTEL = 1.3, 2.1
HELD_OUT = 20  # hold out every 20th frame


class Corridor(SyntheticScene):
    """A row of rooms connected by doors, and a walk through all of them that looks around in each.

    Args:
        rooms: number of rooms.
        frames: number of frames of the walk.
        size: image ``(height, width)``.
        seed: random seed.
    """

    def __init__(self, rooms: int, frames: int, size: tuple[int, int], seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        builder = Builder(rng)
        lights = []
        for room in range(rooms):
            middle = np.array([(room + 0.5) * LENGTH, 0.0, 0.0])
            builder.place(middle, 0.0)
            for y in (-1, 1):  # panels on the long walls give every room its own wall materials
                builder.box((0, y * (WIDTH / 2 - 0.01), HEIGHT / 2), (LENGTH, 0.02, HEIGHT), builder.new_material())
            builder.box((0, 0, 0.005), (LENGTH, WIDTH, 0.01), builder.new_material())
            if room:
                wall, side = builder.new_material(), (WIDTH - DOOR) / 2
                builder.place(middle - (LENGTH / 2, 0, 0), 0.0)
                for y in (-1, 1):
                    builder.box((0, y * (DOOR + side) / 2, HEIGHT / 2), (0.1, side, HEIGHT), wall)
                builder.box((0, 0, (HEIGHT + LINTEL) / 2), (0.1, DOOR, HEIGHT - LINTEL), wall)
            for y in (-1, -1, 1, 1):
                place = middle + np.array([rng.uniform(-0.4, 0.4) * LENGTH, y * rng.uniform(1.5, 2.0), 0.0])
                builder.place(place, rng.uniform(0, 2 * np.pi))
                MAKERS[rng.integers(len(MAKERS))](builder)
            if room % 2 == 0:
                lights.append([*middle[:2], HEIGHT - 0.3, *rng.uniform(0.5, 0.7, 3)])
        builder.end_group()
        shell = np.array([builder.new_material() for _ in range(6)])
        extent = np.array([[0.0, -WIDTH / 2, 0.0], [rooms * LENGTH, WIDTH / 2, HEIGHT]])
        world = World(extent, shell, lights=np.array(lights[:4]), ambient=0.7, **builder.arrays())
        s = np.linspace(0, rooms, frames, endpoint=False)
        place = np.stack((0.4 + s * (rooms * LENGTH - 0.8) / rooms, 0.3 * np.sin(5 * s), 1.5 + 0.1 * np.sin(9 * s)), 1)
        super().__init__(world, level_poses(place, 1.3 * np.sin(2 * np.pi * s), -0.15 + 0.1 * np.sin(4 * s)), 1.3, size)


def make(folder: Path, rooms: int, frames: int, size: tuple[int, int]) -> None:
    """Renders missing frames of the recording; ``held`` has the held-out frames, ``walk`` all others."""
    scene = Corridor(rooms, frames, size)
    kept = {"held": [i for i in range(frames) if i % HELD_OUT == HELD_OUT // 2]}
    kept["walk"] = sorted(set(range(frames)) - set(kept["held"]))
    for name, numbers in kept.items():
        for kind in ("images", "depth"):
            (folder / name / kind).mkdir(parents=True, exist_ok=True)
        np.savetxt(folder / name / "poses.txt", np.linalg.inv(scene.world_to_camera[numbers]).reshape(-1, 16))
        np.savetxt(folder / name / "K.txt", scene.intrinsics)
        for number in numbers:
            path = folder / name / "depth" / f"{number:05d}.png"
            if not path.is_file():
                (frame,) = scene.render([number], 1)
                Image.fromarray(frame.image).save(folder / name / "images" / f"{number:05d}.png")
                Image.fromarray(stored_depth(frame.depth)).save(path)


class Clock(Monitor):
    """Records the CPU time of every step of every stage that reports progress."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: dict[str, list[float]] = {}

    @contextmanager
    def stage(self, name: str, total: int = 1) -> Iterator[Callable[..., None]]:
        """See :meth:`Monitor.stage`."""
        before = time.process_time()

        def advance(done: float | None = None, note: str = "") -> None:
            nonlocal before
            now = time.process_time()
            self.steps.setdefault(name, []).append(now - before)
            before = now
            print(f"{name} {len(self.steps[name])} of {total}", file=sys.stderr, flush=True)

        yield advance


def score(scene: Scene, folder: Path, numbers: set[int] | None = None) -> dict[int, float]:
    """Returns the PSNR of held-out frames by number; the scene must be in the recording's world frame."""
    source = RGBDFolder(str(folder / "held"), holdout=None)
    (name,) = source.scenes
    index, camera = source.scene_index(name), replace(scene.named_cameras()[0], photo=None)
    found = {}
    for row, frame in enumerate(index.frame_ids):
        number = int(index.color[row].stem)
        if numbers is not None and number not in numbers:
            continue
        loaded = source.load_whole(name, frame)
        camera = replace(camera, world_to_camera=index.world_to_camera[row])
        (view,) = render_views(scene.renderer, scene.gaussians, [camera])
        found[number] = float(psnr(view.color[None], loaded.images[:1])[0])
    return found


def run(folder: Path, window: int, overrides: list[str]) -> None:
    """Reconstructs the walk in windows; keeps intermediate results in ``FOLDER/windows``, so that it can resume."""
    ready, clock = load_model(overrides=overrides, device="cpu"), Clock()
    begin = time.process_time()
    scene = reconstruct_with(
        ready.model,
        folder / "walk",
        window=window,
        window_folder=folder / "windows",
        renderer=ready.renderer,
        monitor=clock,
    )
    total = time.process_time() - begin
    scores = score(scene, folder)
    found = {
        "views": len(scene.names),
        "gaussians": len(scene.gaussians),
        "peak_mib": round(clock.peak_memory_mib),
        "core_seconds": round(total, 1),
        "seconds": {name: round(sum(times), 1) for name, times in clock.steps.items()},
        "second_half_over_first": {
            name: round(sum(times[-(len(times) // 2) :]) / sum(times[: len(times) // 2]), 3)
            for name, times in clock.steps.items()
            if len(times) > 9
        },
        "psnr": round(float(np.mean(list(scores.values()))), 3),
        "scores": {str(number): round(value, 3) for number, value in scores.items()},
    }
    (folder / "run.json").write_text(json.dumps(found))
    print(json.dumps({name: value for name, value in found.items() if name != "scores"}))


def alone(folder: Path, rooms: int, frames: int, chosen: list[int], overrides: list[str]) -> None:
    """Reconstructs some rooms, each from its own frames; compares PSNR on held-out frames with that of ``run``."""
    ready = load_model(overrides=overrides, device="cpu")
    whole = {int(number): value for number, value in json.loads((folder / "run.json").read_text())["scores"].items()}
    files = sorted((folder / "walk" / "images").iterdir())
    for room in chosen:
        inside = range(frames * room // rooms, frames * (room + 1) // rooms)
        scene = reconstruct_with(
            ready.model, [path for path in files if int(path.stem) in inside], window=0, renderer=ready.renderer
        )
        scores = score(scene, folder, set(inside))
        ours = np.mean([whole[number] for number in scores])
        theirs = np.mean(list(scores.values()))
        print(json.dumps({"room": room, "alone": round(float(theirs), 3), "walk": round(float(ours), 3)}))


def main() -> None:
    """Runs the command line."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("what", choices=("make", "run", "alone"))
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("--rooms", type=int, default=20)
    arguments.add_argument("--frames", type=int, default=1000)
    arguments.add_argument("--size", type=int, nargs=2, default=(64, 96))
    arguments.add_argument("--window", type=int, default=24)
    arguments.add_argument("--chosen", type=int, nargs="*", default=[3, 10, 16])
    options, overrides = arguments.parse_known_args()
    torch.manual_seed(0)
    if options.what == "make":
        make(options.folder, options.rooms, options.frames, tuple(options.size))
    elif options.what == "run":
        run(options.folder, options.window, overrides)
    else:
        alone(options.folder, options.rooms, options.frames, options.chosen, overrides)


if __name__ == "__main__":
    main()
