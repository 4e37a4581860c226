"""Renders several scenes with a rasteriser for a single scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.spherical_harmonics import sh_to_rgb
from vg2gt.rendering.options import Images, RenderOptions, SceneViews
from vg2gt.types import Cameras, Gaussians, Render

Rasterizer = Callable[[SceneViews, RenderOptions], Images]


def render_scenes(
    rasterize: Rasterizer, gaussians: Gaussians, cameras: Cameras, background: Tensor, options: RenderOptions
) -> Render:
    """Renders B scenes into V views each; ``background`` is ``[B, 3]``."""
    scenes = range(len(background))
    images = [rasterize(_scene_views(gaussians.scene(b), cameras, b, background[b]), options) for b in scenes]
    stacked = {field.name: torch.stack([getattr(image, field.name) for image in images]) for field in fields(Images)}
    return Render(
        color=stacked["color"].permute(0, 1, 4, 2, 3),  # [B, V, 3, H, W]
        depth=stacked["depth"],
        normal=stacked["normal"].permute(0, 1, 4, 2, 3),  # [B, V, 3, H, W]
        alpha=stacked["alpha"],
    )


def _scene_views(gaussians: Gaussians, cameras: Cameras, scene: int, background: Tensor) -> SceneViews:
    """Returns one scene with its colours in every view (a single copy if they do not depend on the view)."""
    poses = cameras.world_to_camera[scene]
    if gaussians.sh.shape[1] == 1:
        directions = gaussians.means[None]  # not used: the colour is constant
    else:
        centers = invert_rigid(poses)[:, None, :3, 3]
        directions = F.normalize(gaussians.means - centers, dim=-1)
    return SceneViews(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        sh_to_rgb(gaussians.sh, directions),
        poses,
        cameras.intrinsics[scene],
        background,
        cameras.size,
    )
