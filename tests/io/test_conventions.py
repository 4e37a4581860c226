"""The written PLY, read and rendered by an oracle of its own, gives our rasterised image."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.io.gaussian_scenes import scene, views
from tests.io.splat_oracle import render_ply
from vg2gt.io import write_gaussian_ply
from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians


def partly_opaque(degree: int) -> Gaussians:
    """Every third Gaussian is opaque, so that the alpha cap and the end of transmittance act."""
    gaussians = scene(80, degree)
    return replace(gaussians, opacities=torch.where(torch.arange(80) % 3 == 0, 1.0, gaussians.opacities))


def oracle(path: Path, cameras: Cameras, view: int, shift: float = 0.5, alpha_max: float = 0.999) -> np.ndarray:
    pose, intrinsics = (t[0, view].double().numpy().copy() for t in (cameras.world_to_camera, cameras.intrinsics))
    intrinsics[:2, 2] += shift
    return render_ply(path, pose, intrinsics, cameras.size, alpha_max)


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_oracle_renders_the_written_file_as_we_do(tmp_path: Path, degree: int) -> None:
    gaussians, cameras = partly_opaque(degree), views((24, 32))
    path = write_gaussian_ply(tmp_path / "scene.ply", gaussians)
    ours = render(gaussians, cameras, "rasterized", alpha_max=0.999).color[0].permute(0, 2, 3, 1)
    assert ours.mean() > 0.1
    for view in range(3):
        image, shifted = (oracle(path, cameras, view, shift) for shift in (0.5, 0.0))
        assert np.abs(image - ours[view].numpy()).max() < 1e-3
        assert np.abs(shifted - ours[view].numpy()).mean() > 5e-3  # half a pixel would not go unnoticed


def test_default_alpha_cap_is_that_of_3dgs_not_of_gsplat(tmp_path: Path) -> None:
    """Ours is 0.99 by default, 3DGS's; gsplat's is 0.999. An opaque Gaussian's peak is where it shows."""
    gaussians, cameras = partly_opaque(0), views((24, 32)).select(slice(1, 2))
    path = write_gaussian_ply(tmp_path / "scene.ply", gaussians)
    ours = render(gaussians, cameras, "rasterized").color[0, 0].permute(1, 2, 0).numpy()
    gsplat, original = (oracle(path, cameras, 0, alpha_max=cap) for cap in (0.999, 0.99))
    assert np.abs(original - ours).max() < 1e-3
    assert 1e-3 < np.abs(gsplat - ours).max() < 0.02
