"""Training scenes, cached: procedural ones with varied cameras (focal length, roll, shake), slim rooms of Infinigen."""

from __future__ import annotations

import io
import os
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from examples.worlds import Worlds
from examples.worlds.photograph import Photograph
from recipes.infinigen.slim import read_slim
from vg2gt.data.synthetic.synthetic_scene import LOBES, SyntheticScene
from vg2gt.geometry.cameras import rigid_motions
from vg2gt.io.arrays import read_npz
from vg2gt.io.files import write_bytes

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


def scene_files(folder: str | os.PathLike[str], count: int, first_seed: int, size: tuple[int, int]) -> list[Path]:
    """Returns the files of procedural scenes in a folder, which :func:`read_scene` renders when they are first read.

    Args:
        folder: folder of the scenes.
        count: number of scenes.
        first_seed: seed of the first scene; the others have consecutive seeds.
        size: height and width of the frames.
    """
    root = Path(folder).expanduser()
    return [root / f"{seed:08d}-{size[0]}x{size[1]}.npz" for seed in range(first_seed, first_seed + count)]


def read_scene(path: Path) -> SceneFrames:
    """Reads the frames of a scene or of a slim room; renders a procedural scene that is missing, and keeps it."""
    if path.is_file() and path.stem.startswith("room_"):
        arrays = read_slim(path)
    elif path.is_file():
        arrays = read_npz(path, SceneFrames._fields)
    else:
        seed, size = path.stem.split("-")
        height, width = size.split("x")
        arrays = render_scene(int(seed), (int(height), int(width)))
        _write(path, arrays)
    return SceneFrames(*(torch.from_numpy(arrays[name]) for name in SceneFrames._fields))


def render_scene(seed: int, size: tuple[int, int]) -> dict[str, NDArray[Any]]:
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
    images, depth = (np.stack([getattr(frame, name) for frame in rendered]) for name in ("image", "depth"))
    return _arrays(images, depth, scene.world_to_camera[frames], np.tile(scene.intrinsics, (FRAMES, 1, 1)))


def _shake(scene: SyntheticScene, rng: np.random.Generator, metres: float) -> NDArray[np.float64]:
    """World-to-camera poses ``[N, 4, 4]`` with a common roll, and small random motions of each frame."""
    count = len(scene.world_to_camera)
    turns = rng.normal(0, 0.03, (count, 3))
    turns[:, 2] += rng.normal(0, 0.12)
    shifts = rng.normal(0, metres, (count, 3))
    motion = rigid_motions(torch.from_numpy(turns), torch.from_numpy(shifts)).numpy()
    return np.asarray(motion @ scene.world_to_camera, np.float64)


def _arrays(
    images: NDArray[np.uint8], depth: NDArray[Any], poses: NDArray[Any], intrinsics: NDArray[Any]
) -> dict[str, NDArray[Any]]:
    """The fields of :class:`SceneFrames`; where depth is 0, there is sky."""
    sky = np.where(depth > 0, depth, np.inf).astype(np.float16)
    values = (images, sky, poses.astype(np.float32), intrinsics.astype(np.float32))
    return dict(zip(SceneFrames._fields, values, strict=True))


def _write(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # pyright: ignore[reportArgumentType]
    write_bytes(path, buffer.getvalue())
