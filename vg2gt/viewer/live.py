"""A page that shows a scene while it is refined, served by viser."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.rotations import matrix_to_quat, quat_to_matrix
from vg2gt.geometry.spherical_harmonics import sh_to_rgb
from vg2gt.types import Cameras, Gaussians

_INTERVAL = 5.0  # seconds between two updates, which take time from the refinement
_FRUSTUM = 0.1  # size of a drawn camera, in mean distances of the cameras from their middle


class LiveView:
    """Serves a scene on a page of this machine, and updates it every few seconds.

    Colours are those of the constant spherical harmonic.

    Args:
        port: port of the page; the next free one is taken if it is in use.

    Raises:
        ImportError: if viser is not installed.
    """

    def __init__(self, port: int = 8080) -> None:
        try:
            import viser  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ImportError("--watch needs viser: pip install 'vg2gt[watch]'") from error
        self.server: Any = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
        self._shown: Any = None
        self._last = -math.inf

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    def __call__(self, scene: Callable[[], tuple[Gaussians, Cameras]]) -> None:
        """Shows the Gaussians and cameras that a function returns, unless the page was updated a moment ago."""
        if time.monotonic() < self._last + _INTERVAL:
            return
        gaussians, cameras = scene()
        if self._shown is None:
            self._draw_cameras(cameras)
        before, self._shown = self._shown, self._draw(gaussians)
        if before is not None:
            before.remove()
        self._last = time.monotonic()

    def close(self) -> None:
        """Stops the server."""
        self.server.stop()

    def _draw(self, gaussians: Gaussians) -> Any:
        axes = quat_to_matrix(gaussians.quats) * gaussians.scales[:, None]
        return self.server.scene.add_gaussian_splats(
            f"/scene/{time.monotonic_ns()}",
            centers=_array(gaussians.means),
            covariances=_array(axes @ axes.mT),
            rgbs=_array(sh_to_rgb(gaussians.sh[:, :1], gaussians.means).clamp(0, 1)),
            opacities=_array(gaussians.opacities[:, None]),
        )

    def _draw_cameras(self, cameras: Cameras) -> None:
        """Draws the cameras; the page opens at the first, with its y axis down."""
        poses, (height, width) = invert_rigid(cameras.world_to_camera[0]), cameras.size
        centers, quats = poses[:, :3, 3], matrix_to_quat(poses[:, :3, :3])
        scale = _FRUSTUM * float((centers - centers.mean(0)).norm(dim=1).mean().clamp(min=1e-3))
        for view, (center, quat) in enumerate(zip(centers, quats, strict=True)):
            self.server.scene.add_camera_frustum(
                f"/cameras/{view}",
                fov=2 * math.atan(height / 2 / float(cameras.intrinsics[0, view, 1, 1])),
                aspect=width / height,
                scale=scale,
                wxyz=_array(quat),
                position=_array(center),
            )
        self.server.scene.set_up_direction(_array(-poses[0, :3, 1]))
        self.server.initial_camera.position = _array(centers[0])
        self.server.initial_camera.look_at = _array(centers[0] + poses[0, :3, 2])


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
