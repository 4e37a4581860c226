"""The written PLY, read and rendered by an oracle of its own, gives our rasterised image.

The oracle follows the published conventions of 3DGS and gsplat, in float64. Pixel centres at half integers; footprint
covariance J W S W' J' + 0.3 I with x/z and y/z clamped to 1.3 half fields of view in J; alpha = min(cap,
o exp(-d' Q d / 2)), below 1/255 it is no hit; front to back by z, ending before the hit that would bring transmittance
to 1e-4; colour max(0, SH + 1/2). Tile culling is left out: it only skips what is no hit.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.io.gaussian_scenes import scene, views
from vg2gt.geometry.spherical_harmonics import basis
from vg2gt.io import write_gaussian_ply
from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a binary file of floats."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    names = re.findall(rb"property float (\w+)", head)
    values = np.frombuffer(body, "<f4").reshape(-1, len(names)).astype(np.float64)
    return {name.decode(): values[:, i] for i, name in enumerate(names)}


def render_ply(
    path: Path, world_to_camera: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], alpha_max: float
) -> np.ndarray:
    """Image ``[H, W, 3]`` on black; ``intrinsics`` with pixel centres at half integers."""
    table = read_table(path)

    def stack(*names: str) -> np.ndarray:
        return np.stack([table[name] for name in names], -1)

    means, opacity = stack("x", "y", "z"), 1 / (1 + np.exp(-table["opacity"]))
    axes = Rotation.from_quat(stack("rot_1", "rot_2", "rot_3", "rot_0")).as_matrix()  # scalar last
    sigma = np.exp(stack("scale_0", "scale_1", "scale_2"))
    rest = sum(name.startswith("f_rest_") for name in table) // 3
    channels = [stack(f"f_dc_{c}", *(f"f_rest_{c * rest + k}" for k in range(rest))) for c in range(3)]
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    direction = means + rotation.T @ translation
    unit = torch.from_numpy(direction / np.linalg.norm(direction, axis=-1, keepdims=True))
    color = np.stack([(basis(unit, 3).numpy()[:, : rest + 1] * channel).sum(-1) for channel in channels], -1)
    color = np.maximum(color + 0.5, 0)
    camera = means @ rotation.T + translation
    order = np.argsort(camera[:, 2], kind="stable")
    order = order[camera[order, 2] > 0.01]
    camera, axes, sigma, opacity, color = (v[order] for v in (camera, axes, sigma, opacity, color))
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    height, width = size
    z = camera[:, 2]
    u = np.clip(camera[:, 0] / z, -0.65 * width / fx, 0.65 * width / fx)
    v = np.clip(camera[:, 1] / z, -0.65 * height / fy, 0.65 * height / fy)
    zero = np.zeros_like(z)
    jacobian = np.stack([np.stack([fx / z, zero, -fx * u / z], -1), np.stack([zero, fy / z, -fy * v / z], -1)], 1)
    half = jacobian @ rotation @ (axes * sigma[:, None, :])
    conic = np.linalg.inv(half @ half.swapaxes(1, 2) + 0.3 * np.eye(2))
    center = np.stack([camera[:, 0] / z * fx + cx, camera[:, 1] / z * fy + cy], -1)
    image = np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            d = np.array([column + 0.5, row + 0.5]) - center
            alpha = opacity * np.exp(-0.5 * np.einsum("ni,nij,nj->n", d, conic, d))
            alpha = np.where(alpha < 1 / 255, 0, np.minimum(alpha, alpha_max))
            after = np.cumprod(1 - alpha)
            before = np.concatenate(([1.0], after[:-1]))
            image[row, column] = (np.where(after > 1e-4, alpha * before, 0)[:, None] * color).sum(0)
    return image


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
        image, shifted = (oracle(path, cameras, view, shift, cap) for shift in (0.5, 0.0))
        assert np.abs(image - ours[view].numpy()).max() < 1e-3
        assert np.abs(shifted - ours[view].numpy()).mean() > 5e-3  # half a pixel would not go unnoticed
    if cap is None:
        assert np.abs(oracle(path, cameras, 1, 0.5, 0.999) - ours[1].numpy()).max() > 1e-3
