"""Rendered views as files: a folder of maps of each kind, an animation."""

from __future__ import annotations

import io
import logging
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from vg2gt.io.files import write_bytes
from vg2gt.io.images import colorize_normals
from vg2gt.io.video import require_pyav, write_video
from vg2gt.reconstruction.camera_paths import view_stem
from vg2gt.reconstruction.scene import RenderedView

log = logging.getLogger(__name__)

DEPTH_STEPS = 1000  # stored depth units a scene unit in a 16-bit PNG
_LARGEST = 65535

MAPS = {
    "color.png": "rendered colour, a PNG a view in color/",
    "depth.png": "rendered depth, a 16-bit PNG a view in depth/: thousandths of the scene unit, 0 = none",
    "depth.npy": "rendered depth, a float32 array a view in depth/, scene units, 0 = none",
    "normals.png": "rendered normals, a coloured PNG a view in normals/",
    "normals.npy": "rendered normals, a float32 array [3, H, W] a view in normals/, the camera's frame",
}


class Sink(Protocol):
    """Takes rendered views one by one."""

    def add(self, view: RenderedView) -> None:
        """Takes the next view."""
        ...

    def close(self) -> None:
        """Called after the last view: writes what needs all of them."""
        ...


class MapFolder:
    """Writes one kind of map of every view into a folder, which appears whole when all are there.

    Args:
        folder: the output folder; the maps are in a folder of the kind's name in it.
        kind: ``color``, ``depth`` or ``normals``.
        suffixes: ``.png``, ``.npy`` or both.
    """

    def __init__(self, folder: Path, kind: str, suffixes: Sequence[str]) -> None:
        self.kind = kind
        self.suffixes = tuple(suffixes)
        self.target = folder / kind
        self._staged = _staging(self.target)
        self._written: set[Path] = set()
        self._too_deep = 0

    def add(self, view: RenderedView) -> None:
        """Writes the view's map.

        Raises:
            ValueError: if the view's name leads out of the folder, or another view has it.
        """
        stem = self._staged / view_stem(view.camera.name)
        if not stem.resolve().is_relative_to(self._staged.resolve()):
            raise ValueError(f"a view is called {view.camera.name!r}, which is outside of the output folder; rename it")
        if stem in self._written:
            raise ValueError(f"two views are called {view_stem(view.camera.name)}; rename one of the cameras")
        self._written.add(stem)
        stem.parent.mkdir(parents=True, exist_ok=True)
        values = {"color": view.color, "depth": view.depth, "normals": view.normal}[self.kind]
        for suffix in self.suffixes:
            content = npy(values) if suffix == ".npy" else self._png(values)
            write_bytes(stem.with_name(stem.name + suffix), content)

    def close(self) -> None:
        """Moves the folder to its place."""
        _publish(self._staged, self.target)
        if self._too_deep:
            log.warning(
                "%d pixels deeper than %g scene units do not fit into a 16-bit PNG and stand as 0; save depth.npy",
                self._too_deep, _LARGEST / DEPTH_STEPS,
            )  # fmt: skip

    def discard(self) -> None:
        """Removes what was written and is not at its place."""
        shutil.rmtree(self._staged, ignore_errors=True)

    def _png(self, values: Tensor) -> bytes:
        if self.kind == "depth":
            steps = np.rint(values.numpy().astype(np.float64) * DEPTH_STEPS)
            self._too_deep += int((steps > _LARGEST).sum())
            return png(np.where(steps > _LARGEST, 0, steps).astype(np.uint16))
        return png(to_pixels(colorize_normals(values) if self.kind == "normals" else values))


class Animation:
    """Collects the colour of the views and writes them as an animation.

    Args:
        path: ``.gif`` or ``.mp4``.
        fps: frames a second.

    Raises:
        MissingDecoderError: if it is no GIF and there is no PyAV.
    """

    def __init__(self, path: Path, fps: float) -> None:
        if path.suffix != ".gif":
            require_pyav(f"writing {path.name}")
        self.path = path
        self.fps = fps
        self._frames: list[NDArray[np.uint8]] = []

    def add(self, view: RenderedView) -> None:
        """Keeps the view's colour as 8-bit pixels."""
        self._frames.append(to_pixels(view.color))

    def close(self) -> None:
        """Writes the animation."""
        write_video(self.path, self._frames, self.fps)


def map_sinks(folder: Path, outputs: Sequence[str]) -> list[Sink]:
    """One sink for every kind of map among the outputs."""
    kinds: dict[str, list[str]] = {}
    for output in outputs:
        if output in MAPS:
            kind, suffix = os.path.splitext(output)
            kinds.setdefault(kind, []).append(suffix)
    return [MapFolder(folder, kind, suffixes) for kind, suffixes in kinds.items()]


def feed(views: Iterable[RenderedView], sinks: Sequence[Sink], advance: Callable[[], None]) -> None:
    """Gives every view to every sink and closes them; on an error no half-written folder stays."""
    try:
        for view in views:
            for sink in sinks:
                sink.add(view)
            advance()
        for sink in sinks:
            sink.close()
    finally:
        for sink in sinks:
            if isinstance(sink, MapFolder):
                sink.discard()


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """A folder to write into that takes the place of ``target`` at the end of the block, or vanishes on an error."""
    staged = _staging(target)
    try:
        yield staged
        _publish(staged, target)
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def to_pixels(image: Tensor) -> NDArray[np.uint8]:
    """An image ``[3, H, W]`` in [0, 1] as ``[H, W, 3]`` uint8."""
    return (image.clamp(0, 1).permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)


def png(pixels: NDArray[np.generic]) -> bytes:
    """An 8-bit colour or 16-bit grey image as a PNG file's content."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def npy(values: Tensor) -> bytes:
    """A float32 array as a NumPy file's content."""
    buffer = io.BytesIO()
    np.save(buffer, values.float().numpy())
    return buffer.getvalue()


def _staging(target: Path) -> Path:
    staged = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    shutil.rmtree(staged, ignore_errors=True)
    staged.mkdir(parents=True)
    return staged


def _publish(staged: Path, target: Path) -> None:
    if target.exists():
        shutil.rmtree(target)
    os.replace(staged, target)
