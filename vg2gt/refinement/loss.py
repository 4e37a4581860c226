"""What refinement lowers: the rendered part of the training objective, without any truth but the images."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from vg2gt.geometry.normals import normals_from_depth
from vg2gt.losses.gaussian import normal_error, weighted_mean
from vg2gt.losses.structure import structure_loss
from vg2gt.types import Cameras, Gaussians, Render, TensorRecord


@dataclass(frozen=True)
class Observations(TensorRecord):
    """What V views of one scene are known to show.

    Attributes:
        images: ``[V, 3, H, W]`` in [0, 1].
        depth: ``[V, H, W]`` decoded z-depth in scene units, 0 = none.
        depth_conf: ``[V, H, W]`` its confidence > 0.
        mask: ``[V, H, W]`` in [0, 1], how much each pixel counts; None: all count.
    """

    images: Tensor
    depth: Tensor
    depth_conf: Tensor
    mask: Tensor | None = None

    def views(self, views: Tensor) -> Observations:
        """Returns those of some views."""
        return self.map(lambda tensor: tensor[views])


@dataclass(frozen=True)
class RefineLoss:
    """Loss of rendered views and of the Gaussians themselves.

    Colour alone roughens surfaces: what a pixel shows can be explained by Gaussians in front of and behind it. The
    geometry terms hold them where the decoded depth says, and turn them along the surface that they form together.

    Args:
        color_l1: weight of the L1 colour error.
        ssim: weight of ``1 - SSIM`` (11 x 11 window, sigma 1.5).
        depth_consistency: weight of the L1 distance to the decoded depth, in median depths of the scene.
        normal_render: weight of ``1 - cos`` between rendered normals and the normals of the rendered depth.
        normal_decoded: weight of ``1 - cos`` between rendered normals and the normals of the decoded depth.
        opacity: weight of the mean opacity; what no image needs becomes transparent.
        scale: weight of the mean growth of a Gaussian's largest side, in sides it started with.
        confidence_weighted: weight pixels compared with the decoded depth by its confidence.
        min_alpha: smallest accumulated opacity of a pixel that counts in depth and normal terms.

    Raises:
        ValueError: naming a weight that is negative.
    """

    color_l1: float = 1.0
    ssim: float = 0.2
    depth_consistency: float = 2.0
    normal_render: float = 0.1
    normal_decoded: float = 0.1
    opacity: float = 0.0
    scale: float = 0.0
    confidence_weighted: bool = True
    min_alpha: float = 0.5

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not value >= 0:
                raise ValueError(f"refine.loss.{name} must be at least 0, got {value}")

    @property
    def needs_geometry(self) -> bool:
        """Whether rendered depth or normals are compared with anything."""
        return bool(self.depth_consistency or self.normal_render or self.normal_decoded)

    def of_views(self, rendered: Render, cameras: Cameras, seen: Observations, unit: float) -> dict[str, Tensor]:
        """Unweighted terms of R rendered views that have a weight; scalars with graph.

        Args:
            rendered: the views (B = 1).
            cameras: the cameras they were rendered with (B = 1).
            seen: what they should show.
            unit: the scene's median depth.
        """
        color, depth, normal = rendered.color[0], rendered.depth[0], rendered.normal[0]
        terms: dict[str, Tensor] = {}
        if self.color_l1:
            terms["color_l1"] = (color - seen.images).abs().mean()
        if self.ssim:
            terms["ssim"] = structure_loss(color, seen.images)
        if not self.needs_geometry:
            return terms
        hits = (depth > 0) & (rendered.alpha[0] > self.min_alpha)
        trust = seen.depth_conf if self.confidence_weighted else torch.ones_like(seen.depth_conf)
        if self.depth_consistency:
            error = (torch.where(hits, depth, 0.0) - seen.depth).abs() / unit
            terms["depth_consistency"] = weighted_mean(error, trust, hits & (seen.depth > 0))
        if self.normal_render:
            expected, valid = normals_from_depth(torch.where(hits, depth, 0.0), cameras.intrinsics[0])
            terms["normal_render"] = normal_error(normal, expected, torch.ones_like(trust), hits & valid)
        if self.normal_decoded:
            expected, valid = normals_from_depth(seen.depth, cameras.intrinsics[0])
            terms["normal_decoded"] = normal_error(normal, expected, trust, hits & valid)
        return terms

    def of_gaussians(self, gaussians: Gaussians, size: Tensor) -> dict[str, Tensor]:
        """Unweighted terms of the Gaussians that have a weight; ``size [G]`` is the largest side each started with."""
        terms: dict[str, Tensor] = {}
        if self.opacity:
            terms["opacity"] = gaussians.opacities.mean()
        if self.scale:
            terms["scale"] = (gaussians.scales.max(-1).values / size - 1).clamp(min=0).mean()
        return terms

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """The weighted sum of the terms."""
        return torch.stack([getattr(self, name) * value for name, value in terms.items()]).sum()
