"""Loss of a refinement: the rendered part of the training objective, with no ground truth but the images."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from vg2gt.geometry.normals import normals_from_depth
from vg2gt.losses.gaussian import normal_error, structure_loss, weighted_mean
from vg2gt.types import Cameras, Gaussians, Render, TensorRecord


@dataclass(frozen=True)
class Observations(TensorRecord):
    """Observations of V views of one scene.

    Attributes:
        images: ``[V, 3, H, W]`` in [0, 1].
        depth: ``[V, H, W]`` decoded z-depth in scene units, 0 = none.
        depth_conf: ``[V, H, W]`` its confidence, > 0.
        mask: ``[V, H, W]`` in [0, 1], pixel weights; None: all pixels count.
    """

    images: Tensor
    depth: Tensor
    depth_conf: Tensor
    mask: Tensor | None = None

    def views(self, views: Tensor) -> Observations:
        """Returns the observations of some views."""
        return self.map(lambda tensor: tensor[views])


@dataclass(frozen=True)
class RefineLoss:
    """Loss of rendered views and of the Gaussians themselves.

    Colour alone roughens surfaces: Gaussians in front of and behind a surface explain a pixel as well. The geometry
    terms hold Gaussians at the decoded depth and orient them along the surface that they form.

    Args:
        color_l1: weight of the L1 colour error.
        ssim: weight of ``1 - SSIM`` (11 x 11 window, sigma 1.5).
        depth_consistency: weight of the L1 distance to the decoded depth, in median depths of the scene.
        normal_render: weight of ``1 - cos`` between rendered normals and the normals of the rendered depth.
        normal_decoded: weight of ``1 - cos`` between rendered normals and the normals of the decoded depth.
        opacity: weight of the mean opacity, which makes Gaussians that no image needs transparent.
        scale: weight of the mean growth of each Gaussian's largest side, relative to its initial length.
        confidence_weighted: weight comparisons with the decoded depth by its confidence.
        min_alpha: minimum accumulated opacity of a pixel in the depth and normal terms.

    Raises:
        ValueError: if a weight is negative.
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
        """Whether any term uses rendered depth or normals."""
        return bool(self.depth_consistency or self.normal_render or self.normal_decoded)

    def of_views(self, rendered: Render, cameras: Cameras, seen: Observations, unit: float) -> dict[str, Tensor]:
        """Returns the unweighted terms of R rendered views whose weight is not 0, as scalars with autograd graph.

        Args:
            rendered: rendered views (B = 1).
            cameras: cameras they were rendered with (B = 1).
            seen: observations of the views.
            unit: median depth of the scene.
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
        """Returns the unweighted terms of the Gaussians whose weight is not 0; ``size [G]``: initial largest sides."""
        terms: dict[str, Tensor] = {}
        if self.opacity:
            terms["opacity"] = gaussians.opacities.mean()
        if self.scale:
            terms["scale"] = (gaussians.scales.max(-1).values / size - 1).clamp(min=0).mean()
        return terms

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """Returns the weighted sum of the terms."""
        return torch.stack([getattr(self, name) * value for name, value in terms.items()]).sum()
