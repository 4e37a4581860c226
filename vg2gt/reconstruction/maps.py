"""Writes rendered views: a folder per kind of map, or an animation."""

from __future__ import annotations

import io
import logging
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from vg2gt.io.files import temporary_name, write_bytes
from vg2gt.io.images import colorize_normals, encode_image, to_pixels
from vg2gt.io.video import write_video
from vg2gt.reconstruction.camera_paths import view_stem
from vg2gt.reconstruction.output_names import MAPS

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import RenderedView

log = logging.getLogger(__name__)

DEPTH_STEPS = 1000  # stored depth units per scene unit in a 16-bit PNG
_LARGEST = 65535

AddView: TypeAlias = "Callable[[RenderedView], None]"
Sink: TypeAlias = AbstractContextManager[AddView]
"""Context manager that returns a consumer of rendered views; on exit it writes what needs all views."""


@contextmanager
def map_folder(folder: Path, kind: str, suffixes: Sequence[str]) -> Iterator[AddView]:
    """Writes one kind of map of every view into a folder, which appears once it is complete.

    Args:
        folder: output folder; the maps go into a subfolder named after the kind.
        kind: ``color``, ``depth`` or ``normals``.
        suffixes: ``.png``, ``.npy`` or both.

    Yields:
        A function that writes a view's map.

    Raises:
        ValueError: if a view's name leads out of the folder or occurs twice.
    """
    too_deep = 0
    with whole_folder(folder / kind) as staged:
        written: set[Path] = set()

        def add(view: RenderedView) -> None:
            """Writes the maps of one view."""
            nonlocal too_deep
            name = view_stem(view.camera.name)
            stem = staged / name
            if not stem.resolve().is_relative_to(staged.resolve()):
                raise ValueError(f"view name {view.camera.name!r} leads outside the output folder; rename it")
            if stem in written:
                raise ValueError(f"two views are called {name}; rename one of the cameras")
            written.add(stem)
            values = {"color": view.color, "depth": view.depth, "normals": view.normal}[kind]
            for suffix in suffixes:
                if suffix == ".npy":
                    content = _npy(values)
                elif kind == "depth":
                    steps = np.rint(values.numpy().astype(np.float64) * DEPTH_STEPS)
                    too_deep += int((steps > _LARGEST).sum())
                    content = encode_image(np.where(steps > _LARGEST, 0, steps).astype(np.uint16))
                else:
                    content = encode_image(to_pixels(colorize_normals(values) if kind == "normals" else values))
                write_bytes(stem.with_name(stem.name + suffix), content)

        yield add
    if too_deep:
        log.warning(
            "%d pixels deeper than %g scene units do not fit into a 16-bit PNG and are written as 0; save depth.npy",
            too_deep, _LARGEST / DEPTH_STEPS,
        )  # fmt: skip


def _npy(values: Tensor) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values.float().numpy())
    return buffer.getvalue()


@contextmanager
def animation(path: Path, fps: float) -> Iterator[AddView]:
    """Collects the colour of the views and writes an animation, ``.gif`` or ``.mp4``, at ``fps`` frames per second.

    Raises:
        ImportError: if it is not a GIF and PyAV is not installed.
    """
    frames: list[NDArray[np.uint8]] = []
    yield lambda view: frames.append(to_pixels(view.color))
    write_video(path, frames, fps)


def map_sinks(folder: Path, outputs: Sequence[str]) -> list[Sink]:
    """Returns one sink per kind of map among the outputs."""
    kinds: dict[str, list[str]] = {}
    for output in outputs:
        if output in MAPS:
            kind, suffix = os.path.splitext(output)
            kinds.setdefault(kind, []).append(suffix)
    return [map_folder(folder, kind, suffixes) for kind, suffixes in kinds.items()]


def feed(views: Iterable[RenderedView], sinks: Sequence[Sink], advance: Callable[[], None]) -> None:
    """Passes every view to every sink, then closes the sinks in order; on an error, no half-written folder remains."""
    with ExitStack() as stack:
        takers = [stack.enter_context(sink) for sink in reversed(sinks)]  # the last one entered closes first
        for view in views:
            for add in reversed(takers):
                add(view)
            advance()


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """Yields a folder to write into, which replaces ``target`` at the end of the block; on an error it is removed."""
    staged = temporary_name(target)
    shutil.rmtree(staged, ignore_errors=True)
    staged.mkdir(parents=True)
    try:
        yield staged
        if target.exists():
            shutil.rmtree(target)
        os.replace(staged, target)
    finally:
        shutil.rmtree(staged, ignore_errors=True)
