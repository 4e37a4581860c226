"""Images with given cameras: orientation and size on disk, and undistortion to a pinhole camera.

pycolmap provides the camera models and the target pinhole camera. Pixels are looked up here, because depth and masks
are undistorted with the same map as colours. A file or camera that does not match raises ``DataError``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample, interpolate

from vg2gt.data.base import DataError
from vg2gt.data.sources.index import PosedImage
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.io.colmap import PIXEL_CENTER, Camera, colmap_intrinsics, require_pycolmap
from vg2gt.io.image_files import Size, image_size, orientation

# The lookup map is computed on a coarse grid, every 8 pixels but at least 256 a side, and interpolated to 0.01 pixels.
_STEP, _FEWEST = 8, 256
_SMALLEST = 0.3  # minimum size of an undistorted image, as a fraction of the distorted width and height
_OUTSIDE = 1.0  # pixels by which the border of the pinhole image may lie outside the distorted image


def is_pinhole(camera: Camera) -> bool:
    """Returns whether a camera has no distortion, because of its model or because its coefficients are 0."""
    return "FISHEYE" not in camera.model_name and camera.is_undistorted() and len(camera.focal_length_idxs()) > 0


def pinhole_camera(camera: Camera) -> Camera:
    """Returns COLMAP's undistorted pinhole camera, without blank pixels; a pinhole camera is returned unchanged."""
    import pycolmap  # pyright: ignore[reportMissingImports]

    return camera if is_pinhole(camera) else pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)


@dataclass(frozen=True, eq=False)
class Undistortion:
    """Map from the pixels of a pinhole camera to those of a distorted image.

    Attributes:
        lens_size: ``(height, width)`` of the distorted images.
        size: ``(height, width)`` of the undistorted images.
        intrinsics: ``[3, 3]`` of the undistorted images, integer pixel centres.
        camera: the distorted camera.
    """

    lens_size: Size
    size: Size
    intrinsics: NDArray[np.float64]
    camera: Camera

    @cached_property
    def places(self) -> NDArray[np.float32]:
        """Position (x, y) in the distorted image of each undistorted pixel, ``[h, w, 2]`` float32."""
        fine = interpolate(_coarse_places(self), self.size, mode="bilinear", align_corners=True)
        return fine[0].permute(1, 2, 0).float().contiguous().numpy()

    @staticmethod
    def of(camera: Camera) -> Undistortion:
        """Computes the undistortion of a camera.

        Raises:
            ValueError: if the camera model has no focal length (EQUIRECTANGULAR), or if its distortion is implausible.
        """
        colmap_intrinsics(camera)  # raises if there is no focal length
        target = pinhole_camera(camera)
        size, lens_size = (target.height, target.width), (camera.height, camera.width)
        found = Undistortion(lens_size, size, colmap_intrinsics(target), camera)
        places = _coarse_places(found)[0].permute(1, 2, 0).numpy()  # the others are between them
        inside = (places >= -0.5 - _OUTSIDE) & (places <= np.array(lens_size[::-1]) - 0.5 + _OUTSIDE)
        too_small = min(size[0] / lens_size[0], size[1] / lens_size[1]) < _SMALLEST
        if too_small or not inside.all():  # also if one is NaN
            raise ValueError(
                f"the distortion of a {camera.model_name} camera ({camera.params_info}: {camera.params_to_string()}) "
                "maps the image border outside the image; it does not belong to these images"
            )
        return found

    def reduced(self, lens_size: Size) -> Undistortion:
        """Returns the undistortion of reduced images of ``(height, width)`` to the same, reduced pinhole camera."""
        if lens_size == self.lens_size:
            return self
        scale = [mine / whole for mine, whole in zip(lens_size, self.lens_size, strict=True)]
        size = (round(self.size[0] * scale[0]), round(self.size[1] * scale[1]))
        matrix = torch.from_numpy(self.intrinsics)
        matrix = resize_intrinsics(matrix, size[1] / self.size[1], size[0] / self.size[0]).numpy()
        return Undistortion(lens_size, size, matrix, _resized_camera(self.camera, lens_size))

    def color(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistorts an image ``[h, w, C]`` by bilinear lookup."""
        sampled = self._sample(torch.from_numpy(pixels).permute(2, 0, 1).float(), "bilinear")  # [C, h, w]
        return (sampled + 0.5).clamp(0, 255).byte().permute(1, 2, 0).contiguous().numpy()

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Undistorts z-depth ``[h, w]`` by nearest lookup, because a mean across an edge is a point in mid-air."""
        return self._sample(torch.from_numpy(depth)[None], "nearest")[0].numpy()

    def _sample(self, image: torch.Tensor, mode: str) -> torch.Tensor:
        grid = (torch.from_numpy(self.places) + 0.5) * (2 / torch.tensor(self.lens_size[::-1])) - 1
        return grid_sample(image[None], grid[None], mode, padding_mode="border", align_corners=False)[0]


@lru_cache(maxsize=4)
def undistortion_of(lens: str, reduced: Size | None = None) -> Undistortion:
    """Returns the undistortion of a lens; the last four are cached.

    Args:
        lens: the lens in the format of :func:`lens_text`.
        reduced: ``(height, width)`` of reduced images (:meth:`Undistortion.reduced`); None: of its own size.

    Raises:
        ValueError: see :meth:`Undistortion.of`.
    """
    if reduced is not None:
        return undistortion_of(lens).reduced(reduced)
    require_pycolmap("undistorting images")
    import pycolmap  # pyright: ignore[reportMissingImports]

    model, width, height, *params = lens.split()
    camera = pycolmap.Camera(model=model, width=int(width), height=int(height), params=[float(p) for p in params])
    return Undistortion.of(camera)


def _resized_camera(camera: Camera, size: Size) -> Camera:
    """Returns a camera for images resized to ``(height, width)``."""
    resized = type(camera)(camera.todict())
    resized.rescale(size[1], size[0])
    return resized


def lens_text(camera: Camera, size: Size) -> str:
    """Serialises a camera, resized to images of ``(height, width)``, as ``MODEL WIDTH HEIGHT PARAMETERS``."""
    resized = _resized_camera(camera, size)
    params = " ".join(repr(float(value)) for value in resized.params)
    return f"{resized.model_name} {size[1]} {size[0]} {params}"


def _coarse_places(undistortion: Undistortion) -> torch.Tensor:
    """Returns the places of a grid of undistorted pixels from corner to corner, ``[1, 2, rows, columns]`` float64."""
    camera, intrinsics, size = undistortion.camera, undistortion.intrinsics, undistortion.size
    rows, columns = (min(side, max(-(-side // _STEP), _FEWEST)) for side in size)
    y, x = np.meshgrid(np.linspace(0, size[0] - 1, rows), np.linspace(0, size[1] - 1, columns), indexing="ij")
    rays = np.stack((x, y, np.ones_like(x)), -1).reshape(-1, 3) @ np.linalg.inv(intrinsics).T
    with np.errstate(all="ignore"):
        coarse = camera.img_from_cam(np.ascontiguousarray(rays)) - PIXEL_CENTER
    return torch.from_numpy(coarse.reshape(1, rows, columns, 2)).permute(0, 3, 1, 2)


def size_on_disk(path: Path, scene: str, expected: Size, where: str, as_stored: bool = True) -> tuple[Size, bool]:
    """Returns an image's ``(height, width)``, and whether it must be rotated upright according to its EXIF data.

    The camera may belong to the image as stored or to the upright one. The aspect ratio decides; if both match,
    ``as_stored`` does.

    Args:
        path: the image.
        scene: its scene, for messages.
        expected: ``(height, width)`` of its camera; the image may be resized.
        where: source of the camera, for the message.
        as_stored: use the stored image, as COLMAP does; False: the upright one, as our own files do.

    Raises:
        DataError: if neither orientation has the camera's aspect ratio.
    """
    stored, upright = image_size(path, scene), image_size(path, scene, upright=True)
    choices = [(stored, False)] if orientation(path, scene) == 1 else [(stored, False), (upright, True)]
    for size, turned in choices if as_stored else reversed(choices):
        if _has_shape(size, expected):
            return size, turned
    raise DataError(
        f"{path} is {stored[1]}x{stored[0]} pixels, but its camera in {where} is {expected[1]}x{expected[0]}: use the "
        "camera's own image or a resized copy with the same aspect ratio"
    )


def posed_image(
    camera: Camera | NDArray[np.float64], camera_size: Size, size: Size, upright: bool, mask: Path | None, where: str
) -> PosedImage:
    """Makes the index entry of an image with a camera.

    Args:
        camera: a COLMAP camera, or the intrinsics ``[3, 3]`` of a pinhole (integer pixel centres).
        camera_size: ``(height, width)`` that the camera was made for.
        size: ``(height, width)`` of the image.
        upright: see :func:`size_on_disk`.
        mask: mask file of the image; None: none.
        where: source of the camera, for the message.
    """
    kept = "" if mask is None else str(mask.resolve())
    try:
        if isinstance(camera, np.ndarray) or is_pinhole(camera):
            matrix = camera if isinstance(camera, np.ndarray) else colmap_intrinsics(camera)
            scale = (size[1] / camera_size[1], size[0] / camera_size[0])
            matrix = resize_intrinsics(torch.from_numpy(np.asarray(matrix, np.float64)), *scale).numpy()
            return PosedImage(size, matrix, "", upright, kept)
        lens = lens_text(camera, size)
        undistortion = undistortion_of(lens)
    except ValueError as error:
        raise DataError(f"{where}: {error}") from error
    return PosedImage(undistortion.size, undistortion.intrinsics, lens, upright, kept)


def _has_shape(size: Size, camera: Size) -> bool:
    # Sizes are rounded to whole pixels, so both sides of a resized image may be off by one.
    return abs(size[0] * camera[1] / (size[1] * camera[0]) - 1) <= 2 / min(size)
