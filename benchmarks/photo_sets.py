"""Prepares sets of photographs for comparison: estimates cameras once and holds out every fourth view.

The other views are written as a COLMAP scene at the working size (``images/``, ``sparse/0``), which is the input of all
programs, so that all start from the same pixels, cameras and points. Points seen in fewer than two of these views are
left out, so that held-out views do not contribute.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from vg2gt.data.sources.colmap_model import model_folder_of
from vg2gt.geometry.cameras import project
from vg2gt.inputs.given_cameras import LAYOUTS, given_pictures
from vg2gt.inputs.inputs import load_views, working_size
from vg2gt.inputs.pictures import find_pictures
from vg2gt.inputs.sfm import find_cameras
from vg2gt.io import colmap_from_views, read_colmap, write_colmap
from vg2gt.io.files import read_json
from vg2gt.io.images import write_png
from vg2gt.monitor import Monitor
from vg2gt.types import Cameras

if TYPE_CHECKING:
    from pycolmap import Reconstruction  # pyright: ignore[reportMissingImports]

EVERY = 4  # hold out one view of every 4, from the middle
FEWEST = 2  # minimum number of input views that see a point


@dataclass(frozen=True)
class PhotoSet:
    """Photographs with cameras at the working size.

    Attributes:
        folder: COLMAP scene of the input views.
        images: all views ``[V, 3, H, W]`` in [0, 1].
        cameras: cameras of all views ``[1, V]``, in the scene's frame.
        context: indices of the input views.
        held_out: indices of the held-out views.
        points: number of sparse points in ``folder``.
    """

    folder: Path
    images: Tensor
    cameras: Cameras
    context: tuple[int, ...]
    held_out: tuple[int, ...]
    points: int

    @property
    def given(self) -> list[str]:
        """Names of the input views, without suffix."""
        return [view_name(index) for index in self.context]


def view_name(index: int) -> str:
    """Returns the file name of a view, without suffix."""
    return f"{index:06d}"


def prepare(photos: Path, out: Path, size: int, patch: int, poses: str) -> PhotoSet:
    """Estimates the cameras of a folder of photographs once, and writes the input views.

    Args:
        photos: folder of photographs.
        out: output folder; cameras go to ``sfm/``, views to ``SIZE/``.
        size: longer side in pixels.
        patch: image sides are multiples of this.
        poses: ``sfm``, or ``given`` to read camera files next to the photographs.

    Raises:
        ValueError: if there are no cameras, or too few views.
    """
    if poses == "given":
        pictures, model = given_pictures(photos), model_folder_of(photos)
        if pictures is None:
            raise ValueError(f"{photos} has no cameras next to its images: expected {LAYOUTS}; or use --poses sfm")
        titles: dict[str, str] = {}
    else:
        pictures = find_cameras(find_pictures(photos), out / "sfm", Monitor())
        model, titles = model_folder_of(out / "sfm"), read_json(out / "sfm" / "sfm.json")["images"]
    views = load_views(pictures, working_size([p.size for p in pictures], patch, "cpu", size), Monitor())
    held_out = tuple(i for i in range(len(pictures)) if i % EVERY == EVERY // 2)
    context = tuple(i for i in range(len(pictures)) if i not in held_out)
    if len(context) < FEWEST or not held_out:
        raise ValueError(f"{photos}: only {len(pictures)} photographs have cameras; at least {EVERY} are needed")
    assert views.hints is not None
    assert views.hints.cameras is not None
    folder = out / str(size)
    shutil.rmtree(folder, ignore_errors=True)
    for index in context:
        write_png(folder / "images" / f"{view_name(index)}.png", views.images[index])
    names = [picture.name for picture in pictures]
    cameras = views.hints.cameras.select(torch.tensor(context))
    written = _scene(model, titles, [names[index] for index in context], cameras, context)
    write_colmap(folder / "sparse" / "0", written)
    return PhotoSet(folder, views.images, views.hints.cameras, context, held_out, written.num_points3D())


def _scene(
    folder: Path | None, titles: dict[str, str], names: Sequence[str], cameras: Cameras, context: Sequence[int]
) -> Reconstruction:
    """COLMAP model of the input views at the working size, with the points of a model that enough of them see.

    ``titles`` maps file names in the model of ``folder`` to view names where they differ.
    """
    points, view_of = [], {}
    if folder is not None:
        model = read_colmap(folder)
        points = list(model.points3D.values())
        view_of = {
            image.image_id: names.index(title)
            for image in model.images.values()
            if (title := titles.get(image.name, Path(image.name).stem)) in names
        }
    sees = np.zeros((len(names), len(points)), bool)
    for column, point in enumerate(points):
        rows = [view_of[element.image_id] for element in point.track.elements if element.image_id in view_of]
        sees[rows, column] = True
    kept = np.flatnonzero(sees.sum(0) >= FEWEST)
    positions = np.array([points[index].xyz for index in kept]).reshape(-1, 3)
    colors = np.array([points[index].color for index in kept], np.uint8).reshape(-1, 3)
    # where the views see them
    view, point = np.nonzero(sees[:, kept])
    seen = torch.from_numpy(positions).float().expand(1, len(context), -1, -1)
    pixels = project(seen, cameras)[0][0].double().numpy()[view, point]
    files = [f"{view_name(index)}.png" for index in context]
    return colmap_from_views(cameras, files, positions, colors, (point, view, pixels))
