"""COLMAP models with undistorted images."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from vg2gt.data import Frames
from vg2gt.data.sources import COLMAP
from vg2gt.geometry.cameras import unproject
from vg2gt.io import ColmapModel, ColmapPoints, colmap_from_views, write_colmap
from vg2gt.types import Cameras

from .layouts import SIZE, Layout, pixels, save

POINTS_A_VIEW = 60


def write(root: Path, frames: Frames, text: bool = False) -> None:
    """``images/left/`` and ``sparse/0``, with points at pixels of every view."""
    cameras = Cameras(frames.world_to_camera[None].double(), frames.intrinsics[None].double(), SIZE)
    names = [f"left/{9 * i:03d}.png" for i in range(len(frames.images))]
    for name, image in zip(names, pixels(frames), strict=True):
        save(root / "statue" / "images" / name, image)
    world = unproject(frames.depth[None].double(), cameras)[0].numpy()
    write_colmap(root / "statue" / "sparse" / "0", _with_points(colmap_from_views(cameras, names), world), text=text)


def _with_points(model: ColmapModel, world: np.ndarray) -> ColmapModel:
    """Points of random pixels; two more views see each of them, outside their images, which makes tracks of three."""
    count, k = len(world), POINTS_A_VIEW
    pixel = np.random.default_rng(0).integers((0, 0), SIZE, (count, k, 2))
    images, places = {}, np.concatenate((pixel[..., ::-1] + 0.5, np.full((count, 2 * k, 2), -10.0)), 1)
    for view, image in enumerate(model.images.values()):
        owners = [(view - step) % count for step in range(3)]
        numbers = np.concatenate([owner * k + np.arange(k) + 1 for owner in owners])
        images[image.id] = replace(image, points2d=places[view], point3d_ids=numbers)
    tracks = [((view + step) % count + 1, step * k + i) for view in range(count) for i in range(k) for step in range(3)]
    points = ColmapPoints(
        np.arange(1, count * k + 1),
        np.concatenate([world[view, pixel[view, :, 0], pixel[view, :, 1]] for view in range(count)]),
        np.full((count * k, 3), 128, np.uint8),
        np.zeros(count * k),
        np.array(tracks),
        np.full(count * k, 3),
    )
    return replace(model, images=images, points=points)


def _read(root: Path, depth: str | None = None) -> COLMAP:
    return COLMAP(str(root), depth=depth)


LAYOUTS = {
    "colmap_binary": Layout(write, _read, depth_quantum=None),
    "colmap_text": Layout(partial(write, text=True), _read, depth_quantum=None),
    # Points are stored in float64: their depth is exact.
    "colmap_points": Layout(write, partial(_read, depth="points"), depth_quantum=lambda depth: depth * 2e-6),
}
