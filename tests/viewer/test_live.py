"""The page that shows a refinement: what viser is given, and how often."""

import math

import numpy as np
import pytest
import torch

from tests.io.gaussian_scenes import scene
from vg2gt.types import Cameras, Gaussians
from vg2gt.viewer import live
from vg2gt.viewer.live import LiveView

viser = pytest.importorskip("viser")


def refined(count: int) -> tuple[Gaussians, Cameras]:
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[0, 1, 0, 3] = -1.0  # the second camera is at x = 1
    intrinsics = torch.tensor([[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]]).expand(1, 2, 3, 3)
    return scene(count, 1), Cameras(pose, intrinsics, (48, 64))


def test_the_page_shows_the_last_scene_and_its_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    view = LiveView(port=18431)
    try:
        assert view.address.startswith("http://127.0.0.1:")
        monkeypatch.setattr(live, "_INTERVAL", 0.0)
        view(lambda: refined(20))
        view(lambda: refined(30))
        handles = view.server.scene._handle_from_node_name
        splats = [handle for name, handle in handles.items() if name.startswith("/scene/")]
        assert [len(handle.centers) for handle in splats] == [30]
        truth = refined(30)[0]
        np.testing.assert_allclose(splats[0].centers, truth.means, rtol=1e-6)
        # the trace of a covariance is the sum of the squared standard deviations
        traces = np.trace(splats[0].covariances, axis1=1, axis2=2)
        np.testing.assert_allclose(traces, truth.scales.square().sum(-1), rtol=2e-3)  # viser keeps half precision
        second = handles["/cameras/1"]
        np.testing.assert_allclose(second.position, [1, 0, 0], atol=1e-6)
        assert math.isclose(second.fov, 2 * math.atan(24 / 50), rel_tol=1e-6)
    finally:
        view.close()


def test_it_is_not_updated_after_every_step() -> None:
    view, asked = LiveView(port=18431), []
    try:
        for _ in range(5):
            view(lambda: asked.append(1) or refined(4))
        assert len(asked) == 1
    finally:
        view.close()
