"""nerfstudio's and instant-ngp's ``transforms.json``: posed frames with intrinsics, shared or per frame.

In the file, poses are camera-to-world with OpenGL axes (x right, y up, z backward), and the centre of the first pixel
is at (1/2, 1/2). Frames hold poses in our conventions. A :class:`Lens` holds the file's values;
:meth:`Lens.intrinsics` and :meth:`Lens.from_intrinsics` convert them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vg2gt.io.cameras_json import Fields, check_rigid
from vg2gt.io.files import read_json, write_json

PIXEL_CENTER = 0.5  # centre of the first pixel in the file; ours is at 0
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

_ANY, _POSITIVE, _ANGLE = (-math.inf, math.inf), (0, math.inf), (0, math.pi)
_LIMITS = {
    **dict.fromkeys(("fl_x", "fl_y"), _POSITIVE),
    **dict.fromkeys(("cx", "cy"), _ANY),
    **dict.fromkeys(("camera_angle_x", "camera_angle_y"), _ANGLE),
}
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV camera axes <-> OpenGL camera axes
_ROTATION_TOLERANCE = 0.02  # recorded poses are orthonormal to about 1e-3


@dataclass(frozen=True)
class Lens:
    """Intrinsics of frames as given in a file; None for missing values.

    Attributes:
        width: image width in pixels.
        height: image height in pixels.
        fl_x: horizontal focal length in pixels.
        fl_y: vertical focal length in pixels.
        cx: horizontal principal point in pixels, with the centre of the first pixel at 1/2.
        cy: vertical principal point in pixels, with the centre of the first pixel at 1/2.
        camera_angle_x: full horizontal field of view in radians; ``fl_x`` takes precedence.
        camera_angle_y: full vertical field of view in radians; ``fl_y`` takes precedence.
        camera_model: name of the camera model, such as ``OPENCV`` or ``OPENCV_FISHEYE``.
        distortion: OpenCV coefficients by name, among ``k1 ... k6 p1 p2``.
    """

    width: int | None = None
    height: int | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    camera_model: str | None = None
    distortion: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_distorted(self) -> bool:
        """Whether the images are not those of a pinhole camera: distorted or fisheye."""
        return any(value != 0 for value in self.distortion.values()) or "FISHEYE" in (self.camera_model or "").upper()

    @staticmethod
    def from_intrinsics(
        intrinsics: ArrayLike, size: tuple[int, int], distortion: Mapping[str, float] | None = None
    ) -> Lens:
        """Creates a lens from our intrinsics ``[3, 3]`` (integer pixel centres) and image ``(height, width)``."""
        k = np.asarray(intrinsics, np.float64)
        cx, cy = (float(k[axis, 2]) + PIXEL_CENTER for axis in (0, 1))
        width, height, distortion = int(size[1]), int(size[0]), dict(distortion or {})
        return Lens(width, height, float(k[0, 0]), float(k[1, 1]), cx, cy, camera_model="OPENCV", distortion=distortion)

    def intrinsics(self, size: tuple[int, int] | None = None) -> NDArray[np.floating]:
        """Returns pinhole intrinsics ``[3, 3]`` in pixels of the file's image size, with our integer pixel centres.

        A missing ``fl_x`` is computed from ``camera_angle_x``. A missing ``fl_y`` is computed from ``camera_angle_y``,
        or else equals ``fl_x``. A missing principal point is the image centre.

        Args:
            size: ``(height, width)`` of the images, used if the file gives none.

        Raises:
            ValueError: if the size is not known, or there is no focal length.
        """
        size = (self.height, self.width) if self.height and self.width else size
        if size is None or (self.fl_x is None and self.camera_angle_x is None):
            raise ValueError("intrinsics need fl_x or camera_angle_x, and the images' size: pass size=(height, width)")
        (height, width), fl_x, fl_y = size, self.fl_x, self.fl_y
        if fl_x is None and self.camera_angle_x is not None:
            fl_x = width / 2 / math.tan(self.camera_angle_x / 2)
        if fl_y is None:
            fl_y = fl_x if self.camera_angle_y is None else height / 2 / math.tan(self.camera_angle_y / 2)
        cx = width / 2 if self.cx is None else self.cx
        cy = height / 2 if self.cy is None else self.cy
        return np.array([[fl_x, 0, cx - PIXEL_CENTER], [0, fl_y, cy - PIXEL_CENTER], [0, 0, 1]])


@dataclass(frozen=True, eq=False)
class TransformsFrame:
    """One frame.

    Attributes:
        file_path: image path as given in the file, relative to the file's folder; it may not exist.
        world_to_camera: ``[4, 4]`` float64, OpenCV; all NaN where the file's pose is not finite.
        lens: the frame's intrinsics; missing values are filled with the file's shared ones.
        depth_file_path: depth image, or None.
        mask_path: mask image, or None.
    """

    file_path: str
    world_to_camera: NDArray[np.floating]
    lens: Lens
    depth_file_path: str | None = None
    mask_path: str | None = None


@dataclass(frozen=True, eq=False)
class Transforms:
    """Content of a ``transforms.json``.

    Attributes:
        frames: frames in the file's order, including those whose image does not exist.
        ply_file_path: point cloud of the scene in the world frame of the poses, or None.
    """

    frames: tuple[TransformsFrame, ...]
    ply_file_path: str | None = None


def read_transforms(path: str | Path) -> Transforms:
    """Reads a ``transforms.json``.

    Returns:
        The frames in our conventions; unknown fields are ignored.

    Raises:
        FormatError: if the file is not JSON or a field is wrong, naming the file and the field.
    """
    path = Path(path)
    top = Fields(f"{path}: ", read_json(path))
    shared = _read_lens(top, Lens())
    frames = top.get("frames", list, "a list of frames", required=True)
    read = [_read_frame(Fields(f"{path}: frames[{i}].", frame), shared) for i, frame in enumerate(frames)]
    return Transforms(tuple(read), top.get("ply_file_path", str, "a file name"))


def write_transforms(path: str | Path, transforms: Transforms) -> Path:
    """Writes a ``transforms.json``, atomically; intrinsics are at the top if all frames share them.

    Raises:
        ValueError: if a pose is not finite.
    """
    frames = transforms.frames
    shared = _lens_fields(frames[0].lens) if all(frame.lens == frames[0].lens for frame in frames) and frames else {}
    cloud = {} if transforms.ply_file_path is None else {"ply_file_path": transforms.ply_file_path}
    return write_json(path, {**shared, **cloud, "frames": [_frame_fields(frame, not shared) for frame in frames]})


def _read_lens(fields: Fields, shared: Lens) -> Lens:
    """Reads the lens of one object; missing values are taken from ``shared``."""
    own = {
        "width": fields.pixels("w"),
        "height": fields.pixels("h"),
        **{name: fields.number(name, *limits) for name, limits in _LIMITS.items()},
        "camera_model": fields.get("camera_model", str, "a camera model's name"),
    }
    if fields.content.get("is_fisheye") is True:  # instant-ngp's flag
        own["camera_model"] = "OPENCV_FISHEYE"
    coefficients = {name: fields.number(name) for name in _DISTORTION}
    given = {name: value for name, value in coefficients.items() if value is not None}
    return replace(
        shared,
        **{name: value for name, value in own.items() if value is not None},
        distortion={**shared.distortion, **given},
    )


def _read_frame(fields: Fields, shared: Lens) -> TransformsFrame:
    kinds = ("file", "depth_file", "mask")
    named = (fields.get(f"{kind}_path", str, "a file name") for kind in kinds)
    file_path, depth, mask = (None if name is None else name.replace("\\", "/") for name in named)  # from Windows
    if not file_path:
        raise fields.wrong("file_path", "the name of an image file")
    lens = _read_lens(fields, shared)
    if lens.fl_x is None and lens.camera_angle_x is None:
        raise fields.wrong("fl_x", "fl_x or camera_angle_x, here or at the top of the file")
    pose = np.vstack((fields.matrix("transform_matrix", (3, 4), 4), [0, 0, 0, 1]))[:4]
    if np.isfinite(pose).all():
        check_rigid(f"{fields.place}transform_matrix", pose, _ROTATION_TOLERANCE)
        pose = np.linalg.inv(pose @ _OPENGL)
    else:
        pose = np.full((4, 4), np.nan)
    return TransformsFrame(file_path, pose, lens, depth, mask)


def _frame_fields(frame: TransformsFrame, with_lens: bool) -> dict[str, Any]:
    pose = np.asarray(frame.world_to_camera, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"{frame.file_path}: world_to_camera must be finite [4, 4], got {pose.tolist()}")
    paths = {name: getattr(frame, name) for name in ("file_path", "depth_file_path", "mask_path")}
    content = {name: path for name, path in paths.items() if path is not None}
    content["transform_matrix"] = (np.linalg.inv(pose) @ _OPENGL).tolist()
    return {**content, **_lens_fields(frame.lens)} if with_lens else content


def _lens_fields(lens: Lens) -> dict[str, Any]:
    own = {name: getattr(lens, name) for name in (*_LIMITS, "camera_model")}
    content = {"w": lens.width, "h": lens.height, **own, **lens.distortion}
    return {name: value for name, value in content.items() if value is not None}
