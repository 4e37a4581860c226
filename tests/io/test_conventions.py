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


def oracle(path: Path, cameras: Cameras, view: int, shift: float, cap: float | None) -> np.ndarray:
    pose, intrinsics = (t[0, view].double().numpy().copy() for t in (cameras.world_to_camera, cameras.intrinsics))
    intrinsics[:2, 2] += shift
    return render_ply(path, pose, intrinsics, cameras.size, cap or 0.99)


@pytest.mark.parametrize(("degree", "cap"), [(0, None), (2, 0.999), (3, 0.999)])
def test_oracle_renders_the_written_file_as_we_do(tmp_path: Path, degree: int, cap: float | None) -> None:
    """With the alpha cap of gsplat or, by default, that of 3DGS, which are told apart."""
    gaussians, cameras = partly_opaque(degree), views((24, 32))
    path = write_gaussian_ply(tmp_path / "scene.ply", gaussians)
    options = {} if cap is None else {"alpha_max": cap}
    ours = render(gaussians, cameras, "rasterized", **options).color[0].permute(0, 2, 3, 1)
    assert ours.mean() > 0.1
    for view in range(3):
        image, shifted, other = (
            oracle(path, cameras, view, *arguments) for arguments in ((0.5, cap), (0.0, cap), (0.5, 0.9945))
        )
        assert np.abs(image - ours[view].numpy()).max() < 1e-3
        assert np.abs(shifted - ours[view].numpy()).mean() > 5e-3  # half a pixel would not go unnoticed
        assert np.abs(other - ours[view].numpy()).max() > 1e-3
