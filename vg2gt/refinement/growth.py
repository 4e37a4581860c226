"""Growth of a scene where its views show more detail than its Gaussians can."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from vg2gt.geometry.spherical_harmonics import DC
from vg2gt.kernels.culling import rows_in_front
from vg2gt.kernels.threads import compilable
from vg2gt.refinement.parameters import Parameters
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians

MARGIN = 0.1  # of the image around it, within which a view counts as seeing a Gaussian
REACH = 3.33  # standard deviations up to which a Gaussian is visible: exp(-REACH^2 / 2) = 1 / 255
_LOWPASS = 2.0  # pixels, more than the low-pass filter adds to this reach
_SHRINK, _OFFSET = 0.62, 0.55  # of halves: their sum has nearly the shape of the whole, and overlaps by half
UNSEEN = 1e-6  # contribution up to which a view does not show a Gaussian
_SURVEY = 280  # longer side in pixels of the renderings that measure contributions


def footprints(means: Tensor, cameras: Cameras, near: float) -> Tensor:
    """Returns ``[G]`` how many pixels one scene unit at each position covers in the view that sees it best; 0: none.

    Args:
        means: ``[G, 3]`` positions.
        cameras: cameras of V views (B = 1).
        near: near plane in scene units.
    """
    found = torch.zeros_like(means[:, 0])
    for view in range(cameras.world_to_camera.shape[1]):
        pixels, depth = _projected(means, cameras, view, near)
        focal = cameras.intrinsics[0, view, [0, 1], [0, 1]].mean()
        size = pixels.new_tensor(cameras.size[::-1])
        inside = ((pixels > -MARGIN * size) & (pixels < (1 + MARGIN) * size)).all(-1) & (depth > near)
        found = torch.maximum(found, torch.where(inside, focal / depth.clamp(min=near), 0.0))
    return found


def in_front(scales: Tensor, means: Tensor, camera: Cameras, near: float) -> Tensor:
    """Returns the index ``[N]`` of the Gaussians that may be visible in one view.

    Args:
        scales: ``[G, 3]`` logarithm of the standard deviations.
        means: ``[G, 3]`` positions.
        camera: camera of the view (B = V = 1), such as one whose principal point is moved to a crop.
        near: near plane in scene units.
    """
    if compilable(scales, means, camera.intrinsics):
        height, width = camera.size
        limits = (float(width), float(height), near, REACH, _LOWPASS)
        return rows_in_front(scales, means, camera.world_to_camera[0, 0], camera.intrinsics[0, 0], limits)
    return in_front_reference(scales, means, camera, near)


def in_front_reference(scales: Tensor, means: Tensor, camera: Cameras, near: float) -> Tensor:
    """:func:`in_front` in plain torch."""
    sizes = scales.max(-1).values.exp()
    pixels, depth = _projected(means, camera, 0, near)
    slant = ((pixels - camera.intrinsics[0, 0, :2, 2]) / camera.intrinsics[0, 0, [0, 1], [0, 1]]).square().sum(-1)
    focal = camera.intrinsics[0, 0, [0, 1], [0, 1]].max()
    radius = (REACH * focal * sizes / depth.clamp(min=near) * (1 + slant).sqrt() + _LOWPASS)[:, None]
    size = pixels.new_tensor(camera.size[::-1])
    seen = ((pixels > -radius) & (pixels < size + radius)).all(-1) & (depth > near)
    return seen.nonzero()[:, 0]


def contributions(gaussians: Gaussians, cameras: Cameras, renderer: Renderer) -> Tensor:
    """Returns ``[G]`` each Gaussian's blending weight, summed over a view's pixels, in the view where it is largest.

    The weight is the derivative of the rendered colour with respect to the Gaussian's colour. Views are rendered with a
    longer side of 280 pixels, so one unit is a pixel of such a view.

    Args:
        gaussians: the scene (B = 1).
        cameras: cameras of V views (B = 1).
        renderer: renderer of the scene.
    """
    factor = min(1.0, _SURVEY / max(cameras.size))
    height, width = (max(1, round(side * factor)) for side in cameras.size)
    scale = cameras.intrinsics.new_tensor([width / cameras.size[1], height / cameras.size[0], 1])
    small = replace(cameras, intrinsics=cameras.intrinsics * scale[:, None], size=(height, width))
    plain, largest = replace(renderer, geometry=False), torch.zeros_like(gaussians.opacities)
    for view in range(cameras.world_to_camera.shape[1]):
        constant = torch.zeros_like(gaussians.sh[:, :1]).requires_grad_(True)  # grey: no colour is clamped at 0
        with torch.enable_grad():
            shown = plain(replace(gaussians.detach(), sh=constant), small.select(slice(view, view + 1)))
            shown.color[:, :, 0].sum().backward()
        assert constant.grad is not None
        largest = torch.maximum(largest, constant.grad[:, 0, 0] / DC)
    return largest


@torch.no_grad()
def note_seen(parameters: Parameters, views: Tensor, renderer: Renderer) -> None:
    """Sets ``parameters.seen``: what no trained view shows is spared the penalty on opacity.

    Args:
        parameters: the scene, which is changed.
        views: ``[N]`` the views that are trained.
        renderer: its renderer.
    """
    parameters.seen = torch.ones_like(parameters.seen)
    scene = parameters.present()
    if len(views) < scene.cameras.world_to_camera.shape[1]:
        cameras = scene.cameras.select(views.to(parameters.seen.device))
        parameters.seen *= contributions(scene.gaussians, cameras, renderer) > UNSEEN


@torch.no_grad()
def remove_idle(parameters: Parameters, cameras: Cameras, renderer: Renderer, least: float) -> None:
    """Removes Gaussians that views see but that hardly contribute to any.

    What no view sees stays: held-out views may see it.

    Args:
        parameters: the scene, which is changed.
        cameras: cameras of views (B = 1).
        renderer: its renderer.
        least: smallest contribution (:func:`contributions`).
    """
    weights = contributions(parameters.scene().gaussians, cameras, renderer)
    keep = (weights >= least) | (weights <= UNSEEN)
    if keep.any():
        parameters.keep(keep)


@torch.no_grad()
def split_large(parameters: Parameters, cameras: Cameras, near: float, pixels: float, most: int) -> int:
    """Splits the Gaussians that are larger than their views' pixels ask for, the largest first.

    Args:
        parameters: the scene, which is changed.
        cameras: cameras of views at full size (B = 1).
        near: near plane in scene units.
        pixels: largest standard deviation in pixels that is not split.
        most: maximum number of Gaussians.

    Returns:
        How many were split.
    """
    largest = parameters.values["scales"].max(-1).values.exp()
    size = largest * footprints(parameters.values["means"], cameras, near)
    room = max(0, min(most - len(parameters), int((size > pixels).sum())))
    if room:
        parameters.split(size.topk(room).indices.sort().values, _SHRINK, _OFFSET)
    return room


def _projected(means: Tensor, cameras: Cameras, view: int, near: float) -> tuple[Tensor, Tensor]:
    """Returns pixels ``[G, 2]`` and depth ``[G]`` of positions in one view; pixels are arbitrary before ``near``."""
    pose, intrinsics = cameras.world_to_camera[0, view], cameras.intrinsics[0, view]
    local = means @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    tangent = local[:, :2] / depth.clamp(min=near)[:, None]
    return tangent * intrinsics[[0, 1], [0, 1]] + intrinsics[:2, 2], depth
