"""Projection of Gaussians onto the image: the closed form of their response along pixel rays, in torch.

A pixel's ray is ``t * ((px - cx) / fx, (py - cy) / fy, 1)``, so t is z-depth. With ``m = (x/z, y/z, 1)`` of the
camera-frame mean and ``L`` the inverse covariance, the exponent along every ray has its minimum ``D^2`` at ``t*`` with
curvature ``lambda``, and all three follow from the offset ``delta`` between pixel and projected mean::

    E = delta' Q delta      s = q . delta      r = (1 + s)^2 + eps E
    D^2 = E / r             t* = z (1 + s) / r             lambda = a0 r

with ``a0 = m' L m``, ``q = (L m)_xy / (f a0)``, ``eps = 1 / (z^2 a0)`` and ``Q = (J Sigma J' + lowpass I)^-1``.
Without low-pass this is the exact ray maximum of the paper's eqn gggs_color; the low-pass dilates the Gaussian inside
its tangent plane only, so depth profiles do not thicken. ``q = 0, eps = 0`` is the classic affine splat of 3DGS with
the mean's depth.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.rendering.constants import ALPHA_MIN, COMPENSATION_FLOOR, JACOBIAN_CLAMP
from vg2gt.rendering.options import RenderOptions
from vg2gt.rendering.scenes import SceneViews


@dataclass(frozen=True)
class Splats:
    """N Gaussians projected into one view.

    Attributes:
        center: ``[N, 2]`` projected mean in pixels.
        conic: ``[N, 3]`` Q as (xx, xy, yy) in px^-2.
        tilt: ``[N, 2]`` q in px^-1: relative change of the peak's depth with the pixel.
        curvature: ``[N]`` eps.
        depth: ``[N]`` z of the mean.
        precision: ``[N]`` a0, inverse variance in depth along the ray through the mean.
        opacity: ``[N]``, compensated for the low-pass if antialiased.
        normal: ``[N, 3]`` unit normal of the tangent plane at the mean, facing the camera.
        color: ``[N, 3]``.
    """

    center: Tensor
    conic: Tensor
    tilt: Tensor
    curvature: Tensor
    depth: Tensor
    precision: Tensor
    opacity: Tensor
    normal: Tensor
    color: Tensor

    @property
    def cutoff(self) -> Tensor:
        """``[N]`` D^2 where alpha is 1/255."""
        return 2 * torch.log(self.opacity / ALPHA_MIN)

    def __getitem__(self, index: Tensor) -> Splats:
        return Splats(*(getattr(self, field.name)[index] for field in fields(self)))


def project(scene: SceneViews, options: RenderOptions) -> Splats:
    """Projects all Gaussians of a one-view scene, visible or not; z is set to 1 where it is not beyond ``near``."""
    rotation, translation = scene.world_to_camera[0, :3, :3], scene.world_to_camera[0, :3, 3]
    focal = scene.intrinsics[0, [0, 1], [0, 1]]
    principal = scene.intrinsics[0, [0, 1], [2, 2]]
    mean = scene.means @ rotation.T + translation
    z = torch.where(mean[:, 2] > options.near, mean[:, 2], torch.ones_like(mean[:, 2]))
    tangent = mean[:, :2] / z[:, None]
    axes = rotation @ quat_to_matrix(scene.quats)
    scaled = axes * scene.scales[:, None, :]
    slope = tangent
    if options.mode == "rasterized":
        height, width = scene.size
        limit = JACOBIAN_CLAMP * 0.5 * torch.tensor([width, height], dtype=z.dtype, device=z.device) / focal.detach()
        slope = torch.minimum(torch.maximum(tangent, -limit), limit)
    # rows of J axes diag(scales), J the Jacobian of the projection at the mean
    rows = (scaled[:, :2] - slope[:, :, None] * scaled[:, 2:]) * (focal[:, None] / z[:, None, None])
    covariance = rows @ rows.transpose(1, 2)
    xx, xy, yy = covariance[:, 0, 0] + options.lowpass, covariance[:, 0, 1], covariance[:, 1, 1] + options.lowpass
    det = xx * yy - xy * xy
    conic = torch.stack((yy, -xy, xx), -1) / det[:, None]

    along = torch.cat((tangent, torch.ones_like(z[:, None])), -1)  # m
    whitened = (along[:, None, :] @ axes)[:, 0] / scene.scales
    precision = (whitened * whitened).sum(-1)
    plane = (axes @ (whitened / scene.scales)[:, :, None])[:, :, 0] / precision[:, None]  # L m / a0
    if options.mode == "solid":
        tilt, curvature = plane[:, :2] / focal, 1 / (z * z * precision)
    else:
        tilt, curvature = torch.zeros_like(tangent), torch.zeros_like(z)
    return Splats(
        center=tangent * focal + principal,
        conic=conic,
        tilt=tilt,
        curvature=curvature,
        depth=z,
        precision=precision,
        opacity=scene.opacities * _compensation(rows, options.lowpass) if options.antialiased else scene.opacities,
        normal=-F.normalize(plane, dim=-1, eps=0.0),
        color=scene.colors[0],
    )


def _compensation(rows: Tensor, lowpass: float) -> Tensor:
    """Returns ``sqrt(det S / det(S + lowpass I))`` ``[N]`` of the screen covariances ``S = rows rows'``.

    With it the low-pass leaves a splat's integral over the image as it is (Mip-Splatting, eqn 9). ``sqrt(det S)`` is
    the norm of the cross product of the rows: its gradient stays bounded where S is singular, at a surfel seen edge-on.
    """
    det = torch.linalg.cross(rows[:, 0], rows[:, 1]).square().sum(-1)
    blurred = det + lowpass * (rows.square().sum((1, 2)) + lowpass)
    return (det / blurred).clamp(min=COMPENSATION_FLOOR).sqrt()


def screen_box(splats: Splats) -> tuple[Tensor, Tensor]:
    """Returns the bounding box of the pixels with alpha >= 1/255, in closed form.

    Returns:
        Box ``[N, 4]`` as (x0, y0, x1, y1), ends included, and ``[N]`` bool: False where there is no such pixel or the
        Gaussian straddles the camera plane.
    """
    offset, half, bounded = half_box(splats.conic, splats.tilt, splats.curvature, splats.cutoff)
    middle = splats.center + offset
    return torch.cat((middle - half, middle + half), -1), bounded


def half_box(conic: Tensor, tilt: Tensor, curvature: Tensor, cutoff: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns offset from the centre and half sides of :func:`screen_box` ``[N, 2]``, and whether it is bounded."""
    q0, q1 = tilt.unbind(-1)
    k = 1 - cutoff * curvature
    xx = k * conic[:, 0] - cutoff * q0 * q0
    xy = k * conic[:, 1] - cutoff * q0 * q1
    yy = k * conic[:, 2] - cutoff * q1 * q1
    det = xx * yy - xy * xy
    bounded = (cutoff > 0) & (k > 0) & (xx > 0) & (det > 0)
    inv_xx, inv_xy, inv_yy = yy / det, -xy / det, xx / det
    offset = torch.stack((inv_xx * q0 + inv_xy * q1, inv_xy * q0 + inv_yy * q1), -1) * cutoff[:, None]
    radius2 = cutoff * (1 + (tilt * offset).sum(-1))
    return offset, (torch.stack((inv_xx, inv_yy), -1) * radius2[:, None]).clamp(min=0).sqrt(), bounded


def visible_splats(scene: SceneViews, options: RenderOptions) -> tuple[Splats, Tensor]:
    """Returns the splats in the image, front to back by the depth of their means, and which Gaussians they are.

    Selecting first keeps the undefined derivatives of hidden Gaussians out of the graph.
    """
    height, width = scene.size
    with torch.no_grad():
        splats = project(scene, options)
        pose = scene.world_to_camera[0]
        in_front = scene.means @ pose[2, :3] + pose[2, 3] > options.near
        box, bounded = screen_box(splats)
        inside = (box[:, 2] >= 0) & (box[:, 3] >= 0) & (box[:, 0] <= width - 1) & (box[:, 1] <= height - 1)
        index = torch.nonzero(in_front & bounded & inside)[:, 0]
        index = index[torch.argsort(splats.depth[index], stable=True)]
    return project(scene.gather(index), options), index


def respond(splats: Splats, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Closed-form response of splats at pixels (module docstring).

    Args:
        splats: N splats, or splats whose leading axis broadcasts against the pixels'.
        pixels: ``[..., 2]`` as (x, y).

    Returns:
        ``o exp(-D^2 / 2)`` before the alpha cap, the peak's depth ``t*`` and its precision ``lambda``; a response
        without a peak in front of the camera is 0.
    """
    dx, dy = (pixels - splats.center).unbind(-1)
    quadratic = splats.conic[..., 0] * dx * dx + 2 * splats.conic[..., 1] * dx * dy + splats.conic[..., 2] * dy * dy
    forward = 1 + splats.tilt[..., 0] * dx + splats.tilt[..., 1] * dy
    r = forward * forward + splats.curvature * quadratic
    response = splats.opacity * torch.exp(-0.5 * quadratic / r)
    response = torch.where(forward > 0, response, torch.zeros_like(response))
    return response, splats.depth * forward / r, splats.precision * r
