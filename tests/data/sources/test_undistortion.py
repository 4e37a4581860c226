"""Undistortion against kornia's distortion and against images whose undistorted form is known."""

import numpy as np
import pytest
import torch
from kornia.geometry.calibration import distort_points

from vg2gt.data.sources.undistortion import Undistortion

K = np.array([[110.0, 0, 62.3], [0, 108.0, 44.1], [0, 0, 1]])
SIZE = (90, 130)
LENSES = {
    "pincushion": {"k1": 0.058, "k2": -0.08, "p1": -0.001, "p2": 0.0002},
    "barrel": {"k1": -0.25, "k2": 0.08, "p1": 0.002, "p2": -0.001, "k3": -0.01},
}


def _directions(matrix: np.ndarray) -> np.ndarray:
    """x/z and y/z of every pixel of a pinhole camera."""
    x, y = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
    return np.stack(((x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1]), -1)


@pytest.mark.parametrize("name", LENSES)
def test_pixels_are_looked_up_where_kornia_distorts_them_to(name):
    k = LENSES[name]
    undistortion = Undistortion(K, k, False, SIZE)
    x, y = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
    pixels = torch.from_numpy(np.stack((x, y), -1).reshape(-1, 2).astype(np.float64))
    coefficients = torch.tensor([[k.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]], dtype=torch.float64)
    expected = distort_points(
        pixels, torch.from_numpy(K)[None], coefficients, new_K=torch.from_numpy(undistortion.intrinsics)[None]
    )
    np.testing.assert_allclose(undistortion.places.reshape(-1, 2), expected.reshape(-1, 2).numpy(), atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_the_view_is_as_wide_as_the_lens_allows(name):
    undistortion = Undistortion(K, LENSES[name], False, SIZE)
    places = undistortion.places
    margin = np.minimum(places + 0.5, np.array([SIZE[1] - 0.5, SIZE[0] - 0.5]) - places).min()
    assert margin >= -1e-9
    zoom = undistortion.intrinsics[0, 0] / K[0, 0]
    assert zoom == pytest.approx(undistortion.intrinsics[1, 1] / K[1, 1])
    assert (undistortion.intrinsics[:2, 2] == K[:2, 2]).all()
    if name == "barrel":
        assert zoom == 1
    else:
        assert 1 < zoom < 1.05
        assert margin < 0.05


def test_an_image_becomes_the_pinhole_cameras():
    """A lens's image of a pattern at infinity, rendered by inverting the distortion numerically."""
    k = LENSES["barrel"]

    def pattern(directions: np.ndarray) -> np.ndarray:
        waves = [np.sin(9 * directions[..., 0] + i) * np.cos(7 * directions[..., 1] - i) for i in range(3)]
        return (127.5 + 100 * np.stack(waves, -1)).astype(np.uint8)

    seen = _directions(K)
    rays = seen.copy()
    for _ in range(200):
        square = (rays**2).sum(-1, keepdims=True)
        radial = 1 + k["k1"] * square + k["k2"] * square**2 + k["k3"] * square**3
        x, y = rays[..., :1], rays[..., 1:]
        shift_x = 2 * k["p1"] * x * y + k["p2"] * (square + 2 * x**2)
        shift_y = k["p1"] * (square + 2 * y**2) + 2 * k["p2"] * x * y
        rays = (seen - np.concatenate((shift_x, shift_y), -1)) / radial
    undistortion = Undistortion(K, k, False, SIZE)
    result = undistortion.color(pattern(rays)).astype(int)
    expected = pattern(_directions(undistortion.intrinsics)).astype(int)
    assert np.abs(result - pattern(rays)).max() > 40  # otherwise nothing was put to the test
    assert np.abs(result - expected).max() <= 2


def test_fisheye_follows_the_angle():
    k = {"k1": 0.03, "k2": -0.01}
    undistortion = Undistortion(K, k, True, SIZE)
    x, y = 120, 10
    ray = np.array([*_directions(undistortion.intrinsics)[y, x], 1.0])
    angle = np.arccos(1 / np.linalg.norm(ray))
    radius = angle * (1 + k["k1"] * angle**2 + k["k2"] * angle**4)
    expected = ray[:2] / np.linalg.norm(ray[:2]) * radius * [K[0, 0], K[1, 1]] + K[:2, 2]
    np.testing.assert_allclose(undistortion.places[y, x], expected, atol=1e-9)


def test_depth_takes_one_pixel_and_holes_stay():
    depth = np.where(np.arange(SIZE[1]) < 60, 2.0, 5.0).astype(np.float32) * np.ones(SIZE, np.float32)
    depth[::4] = 0
    assert set(np.unique(Undistortion(K, LENSES["pincushion"], False, SIZE).depth(depth))) == {0.0, 2.0, 5.0}


@pytest.mark.parametrize("k", [{"k1": 30.0}, {"k1": -30.0}, {"k2": 1e300}, {"p1": 5.0}])
def test_senseless_coefficients_are_refused(k):
    with pytest.raises(ValueError, match="takes the image's border out of the image"):
        Undistortion(K, k, False, SIZE)
