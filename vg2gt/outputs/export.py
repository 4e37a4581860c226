"""Views for export to other programs: whole photographs under their own names, and points with their observations."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.geometry.cameras import project
from vg2gt.io.errors import some
from vg2gt.io.files import portable, write_bytes
from vg2gt.io.image_files import image_size, orientation
from vg2gt.io.images import encode_image, to_pixels
from vg2gt.types import Cameras

if TYPE_CHECKING:
    from vg2gt.inputs.pictures import Picture
    from vg2gt.reconstruction.scene import Scene

log = logging.getLogger(__name__)

AGREE = 0.05  # maximum relative depth difference at which a view is taken to see a point
_VIEWS_A_POINT = 12  # maximum number of observations of a point
_QUALITY = 95  # of re-encoded JPEGs


@dataclass(frozen=True)
class _ExportedViews:
    """The views of a scene with images of their own sizes.

    Attributes:
        cameras: ``[1, V]`` float64; ``size`` is that of the first view.
        sizes: ``(height, width)`` of each view.
        names: unique file names.
        pictures: source picture of each view; None: its image at the working size is exported.
    """

    cameras: Cameras
    sizes: tuple[tuple[int, int], ...]
    names: tuple[str, ...]
    pictures: tuple[Picture | None, ...]

    def write_images(self, scene: Scene, folder: Path) -> None:
        """Writes the images of a scene's views; photographs that need no change are copied."""
        folder.mkdir(parents=True)
        for name, picture, image in zip(self.names, self.pictures, scene.images, strict=True):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if picture is not None:
                picture = picture.whole or picture
                file = None if picture.lens else picture.path
                if file is not None and orientation(file, "") == 1 and image_size(file, "") == picture.size:
                    shutil.copyfile(file, path)
                    continue
                image = picture.read(picture.size).images[0]
            is_jpeg = path.suffix.lower() in (".jpg", ".jpeg")
            kind, options = ("JPEG", {"quality": _QUALITY, "subsampling": 0}) if is_jpeg else ("PNG", {})
            write_bytes(path, encode_image(to_pixels(image), kind, **options))

    def observations(self, scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Returns which views see the scene's points, and where: points ``[T]``, views ``[T]``, pixels ``[T, 2]``.

        A view sees a point if its decoded depth agrees with the point's depth. The view that a point comes from always
        sees it. At most 12 observations of a point are kept.
        """
        points = scene.points()
        small = scene.cameras.to("cpu").map(torch.Tensor.double)
        positions = torch.from_numpy(points.positions)
        rows, views, pixels = [], [], []
        for view, depth in enumerate(scene.depth):
            place, z = project(positions[None, None], small.select(slice(view, view + 1)))
            x, y = place[0, 0].round().nan_to_num(-1, -1, -1).long().unbind(-1)
            inside = (z[0, 0] > 0) & (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
            found = torch.where(inside, depth[y.clamp(0, depth.shape[0] - 1), x.clamp(0, depth.shape[1] - 1)], 0)
            agrees = inside & ((found / z[0, 0] - 1).abs() < AGREE)
            seen = agrees.numpy() | (points.views == view)
            (own,) = np.nonzero(seen)
            rows.append(own)
            views.append(np.full(len(own), view))
            # from pixels of the working size to those of the exported image
            before, after = small.intrinsics[0, view].numpy(), self.cameras.intrinsics[0, view].numpy()
            directions = (place[0, 0].numpy()[own] - before[:2, 2]) / before[[0, 1], [0, 1]]
            pixels.append(directions * after[[0, 1], [0, 1]] + after[:2, 2])
        owner, view, pixel = np.concatenate(rows), np.concatenate(views), np.concatenate(pixels)
        kept = _fewer(owner, view == points.views[owner])
        return owner[kept], view[kept], pixel[kept]


def exported_views(scene: Scene) -> _ExportedViews:
    """Returns the views with whole photographs if known, else with the images at the working size."""
    named = scene.named_cameras()
    poses = torch.from_numpy(np.stack([camera.world_to_camera for camera in named]))
    if named[0].photo is None:
        log.warning("photographs of a scene read from a folder are not known: images are exported at the working size")
    shown = [camera.photo or camera for camera in named]
    sizes = tuple((each.height, each.width) for each in shown)
    own = _with_folders([each.name for each in shown], scene.pictures if named[0].photo else ())
    names = [portable(name) for name in own]
    if len({name.lower() for name in names}) < len(names):
        names = [portable(f"{camera.name[:-4]}{Path(name).suffix}") for camera, name in zip(named, own, strict=True)]
    elif changed := [f"{name} ({new})" for name, new in zip(own, names, strict=True) if name != new]:
        log.warning("%d names are not allowed on Windows and are changed: %s", len(changed), some(changed))
    cameras = Cameras(poses[None], torch.from_numpy(np.stack([each.intrinsics for each in shown]))[None], sizes[0])
    return _ExportedViews(cameras, sizes, tuple(names), scene.pictures if named[0].photo else (None,) * len(named))


def _with_folders(names: list[str], pictures: Sequence[Picture]) -> list[str]:
    """Returns the names with the folders of their files below the common one, if there are several."""
    files = [None if picture is None or picture.path is None else picture.path.absolute() for picture in pictures]
    folders = {file.parent for file in files if file is not None}
    if len(folders) < 2:
        return names
    common = Path(os.path.commonpath(folders))
    return [
        name if file is None else (file.parent.relative_to(common) / name).as_posix()
        for name, file in zip(names, files, strict=True)
    ]


def _fewer(owner: NDArray[np.int64], own: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Returns rows of at most ``_VIEWS_A_POINT`` observations per point, always with that of its own view."""
    order = np.lexsort((~own, owner))
    start = np.searchsorted(owner[order], owner[order])
    return np.sort(order[np.arange(len(order)) - start < _VIEWS_A_POINT])
