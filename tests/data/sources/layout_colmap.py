"""COLMAP models with undistorted images."""

from functools import partial
from pathlib import Path

import numpy as np

from vg2gt.data import Frames
from vg2gt.data.sources import COLMAP
from vg2gt.geometry.cameras import unproject
from vg2gt.io import colmap_from_views, write_colmap
from vg2gt.types import Cameras

from .layouts import SIZE, Layout, cameras_of, pixels, save

POINTS_A_VIEW = 60


def write(root: Path, frames: Frames, text: bool = False) -> None:
    """``images/left/`` and ``sparse/0``, with points at pixels of every view."""
    cameras = cameras_of(frames)
    names = [f"left/{9 * i:03d}.png" for i in range(len(frames.images))]
    for name, image in zip(names, pixels(frames), strict=True):
        save(root / "statue" / "images" / name, image)
    world = unproject(frames.depth[None].double(), cameras)[0].numpy()
    folder, model = root / "statue" / "sparse" / "0", model_of(cameras, names, world)
    write_colmap(folder, model)
    if text:
        model.write_text(folder)
        for path in folder.glob("*.bin"):
            path.unlink()


def model_of(cameras: Cameras, names: list[str], world: np.ndarray, track: int = 3):
    """Points of random pixels of every view; ``track - 1`` more views see each of them, outside their images."""
    count, k = len(world), POINTS_A_VIEW
    pixel = np.random.default_rng(0).integers((0, 0), SIZE, (count, k, 2))
    positions = np.concatenate([world[view, pixel[view, :, 0], pixel[view, :, 1]] for view in range(count)])
    points = np.arange(count * k)
    owner = points // k
    views = np.concatenate([(owner + step) % count for step in range(track)])
    outside = np.full((count * k, 2), -10.0)
    places = np.concatenate([pixel.reshape(-1, 2)[:, ::-1], *([outside] * (track - 1))])
    return colmap_from_views(cameras, names, positions, sources=(np.tile(points, track), views, places))


LAYOUTS = {
    "colmap_binary": Layout(write, COLMAP, depth_quantum=None),
    "colmap_text": Layout(partial(write, text=True), COLMAP, depth_quantum=None),
    # Points are stored in float64: their depth is exact.
    "colmap_points": Layout(write, partial(COLMAP, depth="points"), depth_quantum=lambda depth: depth * 2e-6),
}
