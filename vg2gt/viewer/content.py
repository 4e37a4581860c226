"""Content of the page: Gaussians, cameras, thumbnails of their images, and the initial view."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps

from vg2gt.io.arrays import read_npz
from vg2gt.io.cameras_json import NamedCamera, invert_pose
from vg2gt.io.images import color_image, open_image
from vg2gt.io.points import scene_extent
from vg2gt.rendering.options import RenderOptions
from vg2gt.types import Gaussians

_FRUSTUM_SHARE = 0.02  # depth of a drawn frustum, relative to the scene's extent
_PICTURE_SIDE = 320  # longer side of an image shown in its frustum, in pixels
_DEFAULT_SIZE = (960, 720)  # width and height of the default view
_INSIDE_SHARE = 0.1  # minimum share of Gaussians in view for the default view to be the world frame


@dataclass(frozen=True)
class ViewerScene:
    """A scene to show.

    Attributes:
        gaussians: one scene, at least one Gaussian.
        cameras: the cameras to draw; the first is the initial view.
        pictures: ``[H, W, 3]`` uint8 or None, one per camera; empty: no pictures.
        title: title of the page.
        near: near plane in scene units.
        antialiased: whether opacities are compensated for the low-pass filter (:class:`RenderOptions`).
    """

    gaussians: Gaussians
    cameras: Sequence[NamedCamera] = ()
    pictures: Sequence[NDArray[np.uint8] | None] = ()
    title: str = "scene"
    near: float = RenderOptions.near
    antialiased: bool = RenderOptions.antialiased

    def initial(self) -> NamedCamera:
        """Returns the initial view: the first camera, else :func:`_default_camera`."""
        return self.cameras[0] if self.cameras else _default_camera(self.gaussians)

    def frustum_depth(self) -> float:
        """Returns the distance from a camera's centre to its drawn image, in scene units."""
        centers = np.stack([invert_pose(camera.world_to_camera)[:3, 3] for camera in self.cameras or [self.initial()]])
        return _FRUSTUM_SHARE * scene_extent(self.gaussians.means.detach().cpu().double().numpy(), centers)


def _default_camera(gaussians: Gaussians) -> NamedCamera:
    """Returns a view of a scene without cameras.

    This is the world frame if at least a tenth of the Gaussians are in view there. Otherwise the camera is placed in
    front of the scene, far enough to see its middle 90 %.
    """
    width, height = _DEFAULT_SIZE
    focal = 0.8 * width
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    means = gaussians.means.detach().cpu().double()
    reach = torch.tensor([width, height]) / 2 / focal
    inside = (means[:, 2] > 0) & (means[:, :2].abs() < reach * means[:, 2:]).all(-1)
    pose = np.eye(4)
    if inside.double().mean() < _INSIDE_SHARE:
        low, high = np.quantile(means.numpy(), [0.05, 0.95], axis=0)
        radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
        pose[:3, 3] = -(low + high) / 2 + [0, 0, radius / float(reach.min())]
    return NamedCamera("default", width, height, intrinsics, pose)


def scene_title(path: str | Path) -> str:
    """Returns the title of a scene's file: its name, or its folder's if it is called ``scene``, as ours are."""
    full = Path(os.path.abspath(path))  # of ``.`` and ``..`` too; links keep their names
    return full.parent.name or full.stem if full.stem == "scene" else full.stem


def load_pictures(cameras: Sequence[NamedCamera], source: str | Path) -> list[NDArray[np.uint8] | None]:
    """Loads upright thumbnails of the cameras' images.

    Args:
        cameras: the cameras, named by their images.
        source: the folder of the images, or a ``views.npz`` of the same scene.

    Returns:
        One per camera, the longer side at most ``_PICTURE_SIDE`` pixels; None if ``source`` has no such image (names
        that lead out of the folder count as missing).

    Raises:
        ValueError: if an existing file cannot be read; the message names it.
    """
    root = Path(source).resolve()
    if root.suffix == ".npz":
        return _pictures_of_views(cameras, root)
    pictures: list[NDArray[np.uint8] | None] = []
    for camera in cameras:
        path = (root / camera.name).resolve()
        pictures.append(_picture(path) if path.is_relative_to(root) and path.is_file() else None)
    return pictures


def _pictures_of_views(cameras: Sequence[NamedCamera], path: Path) -> list[NDArray[np.uint8] | None]:
    if not path.is_file():
        return [None] * len(cameras)
    try:
        stored = read_npz(path, ["names", "images"])
        images = dict(zip(stored["names"].tolist(), stored["images"], strict=True))
        found = [images.get(camera.name.removesuffix(".png")) for camera in cameras]
        return [None if image is None else thumbnail(image) for image in found]
    except Exception as error:  # damaged archives and arrays that are no images
        raise ValueError(f"cannot read {path}: {error}; restore or remove it") from error


def _picture(path: Path) -> NDArray[np.uint8]:
    try:
        with open_image(path) as image:
            image.draft("RGB", (2 * _PICTURE_SIDE, 2 * _PICTURE_SIDE))  # JPEG decodes to a smaller size
            return thumbnail(np.asarray(color_image(ImageOps.exif_transpose(image) or image)))
    except Exception as error:  # image libraries raise many kinds of errors
        raise ValueError(f"cannot read {path}: {error}; restore or remove the image") from error


def thumbnail(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns an image ``[H, W, 3]`` uint8 reduced to at most ``_PICTURE_SIDE`` pixels on its longer side."""
    image = Image.fromarray(pixels)
    image.thumbnail((_PICTURE_SIDE, _PICTURE_SIDE))
    return np.array(image)
