"""Sets of photographs prepared for comparison: cameras found once, every fourth view left out.

What is left over is written as a COLMAP scene of the working size (``images/``, ``sparse/0``), which every program is
given, so that all start from the same pixels, cameras and points. Points that fewer than two of its views saw are left
out: the views that are scored have no part in it.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vg2gt.data.sources.colmap_model import model_folder_of
from vg2gt.geometry.cameras import project
from vg2gt.io import ColmapImage, ColmapModel, ColmapPoints, colmap_camera, colmap_image, read_colmap, write_colmap
from vg2gt.io.colmap import PIXEL_CENTER
from vg2gt.io.images import write_png
from vg2gt.io.json_checks import load_json
from vg2gt.reconstruction.given_cameras import LAYOUTS, given_pictures
from vg2gt.reconstruction.inputs import load_views, working_size
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.pictures import find_pictures
from vg2gt.reconstruction.sfm import find_cameras
from vg2gt.types import Cameras

EVERY = 4  # one view of so many is left out, the one in the middle
FEWEST = 2  # views that must have seen a point


@dataclass(frozen=True)
class PhotoSet:
    """Photographs with cameras at the working size.

    Attributes:
        name: of the set.
        folder: COLMAP scene of the views that programs are given.
        images: ``[V, 3, H, W]`` of all views, in [0, 1].
        cameras: of all views ``[1, V]``, in the scene's frame.
        context: indices of the views in ``folder``.
        held_out: indices of the others.
        points: how many sparse points ``folder`` has.
    """

    name: str
    folder: Path
    images: Tensor
    cameras: Cameras
    context: tuple[int, ...]
    held_out: tuple[int, ...]
    points: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.cameras.size

    @property
    def given(self) -> list[str]:
        """Names of the views in ``folder``, without ending."""
        return [view_name(index) for index in self.context]


def view_name(index: int) -> str:
    """How the files of a view are called."""
    return f"{index:06d}"


def prepare(name: str, photos: Path, out: Path, size: int, patch: int, poses: str) -> PhotoSet:
    """Finds the cameras of a folder of photographs, once, and writes the views that programs are given.

    Args:
        name: of the set.
        photos: the folder.
        out: where cameras and views are kept: ``sfm/`` and ``SIZE/``.
        size: longer side in pixels.
        patch: of which the sides are multiples.
        poses: ``sfm`` or ``given``: those that lie beside the photographs.

    Raises:
        ValueError: if there are no cameras, or too few views.
    """
    if poses == "given":
        pictures, model = given_pictures(photos), model_folder_of(photos)
        if pictures is None:
            raise ValueError(f"{photos} has no cameras beside its images: expected {LAYOUTS}; or take --poses sfm")
        titles: dict[str, str] = {}
    else:
        pictures = find_cameras(find_pictures(photos), out / "sfm", Monitor())
        model, titles = model_folder_of(out / "sfm"), load_json(out / "sfm" / "sfm.json")["images"]
    views = load_views(pictures, working_size([p.size for p in pictures], patch, "cpu", size), Monitor())
    held_out = tuple(i for i in range(len(pictures)) if i % EVERY == EVERY // 2)
    context = tuple(i for i in range(len(pictures)) if i not in held_out)
    if len(context) < FEWEST or not held_out:
        raise ValueError(f"{photos}: {len(pictures)} photographs have cameras; {EVERY} are needed at least")
    assert views.hints is not None
    assert views.hints.cameras is not None
    folder = out / str(size)
    shutil.rmtree(folder, ignore_errors=True)
    for index in context:
        write_png(folder / "images" / f"{view_name(index)}.png", views.images[index])
    sparse = ColmapModel({}, {}, ColmapPoints.empty()) if model is None else read_colmap(model)
    names = [picture.name for picture in pictures]
    seen = {titles.get(image.name, Path(image.name).stem): image for image in sparse.images.values()}
    rows = {index: seen[names[index]] for index in context if names[index] in seen}
    written = _scene(views.hints.cameras, context, rows, sparse.points)
    write_colmap(folder / "sparse" / "0", written)
    return PhotoSet(name, folder, views.images, views.hints.cameras, context, held_out, len(written.points))


def _scene(cameras: Cameras, context: Sequence[int], seen: dict[int, ColmapImage], points: ColmapPoints) -> ColmapModel:
    """The given views' cameras, with the points that two of them saw at least."""
    row_of = {number: row for row, number in enumerate(points.ids.tolist())}
    sees = np.zeros((len(context), len(points)), bool)
    for view, index in enumerate(context):
        numbers = seen[index].point3d_ids.tolist() if index in seen else []
        sees[view, [row_of[number] for number in numbers if number in row_of]] = True
    kept = np.flatnonzero(sees.sum(0) >= FEWEST)
    sees = sees[:, kept]
    optics, images, place = {}, {}, np.zeros(sees.shape, np.int64)  # a point's row among those that a view saw
    for view, index in enumerate(context):
        camera, number, rows = cameras.select(slice(index, index + 1)), view + 1, kept[sees[view]]
        optics[number] = colmap_camera(number, camera.intrinsics[0, 0].double().numpy(), cameras.size)
        pixels, _ = project(torch.from_numpy(points.positions[rows]).float()[None, None], camera)
        pose = camera.world_to_camera[0, 0].double().numpy()
        image = colmap_image(number, pose, number, f"{view_name(index)}.png")
        images[number] = replace(
            image, points2d=pixels[0, 0].double().numpy() + PIXEL_CENTER, point3d_ids=points.ids[rows]
        )
        place[view, sees[view]] = np.arange(len(rows))
    column, view = np.nonzero(sees.T)
    tracks = np.stack((view + 1, place[view, column]), -1)
    sparse = ColmapPoints(
        points.ids[kept], points.positions[kept], points.colors[kept], points.errors[kept], tracks, sees.sum(0)
    )
    return ColmapModel(optics, images, sparse)
