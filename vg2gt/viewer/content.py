"""Content of the viewers: Gaussians, cameras, thumbnails of their images, and the initial view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps

from vg2gt.io.arrays import read_npz
from vg2gt.io.cameras_json import NamedCamera, invert_pose
from vg2gt.io.images import color_image, open_image
from vg2gt.io.points import scene_extent
from vg2gt.types import Gaussians

FRUSTUM_SHARE = 0.02  # depth of a drawn frustum, relative to the scene's extent
PICTURE_SIDE = 320  # longer side of an image shown in its frustum, in pixels
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

    Raises:
        ValueError: if there are no Gaussians, or the numbers of pictures and cameras differ.
    """

    gaussians: Gaussians
    cameras: Sequence[NamedCamera] = ()
    pictures: Sequence[NDArray[np.uint8] | None] = field(default=())
    title: str = "scene"

    def __post_init__(self) -> None:
        if not len(self.gaussians):
            raise ValueError("there are no Gaussians to show")
        if self.pictures and len(self.pictures) != len(self.cameras):
            raise ValueError(
                f"expected a picture (or None) per camera, got {len(self.pictures)} for {len(self.cameras)}"
            )

    def picture(self, index: int) -> NDArray[np.uint8] | None:
        """Returns the picture of a camera, or None."""
        return self.pictures[index] if self.pictures else None

    def initial(self) -> NamedCamera:
        """Returns the initial view: the first camera, else :func:`default_camera`."""
        return self.cameras[0] if self.cameras else default_camera(self.gaussians)

    def frustum_depth(self) -> float:
        """Returns the distance from a camera's centre to its drawn image, in scene units."""
        centers = np.stack([invert_pose(camera.world_to_camera)[:3, 3] for camera in self.cameras or [self.initial()]])
        return FRUSTUM_SHARE * scene_extent(self.gaussians.means.detach().cpu().double().numpy(), centers)


def default_camera(gaussians: Gaussians) -> NamedCamera:
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
        xyz = means.numpy()
        low, high = np.quantile(xyz, [0.05, 0.95], axis=0)
        radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
        pose[:3, 3] = -(low + high) / 2 + [0, 0, radius / float(reach.min())]
    return NamedCamera("default", width, height, intrinsics, pose)


def load_pictures(cameras: Sequence[NamedCamera], folder: str | Path) -> list[NDArray[np.uint8] | None]:
    """Loads upright thumbnails of the cameras' images, ``folder / name`` each.

    Returns:
        One per camera, the longer side at most ``PICTURE_SIDE`` pixels; None if the folder has no such file (names that
        lead out of it count as missing).

    Raises:
        ValueError: if an existing file cannot be read; the message names it.
    """
    root = Path(folder).resolve()
    pictures: list[NDArray[np.uint8] | None] = []
    for camera in cameras:
        path = None if "\0" in camera.name else (root / camera.name).resolve()
        inside = path is not None and path.is_relative_to(root) and path.is_file()
        pictures.append(_small_picture(path) if path is not None and inside else None)
    return pictures


def load_view_pictures(cameras: Sequence[NamedCamera], path: Path) -> list[NDArray[np.uint8] | None]:
    """Loads thumbnails of the cameras' images from a ``views.npz`` of the same scene.

    Returns:
        One per camera; empty if there is no such file or it is of other images.

    Raises:
        ValueError: if the file cannot be read; the message names it.
    """
    if not path.is_file():
        return []
    try:
        names = read_npz(path, [], ["names"]).get("names")
        if names is not None and names.tolist() != [camera.name.removesuffix(".png") for camera in cameras]:
            return []
        pictures = [Image.fromarray(image) for image in read_npz(path, ["images"])["images"]]
    except Exception as error:  # damaged archives and arrays that are no images
        raise ValueError(f"cannot read {path}: {error}; restore or remove it") from error
    for picture in pictures:
        picture.thumbnail((PICTURE_SIDE, PICTURE_SIDE))
    return [np.array(picture) for picture in pictures] if len(pictures) == len(cameras) else []


def _small_picture(path: Path) -> NDArray[np.uint8]:
    try:
        with open_image(path) as image:
            if not image.mode.startswith(("I", "F")):
                image.thumbnail((PICTURE_SIDE, PICTURE_SIDE))
            picture = color_image(ImageOps.exif_transpose(image) or image)
            picture.thumbnail((PICTURE_SIDE, PICTURE_SIDE))
            return np.array(picture)
    except Exception as error:  # image libraries raise many kinds of errors
        raise ValueError(f"cannot read {path}: {error}; restore or remove the image") from error
