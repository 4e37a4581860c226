"""The records of a COLMAP model, in COLMAP's own conventions, exactly as they stand in its files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.errors import FormatError

# Name: (id, parameters in order). ``f`` stands for one focal length in both directions.
CAMERA_MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "FOV": (7, ("fx", "fy", "cx", "cy", "omega")),
    "SIMPLE_RADIAL_FISHEYE": (8, ("f", "cx", "cy", "k")),
    "RADIAL_FISHEYE": (9, ("f", "cx", "cy", "k1", "k2")),
    "THIN_PRISM_FISHEYE": (10, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1")),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        11,
        ("fx", "fy", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
    ),
    "SIMPLE_DIVISION": (12, ("f", "cx", "cy", "k")),
    "DIVISION": (13, ("fx", "fy", "cx", "cy", "k")),
    "SIMPLE_FISHEYE": (14, ("f", "cx", "cy")),
    "FISHEYE": (15, ("fx", "fy", "cx", "cy")),
    "EUCM": (16, ("fx", "fy", "cx", "cy", "alpha", "beta")),
    "EQUIRECTANGULAR": (17, ("w", "h")),
}
MODEL_NAMES = {number: name for name, (number, _) in CAMERA_MODELS.items()}
PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")


@dataclass(frozen=True)
class ColmapCamera:
    """One camera's optics.

    Attributes:
        id: number by which images name it.
        model: a name of ``CAMERA_MODELS``.
        width: image width in pixels.
        height: image height in pixels.
        params: the model's parameters in its order; the principal point is in COLMAP's convention, in which the centre
            of the first pixel is at (1/2, 1/2).
    """

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def is_pinhole(self) -> bool:
        """Whether the camera has no distortion by its model's name."""
        return self.model in PINHOLE_MODELS

    def param(self, name: str) -> float:
        """One parameter by name; ``fx`` and ``fy`` also answer for models with a single ``f``.

        Raises:
            KeyError: if the model has no such parameter.
        """
        names = CAMERA_MODELS[self.model][1]
        if name in ("fx", "fy") and name not in names:
            name = "f"
        if name not in names:
            raise KeyError(f"camera {self.id}: {self.model} has no parameter {name}, only {', '.join(names)}")
        return self.params[names.index(name)]


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """One posed image.

    Attributes:
        id: number by which points name it.
        quat: world-to-camera rotation, wxyz.
        translation: world-to-camera translation.
        camera_id: number of its camera.
        name: file name relative to the image folder.
        points2d: ``[n, 2]`` float64 features (x, y), the centre of the first pixel at (1/2, 1/2).
        point3d_ids: ``[n]`` int64 number of the point each feature belongs to, -1 for none.
    """

    id: int
    quat: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    camera_id: int
    name: str
    points2d: NDArray[np.float64]
    point3d_ids: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """All sparse points.

    Attributes:
        ids: ``[N]`` int64, unique.
        positions: ``[N, 3]`` float64, world frame.
        colors: ``[N, 3]`` uint8.
        errors: ``[N]`` float64 mean reprojection error in pixels, -1 where unknown.
        tracks: ``[T, 2]`` int64 observations (image id, row in that image's ``points2d``), point after point.
        track_lengths: ``[N]`` int64 observations of each point; they sum to T.
    """

    ids: NDArray[np.int64]
    positions: NDArray[np.float64]
    colors: NDArray[np.uint8]
    errors: NDArray[np.float64]
    tracks: NDArray[np.int64]
    track_lengths: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)

    @staticmethod
    def empty() -> ColmapPoints:
        """No points."""
        return ColmapPoints(
            np.zeros(0, np.int64),
            np.zeros((0, 3)),
            np.zeros((0, 3), np.uint8),
            np.zeros(0),
            np.zeros((0, 2), np.int64),
            np.zeros(0, np.int64),
        )


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse reconstruction: cameras and images by their number, in the files' order, and the points."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    points: ColmapPoints


def check_camera(camera: ColmapCamera, place: str) -> None:
    """Raises :class:`FormatError`, beginning with ``place``, unless the camera is one COLMAP could have."""
    if camera.model not in CAMERA_MODELS:
        raise FormatError(f"{place}: unknown camera model {camera.model!r}, known are {', '.join(CAMERA_MODELS)}")
    names = CAMERA_MODELS[camera.model][1]
    if len(camera.params) != len(names):
        raise FormatError(
            f"{place}: {camera.model} has {len(names)} parameters ({', '.join(names)}), got {len(camera.params)}"
        )
    if not (0 < camera.width < 1 << 31 and 0 < camera.height < 1 << 31):
        raise FormatError(f"{place}: image size {camera.width}x{camera.height} is not positive")
    if not np.isfinite(camera.params).all():
        raise FormatError(f"{place}: parameters {camera.params} are not all finite")
