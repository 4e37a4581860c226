from itertools import pairwise

import numpy as np
import pytest

from vg2gt.io import NamedCamera
from vg2gt.reconstruction.camera_files import interpolate

K = np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])


def _camera(x: float, turn: float = 0.0, focal: float = 50.0) -> NamedCamera:
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    pose[:3, 3] = (x, 0, 0)
    k = K.copy()
    k[0, 0] = k[1, 1] = focal
    return NamedCamera(f"c{x:g}", 64, 48, k, np.linalg.inv(pose).astype(np.float64))


def test_interpolation_passes_through_the_cameras() -> None:
    given = [_camera(0), _camera(1, 0.4, focal=60.0), _camera(3, 0.2)]
    path = interpolate(given, 3)
    assert (len(path), path[::4]) == (9, given)
    assert len({camera.name for camera in path}) == 9
    assert path[2].intrinsics[0, 0] == pytest.approx(55)
    jumps = [np.abs(a.world_to_camera - b.world_to_camera).max() for a, b in pairwise(path)]
    assert max(jumps) < 0.8
    (middle,) = interpolate([_camera(0), _camera(2, 0.5)], 1)[1:2]
    assert np.allclose(np.linalg.inv(middle.world_to_camera), np.linalg.inv(_camera(1, 0.25).world_to_camera))
    with pytest.raises(ValueError, match="at least two"):
        interpolate([_camera(0)], 2)
