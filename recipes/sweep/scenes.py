"""Procedural training scenes with free cameras (focal length, roll, shake), rendered once and cached."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vg2gt.data.synthetic.outdoor import SyntheticOutdoor
from vg2gt.data.synthetic.rooms import SyntheticRoom
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene
from vg2gt.geometry.cameras import rigid_motions
from vg2gt.io.files import write_cached
from vg2gt.io.npz import read_npz

FIRST_SEED = 5_000_000  # far from the seeds that VG²GT is trained (0 ...) and evaluated (1,000,000 ...) on
SIZE = (144, 288)
FRAMES = 14
_STREAM = 77  # tells the random stream of the cameras from that of the scene
_PATH_LENGTHS = (14, 20, 32, 44)  # of the whole path, of which FRAMES consecutive ones are taken: fewer are wider apart


class SceneFrames(NamedTuple):
    """Consecutive frames of one scene.

    Attributes:
        images: ``[N, H, W, 3]`` uint8.
        depth: ``[N, H, W]`` z-depth in metres, float16, 0 in the sky.
        world_to_camera: ``[N, 4, 4]`` float32.
        intrinsics: ``[3, 3]`` float32.
    """

    images: Tensor
    depth: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor


def scene_file(folder: Path, seed: int) -> Path:
    """Where the frames of a seed are kept."""
    return folder / f"{seed:08d}.npz"


def read_scene(path: Path) -> SceneFrames:
    """Reads a cached scene."""
    arrays = read_npz(path, SceneFrames._fields)
    return SceneFrames(*(torch.from_numpy(arrays[name]) for name in SceneFrames._fields))


def render_scene(seed: int, threads: int = 1) -> dict[str, NDArray]:
    """Renders one training scene; every fifth is outdoors.

    The world is that of :mod:`vg2gt.data.synthetic`; focal length, roll, shake and highlights are drawn here, because
    photographs have them and matching must not depend on level cameras of one field of view.
    """
    rng = np.random.default_rng((_STREAM, seed))
    outdoor = seed % 5 == 4
    path = int(rng.choice(_PATH_LENGTHS))
    scene = (SyntheticOutdoor if outdoor else SyntheticRoom)(seed, path, SIZE, bool(rng.random() < 0.4))
    focal = 0.5 * SIZE[1] / np.tan(rng.uniform(0.75, 1.5) / 2)
    scene.intrinsics = np.array([[focal, 0, (SIZE[1] - 1) / 2], [0, focal, (SIZE[0] - 1) / 2], [0, 0, 1]])
    first = int(rng.integers(0, path - FRAMES + 1))
    frames = np.arange(first, first + FRAMES)
    scene.world_to_camera = _shake(scene, rng, 0.06 if outdoor else 0.02)
    rendered = scene.render(frames.tolist(), threads, samples=1)
    return {
        "images": np.stack([frame.image for frame in rendered]),
        "depth": np.stack([frame.depth for frame in rendered]).astype(np.float16),
        "world_to_camera": scene.world_to_camera[frames].astype(np.float32),
        "intrinsics": scene.intrinsics.astype(np.float32),
    }


def _shake(scene: SyntheticScene, rng: np.random.Generator, metres: float) -> NDArray[np.float64]:
    """World-to-camera ``[N, 4, 4]`` turned by one roll for all frames and a little, and moved a little, for each."""
    count = len(scene.world_to_camera)
    turns = rng.normal(0, 0.03, (count, 3))
    turns[:, 2] += rng.normal(0, 0.12)
    shifts = rng.normal(0, metres, (count, 3))
    motion = rigid_motions(torch.from_numpy(turns), torch.from_numpy(shifts)).numpy()
    return np.asarray(motion @ scene.world_to_camera, np.float64)


def make_scenes(folder: str | os.PathLike[str], count: int, first_seed: int = FIRST_SEED) -> Iterator[Path]:
    """Renders ``count`` scenes into ``folder``, those that are there already left out; yields every file."""
    root = Path(folder).expanduser()
    for seed in range(first_seed, first_seed + count):
        path = scene_file(root, seed)
        if not path.is_file():
            buffer = io.BytesIO()
            np.savez(buffer, **render_scene(seed))  # pyright: ignore[reportArgumentType]
            write_cached(path, buffer.getvalue(), root)
        yield path
