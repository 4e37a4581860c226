"""Positions on the Earth, and the place of cameras by them."""

import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from vg2gt.geometry.geodesy import enu, fit_place
from vg2gt.io.image_files import gps_position

ORIGIN = np.array([46.8425, -91.9945, 198.3])


def on_earth(metres: np.ndarray) -> np.ndarray:
    """Latitude, longitude and altitude of metres ``[N, 3]`` east, north, up of the origin, by radii of curvature."""
    squared, sine = 0.00669437999014, np.sin(np.radians(ORIGIN[0]))
    across = 6378137 / np.sqrt(1 - squared * sine**2)
    along = across * (1 - squared) / (1 - squared * sine**2)
    north = np.degrees(metres[:, 1] / (along + ORIGIN[2]))
    east = np.degrees(metres[:, 0] / ((across + ORIGIN[2]) * np.cos(np.radians(ORIGIN[0]))))
    return ORIGIN + np.stack([north, east, metres[:, 2]], 1)


def with_gps(path, position, latitude_reference: str | None = None) -> None:
    """Writes into a photograph's EXIF data where it was taken."""
    exif = Image.Exif()
    tags, parts = ExifTags.GPS, []
    for angle in np.abs(position[:2]):
        minutes = angle % 1 * 60
        parts.append((float(int(angle)), float(int(minutes)), minutes % 1 * 60))
    altitude = {
        tags.GPSAltitudeRef: b"\0" if position[2] > 0 else b"\1",
        tags.GPSAltitude: abs(position[2]),
    }
    exif[ExifTags.IFD.GPSInfo] = {
        tags.GPSLatitudeRef: ("N" if position[0] > 0 else "S") if latitude_reference is None else latitude_reference,
        tags.GPSLatitude: parts[0],
        tags.GPSLongitudeRef: "E" if position[1] > 0 else "W",
        tags.GPSLongitude: parts[1],
        **(altitude if np.isfinite(position[2]) else {}),
    }
    with Image.open(path) as image:
        image.load()
        image.save(path, exif=exif)


def test_metres_of_degrees() -> None:
    metres = np.array([[0, 0, 0], [120, 0, 0], [0, -80, 0], [30, 40, 25.0]])
    assert np.abs(enu(on_earth(metres), ORIGIN) - metres).max() < 0.01


@pytest.mark.parametrize("position", [(46.8425, -91.9945, 198.3), (-33.9, 151.2, -12.5)])
def test_position_of_a_photograph(tmp_path, position) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    assert gps_position(tmp_path / "a.jpg") is None
    with_gps(tmp_path / "a.jpg", position)
    # EXIF stores fractions, of seconds to 1e-6
    assert gps_position(tmp_path / "a.jpg") == pytest.approx(position, abs=1e-5)


@pytest.mark.parametrize(
    ("side", "sign"), [("s", -1), ("South", -1), ("S\0\0", -1), (" S", -1), ("", None), ("?", None)]
)
def test_references_as_some_programs_write_them(tmp_path, side: str, sign: int | None) -> None:
    """A sign that is not known is no position, rather than one on the other half of the Earth."""
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    with_gps(tmp_path / "a.jpg", (46.5, 7, 100), side)
    assert gps_position(tmp_path / "a.jpg") == (None if sign is None else (sign * 46.5, 7, 100))


def test_a_position_without_an_altitude_does_not_count(tmp_path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    with_gps(tmp_path / "a.jpg", (46.5, 7, np.nan))
    assert gps_position(tmp_path / "a.jpg") == pytest.approx((46.5, 7, np.nan), nan_ok=True)
    assert fit_place(np.eye(5, 3), np.tile((46.5, 7, np.nan), (5, 1))) is None


def test_scale_place_and_up_in_spite_of_outliers() -> None:
    generator = np.random.default_rng(0)
    flight = np.stack([np.tile(np.arange(8) * 20.0, 5), np.repeat(np.arange(5) * 25.0, 8), 60 + 0 * np.arange(40)], 1)
    measured = on_earth(flight + generator.normal(0, [1.5, 1.5, 3], (40, 3)))
    measured[[3, 17, 30]] = on_earth(np.array([[900.0, 0, 40], [0, -500, 20], [70, 60, 400]]))
    measured[11] = np.nan
    turn = Rotation.random(random_state=1)
    centers = turn.inv().apply(flight - [70, 50, 60]) / 37 + [4, 5, 6]
    place = fit_place(centers, measured)
    assert place is not None
    assert place.scale == pytest.approx(37, rel=0.02)
    assert place.is_level
    assert place.used >= 30
    assert 0.5 < place.error < 5
    assert place.scale_error < 0.02
    assert np.degrees(np.arccos(place.up @ turn.inv().apply([0, 0, 1]))) < 3
    back = enu(on_earth(flight), np.array(place.origin))
    found = centers @ place.to_enu[:3, :3].T + place.to_enu[:3, 3]
    assert np.linalg.norm(found - back, axis=1).max() < 4


@pytest.mark.parametrize(("step", "noise"), [(0, 1), (0, 5), (48, 1)])  # metres, noise of altitudes
def test_altitudes_of_two_references_are_brought_to_one(step: float, noise: float, caplog) -> None:
    """Half of a circle of 40 m has altitudes above the ellipsoid, the other above sea level."""
    generator = np.random.default_rng(0)
    angle = np.arange(30) * np.pi / 15
    circle = np.stack([40 * np.cos(angle), 40 * np.sin(angle), 20 + 0 * angle], 1)
    altered = circle + step * np.outer(angle < np.pi, (0, 0, 1))
    place = fit_place(circle / 37, on_earth(altered + generator.normal(0, (1, 1, noise), circle.shape)))
    assert place is not None
    assert place.scale == pytest.approx(37, rel=0.02)
    assert np.degrees(np.arccos(place.up[2])) < 5
    assert ("two references, 4" in caplog.text) == (step > 0)


def test_positions_that_tell_nothing_or_not_all() -> None:
    """A phone around a bench; a single street, which does not tell what is up; one fix for all photographs."""
    generator = np.random.default_rng(0)
    bench = generator.normal(0, 1.0, (20, 3))
    assert fit_place(bench, on_earth(bench + generator.normal(0, 4, (20, 3)))) is None
    assert fit_place(bench, np.tile(ORIGIN, (20, 1))) is None
    assert fit_place(bench[:3], on_earth(bench[:3])) is None
    street = np.outer(np.arange(30), [4.0, 3.0, 0])
    place = fit_place(street / 12, on_earth(street + generator.normal(0, 1, street.shape)))
    assert place is not None
    assert place.scale == pytest.approx(12, rel=0.02)
    assert not place.is_level
