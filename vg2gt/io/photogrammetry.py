"""Cameras of photogrammetry programs: Metashape (XML), RealityScan (CSV), Bundler (``bundle.out``), VisualSFM (NVM).

All become COLMAP cameras, with the principal point from the corner of the first pixel, and ``world_to_camera`` poses
with OpenCV axes in the world of the file:

- Metashape: camera-to-world with OpenCV axes, then the transform of its component or chunk, which is in metres if the
  chunk has been scaled or georeferenced. Brown distortion, whose ``p1`` and ``p2`` are OpenCV's in the other order.
- RealityScan (RealityCapture), "Internal/External camera parameters": position, and heading, pitch and roll in degrees
  of a camera that looks down with north up if all are 0; lengths in millimetres of a sensor whose longer side is 36 mm.
- Bundler: ``world_to_camera`` with OpenGL axes, origin in the image centre; names in ``list.txt`` or ``FILE.list.txt``.
- NVM: quaternion ``w x y z`` of the rotation and the camera's centre; distortion of measured, not of ideal positions.
"""

from __future__ import annotations

import csv
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vg2gt.io.cameras_json import invert_pose
from vg2gt.io.errors import FormatError, some
from vg2gt.io.files import regular

log = logging.getLogger(__name__)

_SUFFIXES = (".xml", ".csv", ".out", ".nvm")
_SENSOR = 36.0  # millimetres
_LISTS = ("{}.list.txt", "list.txt", "../list.txt")  # names of Bundler's images, {}: its file
_RADII = np.linspace(0.01, 1, 60)  # of the largest radius, where a distortion is fitted
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class ForeignCamera:
    """A posed image of another program.

    Attributes:
        name: of the image, with or without folders and suffix, as the file has it.
        world_to_camera: ``[4, 4]`` float64, OpenCV axes.
        size: ``(height, width)`` of the image; None: the file does not tell.
        focal: focal length in pixels, horizontal and vertical, or of ``unit``.
        principal: offset of the principal point from the image centre, in the same unit.
        radial: ``k1 k2 k3 k4`` of ``1 + k1 r^2 + k2 r^4 + ...``.
        tangential: OpenCV's ``p1 p2``.
        unit: pixels per unit; None: the longer side of the image / 36.
        kind: ``frame`` (pinhole), ``fisheye`` (equidistant), or ``measured``: ``radial`` undistorts measured positions.
    """

    name: str
    world_to_camera: NDArray[np.float64]
    size: tuple[int, int] | None
    focal: tuple[float, float]
    principal: tuple[float, float] = (0.0, 0.0)
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    unit: float | None = 1.0
    kind: str = "frame"

    def lens(self, size: tuple[int, int]) -> tuple[str, list[float]]:
        """Returns the name and the parameters of the COLMAP camera model for an image of ``(height, width)``."""
        size = self.size or size
        unit = max(size) / _SENSOR if self.unit is None else self.unit
        fx, fy = (value * unit for value in self.focal)
        center = [size[1] / 2 + self.principal[0] * unit, size[0] / 2 + self.principal[1] * unit]
        if self.kind == "fisheye":
            k1, k2, k3, k4 = self.radial
            if any(self.tangential):
                return "THIN_PRISM_FISHEYE", [fx, fy, *center, k1, k2, *self.tangential, k3, k4, 0.0, 0.0]
            return "OPENCV_FISHEYE", [fx, fy, *center, k1, k2, k3, k4]
        if not (any(self.radial) or any(self.tangential)):
            return "PINHOLE", [fx, fy, *center]
        k1, k2, k3, k4 = self.radial
        rational = [0.0, 0.0, 0.0]
        if k4 or self.kind == "measured":
            reach = np.hypot(*size) / 2 / min(fx, fy)
            k1, k2, k3, *rational = _fitted(np.array(self.radial), reach, self.kind == "measured")
        return "FULL_OPENCV", [fx, fy, *center, k1, k2, *self.tangential, k3, *rational]


def is_camera_file(path: Path) -> bool:
    """Returns whether a file has cameras of one of the programs, by its first bytes."""
    if path.suffix.lower() not in _SUFFIXES or not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(4096).lstrip(b"\xef\xbb\xbf \r\n")
    if path.suffix.lower() == ".xml":
        return b"<document" in head and b"<chunk" in head
    start = {".csv": b"#name,", ".out": b"# Bundle file", ".nvm": b"NVM_V3"}[path.suffix.lower()]
    return head.startswith(start)


def read_photogrammetry(path: str | Path) -> list[ForeignCamera]:
    """Reads the cameras of a file; images without a pose are left out.

    Raises:
        FormatError: if the file is damaged, or its cameras are of a kind that is not read (spherical).
    """
    path = Path(path)
    reader = {".xml": _metashape, ".csv": _reality_scan, ".out": _bundler, ".nvm": _nvm}[path.suffix.lower()]
    try:
        cameras = reader(path, regular(path).read_text(encoding="utf-8-sig", errors="replace"))
    except (ValueError, KeyError, IndexError, StopIteration, TypeError, ElementTree.ParseError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{path}: damaged file of cameras ({type(error).__name__}: {error})") from error
    for camera in cameras:
        finite = np.isfinite(camera.world_to_camera).all() and np.isfinite([*camera.focal, *camera.principal]).all()
        if not finite or min(camera.focal) <= 0:
            raise FormatError(f"{path}: the camera of {camera.name} is not finite, or has no positive focal length")
    return cameras


def _metashape(path: Path, text: str) -> list[ForeignCamera]:
    if "<!DOCTYPE" in text:
        raise FormatError(f"{path}: a file of cameras has no document type definition")
    root = ElementTree.fromstring(text)  # noqa: S314  without definitions nothing expands
    worlds: dict[tuple[int, str | None], list[ForeignCamera]] = {}
    for number, chunk in enumerate(root.iter("chunk")):
        sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
        moves = {part.get("id"): part.find("transform") for part in chunk.iter("component")}
        whole = chunk.find("transform")
        for camera in chunk.iter("camera"):
            place = camera.findtext("transform")
            if place is None or camera.get("enabled", "true").lower() in ("false", "0"):
                continue
            part = camera.get("component_id")
            pose = _similarity(moves.get(part, whole)) @ np.array(place.split(), float).reshape(4, 4)
            pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
            known = _of_sensor(path, camera.get("label", ""), sensors[camera.get("sensor_id")], invert_pose(pose))
            # components without a transform share no world
            worlds.setdefault((number, part if moves.get(part, whole) is None else None), []).append(known)
    found = max(worlds.values(), key=len, default=[])
    if len(worlds) > 1:
        others = [camera.name for cameras in worlds.values() if cameras is not found for camera in cameras]
        log.warning(
            "%s has several chunks or components, each with a world of its own: the largest is used. Merge or align "
            "them in Metashape; ignored: %s", path, some(others),
        )  # fmt: skip
    return found


def _similarity(element: ElementTree.Element | None) -> NDArray[np.float64]:
    """Returns the transform ``[4, 4]`` of a chunk or component; the identity if it has none."""
    matrix = np.eye(4)
    if element is None:
        return matrix
    if element.text and len(element.text.split()) == 16:
        return np.array(element.text.split(), float).reshape(4, 4)
    rotation, translation, scale = (element.findtext(name) for name in ("rotation", "translation", "scale"))
    if rotation:
        matrix[:3, :3] = np.array(rotation.split(), float).reshape(3, 3)
    if translation:
        matrix[:3, 3] = np.array(translation.split(), float)
    matrix[:3, :3] *= float(scale) if scale else 1.0
    return matrix


def _of_sensor(path: Path, label: str, sensor: ElementTree.Element, pose: NDArray[np.float64]) -> ForeignCamera:
    calibrations = {each.get("class", "adjusted"): each for each in sensor.iter("calibration")}
    calibration = calibrations.get("adjusted", next(iter(calibrations.values()), None))
    kind = sensor.get("type", "frame") if calibration is None else calibration.get("type", sensor.get("type", "frame"))
    resolution = sensor.find("resolution")
    if kind not in ("frame", "fisheye", "equidistant_fisheye") or calibration is None or resolution is None:
        why = "no calibration" if kind.startswith(("frame", "fish", "equi")) else f"the type {kind}, which is not read"
        raise FormatError(f"{path}: the sensor of {label} has {why}; export cameras of frame or fisheye type")

    def value(name: str) -> float:
        return float(calibration.findtext(name) or 0)

    unread = {"b2": "skew, of one pixel and more", "p3": "tangential distortion", "p4": "tangential distortion"}
    if ignored := [f"{name} ({unread[name]})" for name in unread if abs(value(name)) > (1 if name == "b2" else 0)]:
        log.warning("%s: of %s, %s is ignored: optimise the cameras without it", path, label, ", ".join(ignored))
    width, height = int(resolution.get("width", "")), int(resolution.get("height", ""))
    fy = value("f") or value("fy")
    return ForeignCamera(
        label,
        pose,
        (height, width),
        ((value("f") or value("fx")) + value("b1"), fy),
        # old files have fx, fy and the principal point from the corner
        (value("cx"), value("cy")) if value("f") else (value("cx") - width / 2, value("cy") - height / 2),
        (value("k1"), value("k2"), value("k3"), value("k4")),
        (value("p2"), value("p1")),
        kind="frame" if kind == "frame" else "fisheye",
    )


def _reality_scan(path: Path, text: str) -> list[ForeignCamera]:
    found = []
    for row in csv.DictReader(text.splitlines()):
        number = {name: float(value) for name, value in row.items() if name and name != "#name" and value}
        angles = [-number["heading"], number["pitch"], number["roll"]]
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
        pose[:3, 3] = number["x"], number["y"], number["alt"]
        radial = tuple(number.get(name, 0.0) for name in ("k1", "k2", "k3", "k4"))
        found.append(
            ForeignCamera(
                str(row["#name"]),
                _OPENGL @ invert_pose(pose),
                None,
                (number["f"], number["f"]),
                (number.get("px", 0.0), number.get("py", 0.0)),
                (radial[0], radial[1], radial[2], radial[3]),
                (number.get("t1", 0.0), number.get("t2", 0.0)),
                unit=None,
            )
        )
    return found


def _bundler(path: Path, text: str) -> list[ForeignCamera]:
    places = [path.parent / name.format(path.name) for name in _LISTS]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise FormatError(f"{path}: the names of its images are missing: put list.txt next to it")
    lines = [line.strip() for line in file.read_text(encoding="utf-8", errors="replace").splitlines()]
    names = [re.sub(r"\s+\d+(\s+[\d.eE+-]+)?$", "", line) for line in lines if line]
    numbers = [float(word) for line in text.splitlines() if not line.startswith("#") for word in line.split()]
    count = int(numbers[0])
    if count > len(names) or len(numbers) < 2 + 15 * count:
        raise FormatError(f"{path}: {count} cameras, but {len(names)} names in {file}, or the file is cut off")
    found = []
    for name, row in zip(names, np.array(numbers[2 : 2 + 15 * count]).reshape(count, 15), strict=False):
        if row[0] > 0:  # 0: not placed
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = row[3:12].reshape(3, 3), row[12:]
            radial = (float(row[1]), float(row[2]), 0.0, 0.0)
            found.append(ForeignCamera(name, _OPENGL @ pose, None, (float(row[0]), float(row[0])), radial=radial))
    return found


def _nvm(path: Path, text: str) -> list[ForeignCamera]:
    lines = iter([line.strip() for line in text.splitlines() if line.strip()])
    head = next(lines).split()
    fixed = [float(word) for word in head[2:]] if "FixedK" in head else None  # fx cx fy cy r
    found = []
    for _ in range(int(next(lines))):
        name, *words = next(lines).rsplit(maxsplit=10)
        focal, *rest = (float(word) for word in words)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(rest[:4], scalar_first=True).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ rest[4:7]
        if fixed is not None:
            log.warning("%s: the principal point of its FixedK line is ignored", path)
            fixed = None
        radial = (rest[7], 0.0, 0.0, 0.0)
        name = name.replace('"', " ")  # spaces
        found.append(ForeignCamera(name, pose, None, (focal, focal), radial=radial, kind="measured"))
    return found


def _fitted(radial: NDArray[np.float64], reach: float, measured: bool) -> Sequence[float]:
    """Returns ``k1 ... k6`` of OpenCV's rational model for a polynomial up to ``r^8``, or for its inverse."""
    from scipy.optimize import least_squares

    radius = _RADII * reach
    powers = np.stack([radius**2, radius**4, radius**6, radius**8], 1)
    if measured:  # ideal = measured (1 + k r^2)
        ideal, factor = radius * (1 + powers @ radial), 1 / (1 + powers @ radial)
        powers = np.stack([ideal**2, ideal**4, ideal**6], 1)
    else:
        factor = 1 + powers @ radial
        powers = powers[:, :3]

    def difference(k: NDArray[np.float64]) -> NDArray[np.float64]:
        return (1 + powers @ k[:3]) / (1 + powers @ k[3:]) - factor

    start = np.array([-radial[0] if measured else radial[0], *([0.0, 0.0] if measured else radial[1:3]), 0, 0, 0])
    return [float(value) for value in least_squares(difference, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x]
