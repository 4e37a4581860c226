"""Undistortion against pycolmap's projections and against images whose undistorted form is known."""

from typing import Any

import numpy as np
import pytest

from vg2gt.data.sources.undistortion import Undistortion, is_pinhole, lens_text, undistortion_of

pycolmap: Any = pytest.importorskip("pycolmap")

SIZE = (90, 130)


def lens_of(params: list[float], model: str = "FULL_OPENCV"):
    return pycolmap.Camera(model=model, width=SIZE[1], height=SIZE[0], params=params)


def _directions(matrix: np.ndarray, size=SIZE) -> np.ndarray:
    """x/z and y/z of every pixel of a pinhole camera."""
    x, y = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    return np.stack(((x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1]), -1)


MODELS = {
    "SIMPLE_RADIAL": [110.0, 65.0, 45.0, 0.1],
    "RADIAL": [110.0, 65.0, 45.0, 0.1, -0.02],
    "OPENCV": [110.0, 108.0, 65.0, 45.0, 0.1, -0.02, 0.001, 0.002],
    "FULL_OPENCV": [110.0, 108.0, 62.8, 44.6, -0.25, 0.08, 0.002, -0.001, -0.01, 0, 0, 0],
    "OPENCV_FISHEYE": [110.0, 108.0, 65.0, 45.0, 0.01, 0, 0, 0],
    "SIMPLE_RADIAL_FISHEYE": [110.0, 65.0, 45.0, 0.01],
}


@pytest.mark.parametrize("name", MODELS)
def test_every_model_of_colmap_becomes_a_pinhole(name):
    """Directions of the pinhole's pixels project with the lens to where they are looked up."""
    lens = lens_of(MODELS[name], name)
    found = Undistortion.of(lens)
    rays = np.concatenate((_directions(found.intrinsics, found.size), np.ones((*found.size, 1))), -1)
    expected = lens.img_from_cam(rays.reshape(-1, 3)).reshape(*found.size, 2) - 0.5
    np.testing.assert_allclose(found.places, expected, atol=1e-4)
    margin = np.minimum(found.places + 0.5, np.array([SIZE[1] - 0.5, SIZE[0] - 0.5]) - found.places)
    assert -1 < margin.min() < 2  # no pixel is blank, and few are wasted
    assert 0.8 < found.size[0] / SIZE[0] < 1.3
    assert not is_pinhole(lens)
    large = undistortion_of(lens_text(lens, (1800, 2600)))  # of larger images, where places are interpolated
    np.testing.assert_allclose(large.intrinsics[:2, :2], 20 * found.intrinsics[:2, :2])
    rays = np.concatenate((_directions(large.intrinsics, large.size), np.ones((*large.size, 1))), -1)[::37, ::41]
    lens.rescale(2600, 1800)
    expected = lens.img_from_cam(np.ascontiguousarray(rays.reshape(-1, 3))).reshape(*rays.shape[:2], 2) - 0.5
    np.testing.assert_allclose(large.places[::37, ::41], expected, atol=0.01)


def test_coefficients_of_zero_are_a_pinhole_but_for_a_fisheye():
    for name, params in MODELS.items():
        extra = lens_of(params, name).extra_params_idxs()
        zeros = [0 if i in extra else value for i, value in enumerate(params)]
        assert is_pinhole(lens_of(zeros, name)) == ("FISHEYE" not in name)


def test_an_image_becomes_the_pinhole_cameras():
    """A lens's image of a pattern at infinity."""
    lens = lens_of(MODELS["FULL_OPENCV"])
    found = Undistortion.of(lens)
    x, y = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
    distorted = pattern(lens.cam_from_img(np.stack((x, y), -1).reshape(-1, 2) + 0.5).reshape(*SIZE, 2))
    result = found.color(distorted).astype(int)
    inner = (slice(0, 80), slice(0, 120))
    assert np.abs(result[inner] - distorted[inner]).max() > 40  # otherwise nothing was put to the test
    assert np.abs(result - pattern(_directions(found.intrinsics, found.size))).max() <= 2


def pattern(directions: np.ndarray) -> np.ndarray:
    waves = [np.sin(9 * directions[..., 0] + i) * np.cos(7 * directions[..., 1] - i) for i in range(3)]
    return (127.5 + 100 * np.stack(waves, -1)).astype(np.uint8)


def test_depth_takes_one_pixel_and_holes_stay():
    depth = np.where(np.arange(SIZE[1]) < 60, 2.0, 5.0).astype(np.float32) * np.ones(SIZE, np.float32)
    depth[::4] = 0
    assert set(np.unique(Undistortion.of(lens_of(MODELS["OPENCV"], "OPENCV")).depth(depth))) == {0.0, 2.0, 5.0}


@pytest.mark.parametrize("coefficients", [[-30.0, 0], [0, 1e300]])
def test_senseless_coefficients_are_refused(coefficients):
    with pytest.raises(ValueError, match="maps the image border outside the image"):
        Undistortion.of(lens_of([110.0, 65.0, 45.0, *coefficients], "RADIAL"))


def test_reduced_images_are_undistorted_to_the_same_camera():
    """Each pixel of a quarter is looked up where the sixteen of the whole are, also if the sides are no multiples."""
    lens = lens_of(MODELS["OPENCV"], "OPENCV")
    lens.rescale(1001, 702)
    whole = Undistortion.of(lens)
    small = whole.reduced((175, 250))
    for side in (0, 1):
        scale = small.size[side] / whole.size[side]
        axis = 1 - side
        assert abs(scale * 4 - 1) < 0.01
        assert small.intrinsics[axis, axis] == pytest.approx(whole.intrinsics[axis, axis] * scale)
    directions, places = _directions(small.intrinsics, small.size), (small.places + 0.5) / [250, 175]
    x, y = (directions[..., axis] * whole.intrinsics[axis, axis] + whole.intrinsics[axis, 2] for axis in (0, 1))
    rows, columns = y.round().astype(int)[5:-5, 5:-5], x.round().astype(int)[5:-5, 5:-5]
    expected = (whole.places[rows, columns] + 0.5) / [1001, 702]
    np.testing.assert_allclose(places[5:-5, 5:-5], expected, atol=1.5e-3)  # 0.7 of 1001 pixels, from rounding
    assert whole.reduced((702, 1001)) is whole
