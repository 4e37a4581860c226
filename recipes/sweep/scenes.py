"""Training scenes: procedural ones with varied cameras (focal length, roll, shake), and rooms of Infinigen; cached."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from examples.worlds import Worlds
from examples.worlds.photograph import Photograph
from vg2gt.data.sources.infinigen import Infinigen
from vg2gt.data.synthetic.synthetic_scene import LOBES, SyntheticScene
from vg2gt.geometry.cameras import rigid_motions
from vg2gt.io.arrays import read_npz
from vg2gt.io.files import write_cached

FIRST_SEED = 5_000_000  # disjoint from the seeds for training (from 0) and evaluating (from 1,000,000) VG²GT
SIZE = (144, 288)
FRAMES = 14
_STREAM = 77  # separates the random stream of the cameras from that of the scene
_KINDS = ("room", "object", "room", "wide", "object", "room", "landmark", "object", "wide", "outdoor")  # in turn
_WALKS = ("room", "outdoor")
_EXPOSURE, _JPEG = 0.7, (40, 95)  # stops (standard deviation) and quality, in two thirds of the scenes
_PATH_LENGTHS = (14, 20, 32, 44)  # frames of a path, FRAMES of which are rendered; fewer are farther apart


class SceneFrames(NamedTuple):
    """Frames of one scene.

    Attributes:
        images: ``[N, H, W, 3]``, uint8.
        depth: z-depth in metres ``[N, H, W]``, float16; 0 is unknown, infinity is sky.
        world_to_camera: ``[N, 4, 4]``, float32.
        intrinsics: ``[N, 3, 3]``, float32.
    """

    images: Tensor
    depth: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor


def is_room(path: Path) -> bool:
    """Returns whether a cached scene is a room."""
    first = path.stem.split("-")[0]
    return first == "infinigen" or _KINDS[int(first) % len(_KINDS)] in ("room", "wide")


def read_scene(path: Path) -> SceneFrames:
    """Reads a cached scene."""
    arrays = read_npz(path, SceneFrames._fields)
    return SceneFrames(*(torch.from_numpy(arrays[name]) for name in SceneFrames._fields))


def render_scene(seed: int, size: tuple[int, int] = SIZE) -> dict[str, NDArray]:
    """Renders a training scene; the seed determines its kind.

    The scene is one of :mod:`examples.worlds`. Focal length, roll, camera shake, highlights and photographic flaws are
    drawn here, so that matching does not depend on level cameras with a single field of view.

    Args:
        seed: seed of the scene.
        size: height and width of the frames.

    Returns:
        The fields of :class:`SceneFrames`, as arrays.
    """
    rng = np.random.default_rng((_STREAM, seed))
    kind = _KINDS[seed % len(_KINDS)]
    path = int(rng.choice(_PATH_LENGTHS)) if kind in _WALKS else FRAMES
    shine = (False, True, LOBES)[rng.choice(3, p=(0.5, 0.3, 0.2))]
    scene = Worlds.variants[kind](seed, path, size, shine)
    focal = 0.5 * size[1] / np.tan(rng.uniform(0.75, 1.5) / 2)
    if kind in _WALKS or kind == "wide":
        scene.intrinsics = np.array([[focal, 0, (size[1] - 1) / 2], [0, focal, (size[0] - 1) / 2], [0, 0, 1]])
    first = int(rng.integers(0, path - FRAMES + 1))
    frames = np.arange(first, first + FRAMES)
    reach = 1.0 if kind == "room" else float(np.linalg.norm(scene.world_to_camera[:, :3, 3], axis=1).mean()) / 2
    scene.world_to_camera = _shake(scene, rng, 0.06 if kind == "outdoor" else 0.02 * reach)
    photograph = Photograph(_EXPOSURE, _JPEG)
    if rng.random() < 0.67:
        scene.develop = partial(photograph.develop, seed)
    rendered = scene.render(frames.tolist(), 1, samples=1)
    depth = np.stack([frame.depth for frame in rendered])
    return {
        "images": np.stack([frame.image for frame in rendered]),
        "depth": np.where(depth > 0, depth, np.inf).astype(np.float16),
        "world_to_camera": scene.world_to_camera[frames].astype(np.float32),
        "intrinsics": np.tile(scene.intrinsics.astype(np.float32), (FRAMES, 1, 1)),
    }


def _shake(scene: SyntheticScene, rng: np.random.Generator, metres: float) -> NDArray[np.float64]:
    """World-to-camera poses ``[N, 4, 4]`` with a common roll, and small random motions of each frame."""
    count = len(scene.world_to_camera)
    turns = rng.normal(0, 0.03, (count, 3))
    turns[:, 2] += rng.normal(0, 0.12)
    shifts = rng.normal(0, metres, (count, 3))
    motion = rigid_motions(torch.from_numpy(turns), torch.from_numpy(shifts)).numpy()
    return np.asarray(motion @ scene.world_to_camera, np.float64)


def make_scenes(
    folder: str | os.PathLike[str],
    count: int,
    first_seed: int = FIRST_SEED,
    size: tuple[int, int] = SIZE,
    workers: int = 1,
) -> Iterator[Path]:
    """Renders scenes into a folder, unless they exist; yields the file of each.

    Args:
        folder: output folder, created if needed.
        count: number of scenes.
        first_seed: seed of the first scene; the others have consecutive seeds.
        size: height and width of the frames.
        workers: number of processes that render; 1 renders in this process.
    """
    root = Path(folder).expanduser()
    seeds = range(first_seed, first_seed + count)
    make = partial(_make_scene, root, (size[0], size[1]))
    if workers == 1:
        yield from map(make, seeds)
        return
    yield make(first_seed)  # compiles the kernels, which the workers then load from the cache
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(make, seeds[1:], chunksize=4)


def _make_scene(root: Path, size: tuple[int, int], seed: int) -> Path:
    path = root / f"{seed:08d}-{size[0]}x{size[1]}.npz"
    if not path.is_file():
        _write(path, render_scene(seed, size), root)
    return path


def read_infinigen(folder: str | os.PathLike[str], cache: str | os.PathLike[str]) -> list[Path]:
    """Converts all rooms in ``folder`` to files in ``cache`` that load quickly; returns these files.

    Views through windows count as sky.
    """
    root, paths = Path(cache).expanduser(), []
    source = Infinigen(str(folder))
    for scene in source.scenes:
        path = root / f"infinigen-{scene.replace('/', '-')}.npz"
        if not path.is_file():
            frames = source.load(scene, source.frames(scene))
            depth = frames.depth.numpy()
            arrays = {
                "images": (frames.images.permute(0, 2, 3, 1) * 255).round().byte().numpy(),
                "depth": np.where(depth > 0, depth, np.inf).astype(np.float16),
                "world_to_camera": frames.world_to_camera.numpy().astype(np.float32),
                "intrinsics": frames.intrinsics.numpy().astype(np.float32),
            }
            _write(path, arrays, root)
        paths.append(path)
    return paths


def _write(path: Path, arrays: dict[str, NDArray], root: Path) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    write_cached(path, buffer.getvalue(), root)
