"""The closed forms against the quadratic form they stand for."""

import torch

from tests.rendering.scenes import cameras_around, pinhole, soup
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.rendering.constants import ALPHA_MIN
from vg2gt.rendering.options import RenderOptions
from vg2gt.rendering.projection import Splats, project, respond, screen_box
from vg2gt.rendering.scenes import SceneViews
from vg2gt.types import Cameras, Gaussians

EXACT = RenderOptions(lowpass=0.0)


def scene_views(gaussians: Gaussians, cameras: Cameras) -> SceneViews:
    colors = gaussians.sh[None, :, 0]
    parameters = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors)
    poses, intrinsics = cameras.world_to_camera[0], cameras.intrinsics[0]
    return SceneViews(*parameters, poses, intrinsics, torch.zeros(3, dtype=torch.float64), cameras.size)


def camera_frame(gaussians: Gaussians, cameras: Cameras) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and inverse covariances in the frame of the first view."""
    pose = cameras.world_to_camera[0, 0]
    axes = pose[:3, :3] @ quat_to_matrix(gaussians.quats)
    inverse = axes @ torch.diag_embed(gaussians.scales**-2) @ axes.transpose(1, 2)
    return gaussians.means @ pose[:3, :3].T + pose[:3, 3], inverse


def test_response_is_the_exact_maximum_along_every_ray() -> None:
    gaussians, cameras = soup(40), cameras_around((48, 64), views=1)
    splats = project(scene_views(gaussians, cameras), EXACT)
    mean, inverse = camera_frame(gaussians, cameras)
    pixels = torch.rand(500, 1, 2, dtype=torch.float64) * torch.tensor([64.0, 48.0])
    k = cameras.intrinsics[0, 0]
    rays = torch.cat(((pixels - k[[0, 1], [2, 2]]) / k[[0, 1], [0, 1]], torch.ones_like(pixels[..., :1])), -1)
    a = torch.einsum("pxi,gij,pxj->pg", rays, inverse, rays)
    b = torch.einsum("pxi,gij,gj->pg", rays, inverse, mean)
    c = torch.einsum("gi,gij,gj->g", mean, inverse, mean)
    response, peak, precision = respond(splats, pixels)
    torch.testing.assert_close(peak, b / a, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(precision, a, rtol=1e-11, atol=0)
    expected = torch.where(b > 0, gaussians.opacities * torch.exp(-0.5 * (c - b * b / a)), 0.0)
    torch.testing.assert_close(response, expected, rtol=0, atol=1e-10)


def test_normal_is_the_tangent_planes_and_faces_the_camera() -> None:
    gaussians, cameras = soup(40), cameras_around((48, 64), views=1)
    splats = project(scene_views(gaussians, cameras), EXACT)
    mean, inverse = camera_frame(gaussians, cameras)
    toward = torch.einsum("gij,gj->gi", inverse, mean)
    torch.testing.assert_close(splats.normal, -toward / toward.norm(dim=-1, keepdim=True), rtol=0, atol=1e-14)
    assert ((splats.normal * mean).sum(-1) < 0).all()


def test_rasterized_is_the_affine_splat_with_clamped_jacobian() -> None:
    gaussians, cameras = soup(40, size=0.02), pinhole((24, 32))
    gaussians.means[0] = torch.tensor([50.0, 0.0, 2.0])  # far outside, where the clamp acts
    splats = project(scene_views(gaussians, cameras), RenderOptions(mode="rasterized"))
    mean, inverse = camera_frame(gaussians, cameras)
    x, y, z = mean.unbind(-1)
    x_limit, y_limit = 1.3 * 16 / 30 * z, 1.3 * 12 / 28 * z
    x, y = torch.minimum(torch.maximum(x, -x_limit), x_limit), torch.minimum(torch.maximum(y, -y_limit), y_limit)
    zero = torch.zeros_like(x)
    jacobian = torch.stack((30 / z, zero, -30 * x / z**2, zero, 28 / z, -28 * y / z**2), -1).view(-1, 2, 3)
    covariance = jacobian @ torch.linalg.inv(inverse) @ jacobian.transpose(1, 2) + 0.3 * torch.eye(2).double()
    conic = torch.linalg.inv(covariance)
    torch.testing.assert_close(splats.conic, torch.stack((conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1]), -1))
    assert not splats.tilt.any()
    assert not splats.curvature.any()


def test_screen_box_is_exact() -> None:
    gaussians, cameras = soup(30, seed=1), pinhole((40, 60))
    splats = project(scene_views(gaussians, cameras), RenderOptions())
    box, bounded = screen_box(splats)
    assert bounded.sum() > 20
    step = 0.25
    x, y = torch.meshgrid(torch.arange(-60, 120, step), torch.arange(-60, 100, step), indexing="xy")
    grid = torch.stack((x, y), -1).double()
    checked = 0
    for index in torch.nonzero(bounded)[:, 0]:
        low, high = box[index, :2], box[index, 2:]
        if low.min() < -55 or high[0] > 115 or high[1] > 95:
            continue
        single: Splats = splats[index[None]]
        inside = grid[respond(single, grid)[0] >= ALPHA_MIN]
        assert (inside >= low - 1e-9).all()
        assert (inside <= high + 1e-9).all()
        assert (inside.amin(0) - low).max() < 3 * step  # the ellipse's tip lies between grid lines
        assert (high - inside.amax(0)).max() < 3 * step
        checked += 1
    assert checked > 10


def test_gaussian_reaching_the_camera_plane_has_no_box() -> None:
    gaussians, cameras = soup(1), pinhole((8, 8))
    gaussians.means[0] = torch.tensor([0.0, 0.0, 1.0])
    gaussians.scales[0] = 0.5
    _, bounded = screen_box(project(scene_views(gaussians, cameras), EXACT))
    assert not bounded.any()
