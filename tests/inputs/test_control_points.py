"""Control points of photographs, in OpenDroneMap's format."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.geometry.test_geodesy import on_earth
from tests.inputs.match_database import orbit
from vg2gt.cli import place
from vg2gt.geometry.geodesy import from_utm
from vg2gt.inputs.control_points import read_control_points
from vg2gt.io import write_cameras_json
from vg2gt.io.cameras_json import NamedCamera, Photo
from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json

pycolmap = pytest.importorskip("pycolmap")
SCALE = 37.0
LENS = pycolmap.Camera(model="SIMPLE_RADIAL", width=1200, height=900, params=[1000, 610, 440, -0.12])


def scene(folder: Path, lens: bool) -> np.ndarray:
    """Writes cameras and returns control points in metres, east, north, up."""
    points = np.random.default_rng(0).uniform([-30, -30, 0], [30, 30, 12], (9, 3))
    matrix = np.array([[1000, 0, 609.5], [0, 1000, 439.5], [0, 0, 1.0]])
    lines, cameras = [], []
    for number, pose in enumerate(orbit(8)):
        name = f"flight/DJI_{number}.JPG"
        photo = Photo(name, 1200, 900, matrix, "unknown" if lens else "")
        cameras.append(NamedCamera(name[:-4], 120, 90, matrix * [[0.1], [0.1], [1]], pose, photo))
        inside = points / SCALE @ pose[:3, :3].T + pose[:3, 3]
        flat = inside[:, :2] / inside[:, 2:]
        pixels = LENS.img_from_cam(inside) if lens else flat * 1000 + [610, 440]
        if number == 3:
            pixels[2] += 300  # clicked elsewhere
        for (x, y, z), pixel, point in zip(on_earth(points), pixels, range(9), strict=True):
            lines.append(f"{y:.9f} {x:.9f}\t{z:.4f} {pixel[0]:.2f} {pixel[1]:.2f} dji_{number}.jpg point{point}\n")
    write_cameras_json(folder / "cameras.json", cameras)
    (folder / "gcp_list.txt").write_text("EPSG:4326\n" + "".join(lines))
    if lens:
        (folder / "sfm").mkdir()
        text = "SIMPLE_RADIAL 1200 900 " + " ".join(map(str, LENS.params))
        state = {"lenses": {camera.name: text for camera in cameras}}
        (folder / "sfm" / "sfm.json").write_text(json.dumps(state))
    return points


@pytest.mark.parametrize("lens", [False, True])
def test_scale_up_and_residuals_of_control_points(tmp_path: Path, lens: bool, capsys) -> None:
    points = scene(tmp_path, lens)
    place.main([str(tmp_path), "--control", str(tmp_path / "gcp_list.txt")])
    assert "a unit of" in capsys.readouterr().out
    report = read_json(tmp_path / "report.json")
    assert report["metres_per_unit"] == pytest.approx(SCALE, rel=0.002)
    assert np.degrees(np.arccos(report["gps"]["up"][2])) < 0.2
    off = report["control_points"]
    assert off["point2"] > 1
    assert max(value for name, value in off.items() if name != "point2") < 0.05
    to_enu = np.array(report["gps"]["to_enu"])
    assert np.ptp(points / SCALE @ to_enu[:3, :3].T + to_enu[:3, 3] - points, axis=0).max() < 0.1


@pytest.mark.parametrize(
    "header", ["EPSG:32617", "WGS84 UTM 17N", "+proj=utm +zone=17 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"]
)
def test_utm(tmp_path: Path, header: str) -> None:
    (tmp_path / "gcp.txt").write_text(f"{header}\n630084 4833438 76 10 20 a.jpg\n630084 4833438 76 30 40 b.jpg\n\n")
    (point,) = read_control_points(tmp_path / "gcp.txt")
    tower = (43 + 38 / 60 + 33.24 / 3600, -(79 + 23 / 60 + 13.7 / 3600), 76)  # CN Tower, as Wikipedia states both
    assert point.position == pytest.approx(tower, abs=1e-5)
    assert point.pixels == {"a.jpg": (10, 20), "b.jpg": (30, 40)}
    assert from_utm(500000, 1e7 - 1000, 56, True) == pytest.approx((-0.009047, 153), abs=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("EPSG:2154\n1 2 3 4 5 a.jpg\n", "first line is 'EPSG:2154'; convert the points"),
        ("EPSG:4326\n7 46 100 12 a.jpg\n", "line 2 is '7 46 100 12 a.jpg', expected x y z pixel_x pixel_y image"),
        ("", "first line is ''"),
    ],
)
def test_what_is_no_list_of_control_points(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "gcp_list.txt").write_text(text)
    with pytest.raises(FormatError, match=said):
        read_control_points(tmp_path / "gcp_list.txt")


def test_other_photographs_are_said(tmp_path: Path) -> None:
    scene(tmp_path, False)
    renamed = (tmp_path / "gcp_list.txt").read_text().replace("dji_", "img_")
    (tmp_path / "gcp_list.txt").write_text(renamed)
    with pytest.raises(SystemExit, match="0 of 9 control points are in two or more"):
        place.main([str(tmp_path), "--control", str(tmp_path / "gcp_list.txt")])
