"""One scene with its views, the input of a rasteriser, and rendering of several scenes with one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.geometry.cameras import invert_rigid
from vg2gt.geometry.spherical_harmonics import sh_to_rgb
from vg2gt.kernels.threads import compilable
from vg2gt.rendering.cpu.colors import ViewColors
from vg2gt.rendering.options import RenderOptions
from vg2gt.types import Cameras, Footprints, Gaussians, Render

Images = tuple[Tensor, Tensor, Tensor, Tensor]
"""Colour (background blended in) and normals ``[V, H, W, 3]``, depth (0: none) and alpha ``[V, H, W]``."""


@dataclass(frozen=True)
class SceneViews:
    """One scene and V views of it, the argument of every rasteriser.

    Attributes:
        means: ``[G, 3]`` world positions.
        quats: ``[G, 4]`` wxyz, any norm.
        scales: ``[G, 3]`` standard deviations.
        opacities: ``[G]``.
        colors: ``[V, G, 3]``, or ``[1, G, 3]`` where the colour does not depend on the view.
        world_to_camera: ``[V, 4, 4]``.
        intrinsics: ``[V, 3, 3]`` pixels, integer pixel centres, no skew.
        background: ``[3]``.
        size: image ``(height, width)``.
        footprints: of these Gaussians in these views, to be filled; None: not asked for.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    background: Tensor
    size: tuple[int, int]
    footprints: Footprints | None = None

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The differentiable inputs in declaration order, without footprints."""
        return tuple(getattr(self, field.name) for field in fields(self)[:8])

    def view(self, index: int) -> SceneViews:
        """Returns the scene with one view (V = 1)."""
        one = slice(index, index + 1)
        colors = self.colors if self.colors.shape[0] == 1 else self.colors[one]
        poses, intrinsics, footprints = (
            self.world_to_camera[one],
            self.intrinsics[one],
            self.footprints and self.footprints.select(one),
        )
        return replace(self, colors=colors, world_to_camera=poses, intrinsics=intrinsics, footprints=footprints)

    def gather(self, index: Tensor) -> SceneViews:
        """Returns the Gaussians of the given indices, in that order."""
        some = {name: getattr(self, name)[index] for name in ("means", "quats", "scales", "opacities")}
        return replace(self, **some, colors=self.colors[:, index])


Rasterizer = Callable[[SceneViews, RenderOptions], Images]


def render_scenes(
    rasterize: Rasterizer,
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor,
    options: RenderOptions,
    footprints: Footprints | None = None,
) -> Render:
    """Renders B scenes into V views each; ``background`` is ``[B, 3]``. Fills the footprints, if there are any."""
    images, first = [], 0
    for b, behind in enumerate(background):
        views = _scene_views(gaussians.scene(b), cameras, b, behind)
        last = first + len(views.means)
        own = footprints and footprints.select(gaussians=slice(first, last))
        images.append(rasterize(replace(views, footprints=own), options))
        first = last
    color, normal, depth, alpha = (torch.stack(parts) for parts in zip(*images, strict=True))
    return Render(color.permute(0, 1, 4, 2, 3), depth, normal.permute(0, 1, 4, 2, 3), alpha)


def _scene_views(gaussians: Gaussians, cameras: Cameras, scene: int, background: Tensor) -> SceneViews:
    """Returns one scene with its colours in every view (a single copy if they do not depend on the view)."""
    poses = cameras.world_to_camera[scene]
    return SceneViews(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        view_colors(gaussians.sh, gaussians.means, poses),
        poses,
        cameras.intrinsics[scene],
        background,
        cameras.size,
    )


def view_colors(sh: Tensor, means: Tensor, poses: Tensor) -> Tensor:
    """Returns the colours of Gaussians in every view; compiled for float32 on a CPU.

    Args:
        sh: ``[G, (L + 1)^2, 3]``.
        means: ``[G, 3]`` world positions.
        poses: ``[V, 4, 4]`` world to camera.

    Returns:
        ``[V, G, 3]``, clamped to at least 0; ``[1, G, 3]`` if the colours do not depend on the view (L = 0).
    """
    if sh.shape[1] == 1:
        return sh_to_rgb(sh, means[None])  # the directions are not used
    centers = invert_rigid(poses)[:, :3, 3]
    if compilable(sh, means, centers):
        return ViewColors.apply(sh, means, centers)  # pyright: ignore[reportReturnType]
    return view_colors_reference(sh, means, centers)


def view_colors_reference(sh: Tensor, means: Tensor, centers: Tensor) -> Tensor:
    """:func:`view_colors` in plain torch, from the centres ``[V, 3]`` of the cameras."""
    return sh_to_rgb(sh, F.normalize(means - centers[:, None], dim=-1))
