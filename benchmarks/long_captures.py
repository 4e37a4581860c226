"""Long captures: ``python benchmarks/long_captures.py make|run|alone FOLDER``.

``make`` renders a walk through a corridor of furnished rooms as an RGB-D recording, and holds out every twentieth
frame. ``run`` reconstructs the walk in windows, and measures peak memory, the wall time of every stage, and PSNR on the
held-out frames. ``alone`` reconstructs some rooms, each at once from its own frames, and compares PSNR on the same
held-out frames; it needs the result of ``run``. Each prints JSON.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from examples.write_recordings import write_recording
from vg2gt.data import Frames
from vg2gt.data.sources.rgbd import RGBDFolder
from vg2gt.data.synthetic.builder import Builder
from vg2gt.data.synthetic.furniture import MAKERS
from vg2gt.data.synthetic.renderer import World
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene, level_poses
from vg2gt.data.transforms import from_bytes
from vg2gt.io.files import read_json, write_json
from vg2gt.metrics import psnr
from vg2gt.monitor import Monitor
from vg2gt.reconstruction.pipeline import reconstruct_with
from vg2gt.reconstruction.scene import Scene, render_views
from vg2gt.runs.load import LoadedModel, load_model

LENGTH, WIDTH, HEIGHT = 4.0, 5.0, 2.6  # metres of a room
DOOR, LINTEL = 1.3, 2.1
HELD_OUT = 20  # hold out every 20th frame
SIZE = (64, 96)  # height and width
CHOSEN = (3, 10, 16)  # rooms that are reconstructed alone


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


def make(folder: Path, scene: SyntheticScene, parts: dict[str, list[int]]) -> None:
    """Writes a recording of the frames of each part, unless it exists."""
    for name, numbers in parts.items():
        if (folder / name).exists():
            continue
        frames = scene.render(numbers, 1)
        images = from_bytes(torch.from_numpy(np.stack([frame.image for frame in frames]))).permute(0, 3, 1, 2)
        poses = torch.from_numpy(scene.world_to_camera[numbers])
        intrinsics = torch.from_numpy(scene.intrinsics).expand(len(numbers), 3, 3)
        depth = torch.from_numpy(np.stack([frame.depth for frame in frames]))
        write_recording(folder / name, Frames(images, depth, poses, intrinsics))


def score(scene: Scene, folder: Path, numbers: Sequence[int], chosen: Sequence[int]) -> dict[int, float]:
    """Returns the PSNR of the chosen held-out frames by number; the scene must be in the recording's world frame."""
    source = RGBDFolder(str(folder / "held"), holdout=None)
    (name,) = source.scenes
    rows = [row for row, number in enumerate(numbers) if number in chosen]
    frames, camera = source.load(name, rows), replace(scene.named_cameras()[0], photo=None)
    cameras = [replace(camera, world_to_camera=pose.double().numpy()) for pose in frames.world_to_camera]
    views = render_views(scene.renderer, scene.gaussians, cameras)
    found = [float(psnr(view.color[None], image[None])[0]) for view, image in zip(views, frames.images, strict=True)]
    return {numbers[row]: round(value, 3) for row, value in zip(rows, found, strict=True)}


def run(folder: Path, ready: LoadedModel, window: int, held: Sequence[int]) -> None:
    """Reconstructs the walk in windows; keeps intermediate results in ``FOLDER/windows``, so that it can resume."""
    monitor, begin, kept = Monitor(), time.process_time(), folder / "windows"
    scene = reconstruct_with(
        ready.model, folder / "walk", window=window, window_folder=kept, renderer=ready.renderer, monitor=monitor
    )
    total = time.process_time() - begin
    scores = score(scene, folder, held, held)
    found = {
        "views": len(scene.names),
        "gaussians": len(scene.gaussians),
        "peak_mib": round(monitor.peak_memory_mib),
        "core_seconds": round(total, 1),
        "wall_seconds": {name: round(seconds, 1) for name, seconds in monitor.seconds.items()},
        "psnr": round(statistics.mean(scores.values()), 3),
    }
    print(json.dumps(found))
    write_json(folder / "run.json", found | {"scores": scores})


def alone(folder: Path, ready: LoadedModel, rooms: int, parts: dict[str, list[int]]) -> None:
    """Reconstructs some rooms, each from its own frames; compares PSNR on held-out frames with that of ``run``."""
    whole = read_json(folder / "run.json")["scores"]
    files = sorted((folder / "walk" / "images").iterdir())
    frames = len(parts["walk"]) + len(parts["held"])
    for room in (room for room in CHOSEN if room < rooms):
        inside = range(frames * room // rooms, frames * (room + 1) // rooms)
        photos = [path for path, number in zip(files, parts["walk"], strict=True) if number in inside]
        scene = reconstruct_with(ready.model, photos, window=0, renderer=ready.renderer)
        scores = score(scene, folder, parts["held"], inside)
        walk = statistics.mean(whole[str(number)] for number in scores)
        print(json.dumps({"room": room, "alone": round(statistics.mean(scores.values()), 3), "walk": round(walk, 3)}))


def main() -> None:
    """Runs the command line; other words are overrides of the model."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("what", choices=("make", "run", "alone"))
    arguments.add_argument("folder", type=Path)
    arguments.add_argument("--rooms", type=int, default=20)
    arguments.add_argument("--frames", type=int, default=1000)
    arguments.add_argument("--window", type=int, default=24)
    options, overrides = arguments.parse_known_args()
    torch.manual_seed(0)
    numbers = range(options.frames)
    parts = {"held": list(numbers[HELD_OUT // 2 :: HELD_OUT])}
    parts["walk"] = [number for number in numbers if number % HELD_OUT != HELD_OUT // 2]
    if options.what == "make":
        make(options.folder, Corridor(options.rooms, options.frames, SIZE), parts)
        return
    ready = load_model(overrides=overrides, device="cpu")
    if options.what == "run":
        run(options.folder, ready, options.window, parts["held"])
    else:
        alone(options.folder, ready, options.rooms, parts)


if __name__ == "__main__":
    main()
