"""Depth from a laser scan: against analytic surfaces, what is hidden, the cache, damaged scans."""

from functools import partial

import numpy as np
import pytest
import torch

from examples.data_sets.tanks_and_temples import TanksAndTemples, render_points
from vg2gt.data import DataError
from vg2gt.geometry.cameras import unproject
from vg2gt.io import write_point_ply

from .layout_tanks_and_temples import write as write_tanks
from .layouts import cameras_of, room

K = np.array([[100.0, 0, 49.5], [0, 100.0, 39.5], [0, 0, 1]])
VIEW = (80, 100)


def _wall(step: float, width: float, height: float, z: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-width / 2, width / 2, step), np.arange(-height / 2, height / 2, step))
    return np.stack((x.ravel(), y.ravel(), np.full(x.size, z)), -1).astype(np.float32)


def test_what_is_behind_a_sparse_surface_is_hidden():
    """A front wall with a point at every third pixel: points behind it are removed, points next to it stay."""
    front, back = _wall(0.06, 1.2, 1.0, 2.0), _wall(0.02, 8, 8, 4.0)
    depth = render_points(np.concatenate((back, front)), np.eye(4), K, VIEW)
    rows, columns = slice(20, 60), slice(25, 75)  # well inside the front wall's image
    inside = depth[rows, columns]
    assert set(np.unique(inside)) == {0.0, 2.0}
    assert 0.08 < (inside == 2).mean() < 0.15
    assert (depth[:, :12] == 4).all()
    shining = render_points(np.concatenate((back, front)), np.eye(4), K, VIEW, window=1)[rows, columns]
    assert (shining == 4).mean() > 0.5  # without the window, the wall would be full of holes


def test_the_scan_is_read(tmp_path):
    """Metres, in the scan's frame."""
    frames, cache = room(), str(tmp_path / "cache")
    points = unproject(frames.depth[None].double(), cameras_of(frames))[0][frames.depth > 0].numpy()
    write_tanks(tmp_path, frames)
    write_point_ply(tmp_path / "Barn" / "Barn.ply", points)
    make = partial(TanksAndTemples, str(tmp_path), depth_cache=cache)
    source = make()
    (scene,) = source.scenes
    ids = list(source.frames(scene))
    loaded = source.load(scene, ids)
    assert source.has_depth
    assert source.is_metric
    seen = loaded.depth > 0
    assert float(seen.float().mean()) > 0.05  # few: in so small images a window spans half the room
    error = (loaded.depth / frames.depth - 1).abs()[seen]
    assert float(error.median()) < 0.01
    kept = sorted((tmp_path / "cache" / "scan-depth").iterdir())
    assert len(kept) == len(ids)
    for path in kept:
        path.write_bytes(b"damaged")  # is made again
    assert torch.equal(make().load(scene, ids[:1]).depth, loaded.depth[:1])
    for path in tmp_path.rglob("*.ply"):
        path.unlink()
    with pytest.raises(DataError, match="has no scan"):
        make().frames(scene)
