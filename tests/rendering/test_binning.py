"""The order in which Gaussians are visited."""

import numpy as np
import pytest

from vg2gt.kernels.render_cpu.tiles import depth_order


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [0, 1, 3000])
def test_equal_depths_keep_their_order(dtype: type[np.floating], count: int) -> None:
    depths = np.random.default_rng(count).lognormal(1, 3, count).astype(dtype)
    depths[::3] = depths[: len(depths[::3])].round(1) + dtype(0.01)
    order = depth_order(depths)
    assert order.tolist() == sorted(range(count), key=lambda i: (depths[i], i))
    assert count < 2 or len(set(depths.tolist())) < count
