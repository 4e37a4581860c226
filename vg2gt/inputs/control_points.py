"""Control points: in OpenDroneMap's format, with the pixels of photographs that show them, or as a CSV.

The first line of OpenDroneMap's ``gcp_list.txt`` is the projection (``EPSG:4326``, ``EPSG:32632``, ``WGS84 UTM 32N``,
``+proj=utm +zone=32``), each other one ``x y z pixel_x pixel_y image [name]``; longitude comes before latitude. Lines
of equal x, y and z are one point.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.sources.undistortion import undistortion_of
from vg2gt.geometry.geodesy import Place, enu, fit_place, from_utm, place_of_points
from vg2gt.inputs.given_cameras import SFM_STATE
from vg2gt.inputs.pictures import UNKNOWN_LENS
from vg2gt.io.cameras_json import NamedCamera
from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json

_DEGREES = re.compile(r"(epsg:4326|wgs84|\+proj=(longlat|latlong)\b.*)", re.I)
_UTM = re.compile(r"(?:epsg:32([67])(\d\d)|wgs84 utm (\d+)\s*([ns])|\+proj=utm (?=.*\+zone=(\d+))(.*))", re.I)
_EXPECTED = "expected x y z pixel_x pixel_y image"


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A point of known position.

    Attributes:
        name: its name in the file, or its number.
        position: latitude and longitude in degrees (WGS 84), altitude in metres.
        pixels: where it is in photographs, in their pixels from the upper left corner, by image name.
    """

    name: str
    position: NDArray[np.float64]
    pixels: dict[str, tuple[float, float]]


def read_control_points(file: Path) -> list[ControlPoint]:
    """Reads a ``gcp_list.txt``.

    Raises:
        FormatError: if the projection is neither longitude and latitude nor UTM of WGS 84, or a line is wrong.
    """
    header, *lines = file.read_text(encoding="utf-8-sig").splitlines() or [""]
    utm = _UTM.fullmatch(header.strip())
    if utm is None and not _DEGREES.fullmatch(header.strip()):
        raise FormatError(f"{file}: the first line is {header!r}; convert the points to EPSG:4326 or to UTM of WGS 84")
    points: dict[tuple[float, ...], ControlPoint] = {}
    for number, line in enumerate(lines, 2):
        fields = line.split()
        if not fields or line.startswith("#"):
            continue
        try:
            x, y, z, *pixel = map(float, fields[:5])
        except ValueError:
            pixel = []
        if len(pixel) != 2 or len(fields) < 6 or not np.isfinite([x, y, z, *pixel]).all():
            raise FormatError(f"{file}: line {number} is {line!r}, {_EXPECTED}")
        if (x, y, z) not in points:
            latitude, longitude = (y, x) if utm is None else from_utm(x, y, *_zone(utm))
            name = fields[6] if len(fields) > 6 else str(len(points) + 1)
            points[x, y, z] = ControlPoint(name, np.array([latitude, longitude, z]), {})
        points[x, y, z].pixels[fields[5]] = (pixel[0], pixel[1])
    return list(points.values())


def place_of_csv(file: Path) -> Place:
    """Returns the place that control points in a scene's own frame give.

    Args:
        file: three or more lines ``x,y,z,latitude,longitude,altitude``, in scene units, degrees and metres.

    Raises:
        ValueError: if a line is wrong, or the points are on one line or do not fit each other.
    """
    expected = f"{file}: expected three or more lines x,y,z,latitude,longitude,altitude"
    try:
        rows = np.loadtxt(file, delimiter=",", ndmin=2)
    except ValueError as error:
        raise ValueError(f"{expected} ({error})") from error
    if rows.shape[1] != 6 or len(rows) < 3 or not np.isfinite(rows).all():
        raise ValueError(f"{expected}, got {len(rows)} of {rows.shape[1]} numbers")
    place = place_of_points(rows[:, :3], rows[:, 3:])
    if not place.is_level:
        raise ValueError(f"{file}: the control points are on one line, or do not fit each other ({place.error:.3g} m)")
    return place


def _zone(utm: re.Match[str]) -> tuple[int, bool]:
    """Returns the zone, and whether it is south of the equator."""
    hemisphere, epsg, zone, side, proj, rest = utm.groups()
    return int(epsg or zone or proj), hemisphere == "7" or (side or "").lower() == "s" or "+south" in (rest or "")


def fit_control_points(
    points: Sequence[ControlPoint], cameras: Sequence[NamedCamera], scene: Path
) -> tuple[Place, dict[str, float]]:
    """Fits a scene to control points, triangulated from the photographs; outliers of four or more do not count.

    Args:
        points: control points.
        cameras: cameras of the scene; points in one of them, or in none, do not count.
        scene: its folder, in which structure from motion has left its lenses.

    Returns:
        The place of the scene's world, and by name how far each point is off, in metres.

    Raises:
        ValueError: if fewer than three points are seen in two photographs, are on one line, or do not fit each other.
    """
    state = scene / "sfm" / SFM_STATE
    lenses = read_json(state).get("lenses", {}) if state.is_file() else {}
    known = {_stem(camera.photo.name): camera for camera in cameras if camera.photo is not None}
    seen: list[ControlPoint] = []
    places: list[NDArray[np.float64]] = []
    for point in points:
        rays = [_ray(known[_stem(name)], pixel, lenses) for name, pixel in point.pixels.items() if _stem(name) in known]
        if len(rays) > 1:
            seen.append(point)
            places.append(_crossing(*(np.stack(part) for part in zip(*rays, strict=True))))
    if len(seen) < 3:
        raise ValueError(
            f"{len(seen)} of {len(points)} control points are in two or more photographs of the scene, three "
            "are needed: check the names of the images"
        )
    found, positions = np.stack(places), np.stack([point.position for point in seen])
    place = place_of_points(found, positions) if len(seen) == 3 else fit_place(found, positions)
    if place is None or not place.is_level:
        raise ValueError("the control points are on one line, or do not fit each other: check positions and pixels")
    off = enu(positions, np.array(place.origin)) - found @ place.to_enu[:3, :3].T - place.to_enu[:3, 3]
    return place, {point.name: float(np.linalg.norm(each)) for point, each in zip(seen, off, strict=True)}


def _stem(name: str) -> str:
    return PurePosixPath(name).stem.lower()


def _ray(
    camera: NamedCamera, pixel: tuple[float, float], lenses: Mapping[str, str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the centre of a camera and the direction of a pixel of its photograph, in the scene's world."""
    assert camera.photo is not None
    lens = lenses.get(camera.name, "") if camera.photo.lens == UNKNOWN_LENS else camera.photo.lens
    if camera.photo.lens and not lens:
        raise ValueError(f"the lens of {camera.photo.name} is not known: make the scene again with this version")
    if lens:
        x, y = undistortion_of(lens).camera.cam_from_img(np.array([pixel]))[0]
        ray = np.array([x, y, 1.0])
    else:
        ray = np.linalg.solve(camera.photo.intrinsics, np.array([pixel[0] - 0.5, pixel[1] - 0.5, 1]))
    pose = camera.world_to_camera
    turned = pose[:3, :3].T @ ray
    return -pose[:3, :3].T @ pose[:3, 3], turned / np.linalg.norm(turned)


def _crossing(centers: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the point ``[3]`` nearest to rays ``[N, 3]``."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.solve(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0])
