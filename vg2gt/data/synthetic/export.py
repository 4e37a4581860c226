"""Writes synthetic scenes as RGB-D recordings, which ``data=rgbd data.root=FOLDER`` reads.

A scene is a folder with ``images/NNNNN.png``, ``depth/NNNNN.png`` (uint16, ``depth_scale`` units per metre, 0 = none),
``poses.txt`` (camera-to-world, 16 numbers per line), ``K.txt`` and, if asked for, ``normals/NNNNN.npz`` (``normals``,
float16 ``[H, W, 3]`` in the camera frame, 0 in the sky). Depth that 16 bits cannot hold, beyond 65.534 m at the default
scale, is written as none.
"""

from __future__ import annotations

import io
import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vg2gt.data.base import DataError
from vg2gt.data.synthetic.source import VARIANTS, SyntheticScenes
from vg2gt.io.files import read_json, write_json

SETTINGS_FILE = "synthetic.json"
_UNFINISHED = ".unfinished"  # scenes lie three folders deep in it, where no reader of recordings looks
_MAX_STORED = 65534  # 65535 often means "no depth"
_COMPRESSION = 3  # of PNG: a third of the time of the usual 6, a few percent larger


@dataclass(frozen=True)
class SceneSettings:
    """What decides the content of a written scene besides its seed.

    Args:
        frames: frames per scene.
        size: image ``(height, width)``.
        variant: as in :class:`SyntheticScenes`.
        highlights: as in :class:`SyntheticScenes`.
        normals: write normals too.
        depth_scale: stored depth units per metre.
        exposure: as in :class:`SyntheticScenes`.
        jpeg: the same; the files are PNG all the same.
    """

    frames: int = 16
    size: tuple[int, int] = (224, 448)
    variant: Any = "room"
    highlights: Any = False
    normals: bool = False
    depth_scale: float = 1000.0
    exposure: float = 0.0
    jpeg: Any = None

    def source(self, scenes: int, first_seed: int) -> SyntheticScenes:
        """The scenes, as they are written."""
        return SyntheticScenes(
            scenes, first_seed, self.frames, self.size, self.variant, self.highlights, None, self.exposure, self.jpeg
        )


def missing_scenes(out: Path, scenes: int, first_seed: int, settings: SceneSettings) -> list[str]:
    """Claims the folder ``out`` and lists the scenes that it does not hold yet.

    Args:
        out: folder of the recordings; new, empty, or written with the same settings.
        scenes: how many it is to hold.
        first_seed: seed of the first.
        settings: what a scene holds.

    Raises:
        DataError: if ``out`` holds something else.
        ValueError: if a setting is out of range.
    """
    size = settings.size
    if not settings.depth_scale > 0 or len(size) != 2 or min(size) < 1:
        raise ValueError(
            f"depth_scale must be positive and size two positive numbers; got {settings.depth_scale} and {list(size)}"
        )
    source = settings.source(scenes, first_seed)
    _claim(out, settings)
    return [name for name in source.scenes if not (out / name).exists()]


def write_scenes(out: Path, names: Sequence[str], settings: SceneSettings, workers: int = 1) -> Iterator[str]:
    """Writes scenes; yields their names as they are finished.

    A scene is written elsewhere and renamed, so a scene that is there is whole. The files do not depend on the number
    of workers.

    Args:
        out: the folder that ``missing_scenes`` claimed.
        names: what it listed.
        settings: the same.
        workers: processes; 1 works in this one.
    """
    write = partial(_write_scene, out, settings)
    yield from map(write, names) if workers == 1 else _in_processes(write, names, workers)
    if (out / _UNFINISHED).is_dir() and not any((out / _UNFINISHED).iterdir()):
        (out / _UNFINISHED).rmdir()


def _claim(out: Path, settings: SceneSettings) -> None:
    """Writes the settings into a new folder; refuses one with other settings or with other content."""
    variants = settings.variant if isinstance(settings.variant, str) else list(settings.variant)
    used = {variants} if isinstance(variants, str) else set(variants)
    versions = {name: scene.version for name, scene in VARIANTS.items() if name in used}
    jpeg = None if settings.jpeg is None else list(settings.jpeg)
    wanted = asdict(settings) | {
        "size": list(settings.size), "variant": variants, "jpeg": jpeg, "versions": versions,
    }  # fmt: skip
    path = out / SETTINGS_FILE
    if path.is_file():
        found = {"exposure": 0.0, "jpeg": None} | read_json(path)  # older folders lack what came later
        found["versions"] = {name: version for name, version in found.get("versions", {}).items() if name in used}
        other = [key for key in wanted if found.get(key) != wanted[key]]
        if other:
            differences = ", ".join(f"{key}={found.get(key)} instead of {wanted[key]}" for key in other)
            raise DataError(f"{out} holds scenes made with {differences}: use the same options or another out=FOLDER")
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DataError(f"{out} exists and was not written by this command: choose another out=FOLDER")
    else:
        write_json(path, wanted)


def _in_processes(write: partial[str], names: Sequence[str], workers: int) -> Iterator[str]:
    forks = "forkserver" in get_all_start_methods()
    context = get_context("forkserver" if forks else "spawn")
    if forks:
        context.set_forkserver_preload([__name__])  # imported once, not in every process
    # An interrupt from the keyboard reaches all processes; only this one answers.
    ignore = (signal.SIGINT, signal.SIG_IGN)
    pool = ProcessPoolExecutor(workers, context, initializer=signal.signal, initargs=ignore)
    try:
        waiting = set()
        for name in names:
            waiting.add(pool.submit(write, name))
            if len(waiting) >= 4 * workers:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
    finally:
        pool.shutdown(cancel_futures=True)


def _write_scene(out: Path, settings: SceneSettings, name: str) -> str:
    """Renders one scene and writes it; returns its name."""
    scene = settings.source(1, int(name.rsplit("-", 1)[1])).scene(name)
    place = out / _UNFINISHED / name
    shutil.rmtree(place, ignore_errors=True)
    folder = place / "scene"
    for kind in ("images", "depth", *(["normals"] if settings.normals else [])):
        (folder / kind).mkdir(parents=True)
    for index in range(settings.frames):
        (frame,) = scene.render([index], 1)
        stem = f"{index:05d}"
        Image.fromarray(frame.image).save(folder / "images" / f"{stem}.png", compress_level=_COMPRESSION)
        depth = Image.fromarray(store_depth(frame.depth, settings.depth_scale))
        depth.save(folder / "depth" / f"{stem}.png", compress_level=_COMPRESSION)
        if settings.normals:
            buffer = io.BytesIO()
            np.savez_compressed(buffer, normals=frame.normal.astype(np.float16))
            (folder / "normals" / f"{stem}.npz").write_bytes(buffer.getvalue())
    np.savetxt(folder / "poses.txt", np.linalg.inv(scene.world_to_camera).reshape(-1, 16))
    np.savetxt(folder / "K.txt", scene.intrinsics)
    os.replace(folder, out / name)
    place.rmdir()
    return name


def store_depth(depth: NDArray[np.float32], scale: float) -> NDArray[np.uint16]:
    """Depth ``[H, W]`` in metres as 16-bit integers, 0 where there is none or too much of it."""
    units = np.rint(depth.astype(np.float64) * scale)
    return np.where(units > _MAX_STORED, 0, units).astype(np.uint16)
