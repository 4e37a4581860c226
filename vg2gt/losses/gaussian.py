"""Losses on rendered views: colour, structure, depth and normals (paper, eqn gsloss)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.filters import filter2d_separable, get_gaussian_kernel1d
from torch import Tensor

from vg2gt.geometry.normals import normals_from_depth
from vg2gt.kernels.structure import HALF, SIGMA, WINDOW, Structure
from vg2gt.kernels.threads import compilable
from vg2gt.types import Cameras, Render, TensorRecord, check_choice


@dataclass(frozen=True)
class RenderTargets(TensorRecord):
    """Targets of R rendered views of one scene, or of B scenes with a leading axis B.

    Attributes:
        images: ``[R, 3, H, W]`` in [0, 1].
        depth: ``[R, H, W]`` true depth in the losses' unit.
        valid: ``[R, H, W]`` bool, where the true depth is used.
        intrinsics: ``[R, 3, 3]`` true intrinsics.
        decoded: ``[R, H, W]`` decoded depth in the losses' unit.
        decoded_conf: ``[R, H, W]`` its confidence.
        decoded_valid: ``[R, H, W]`` bool, False for views without decoded depth (held-out ones).
        comparable: ``[1, 1, 1]`` bool, whether decoded and rendered depth have the same unit.
        mask: ``[R, H, W]`` in [0, 1], weight of each pixel's colour; None: all 1.
    """

    images: Tensor
    depth: Tensor
    valid: Tensor
    intrinsics: Tensor
    decoded: Tensor
    decoded_conf: Tensor
    decoded_valid: Tensor
    comparable: Tensor
    mask: Tensor | None = None


@dataclass(frozen=True)
class GaussianLoss:
    """Losses of the rendered views of one scene.

    Depth terms use pixels with rendered depth and enough opacity. Decoded depth and confidence are detached; otherwise
    the coarse enhancement would reduce its own confidence to escape the loss.

    Args:
        weight: weight of the whole group.
        color_l1: weight of the L1 colour error.
        ssim: weight of ``1 - SSIM`` (11 x 11 window, sigma 1.5).
        depth_consistency: weight of the L1 distance to the decoded depth.
        depth_gt: weight of the L1 distance to the true depth.
        normal: weight of ``1 - cos`` between rendered normals and normals of a depth map, in the camera frame.
        normal_target: depth map from which the target normals are computed: ``render``, ``decoded`` or ``gt``.
        confidence_weighted: whether to weight comparisons with the decoded depth by its confidence.
        min_alpha: accumulated opacity above which a pixel counts in depth and normal terms.

    Raises:
        ValueError: if ``normal_target`` is not one of these.
    """

    weight: float = 1.0
    color_l1: float = 1.0
    ssim: float = 1.0
    depth_consistency: float = 1.0
    depth_gt: float = 1.0
    normal: float = 1.0
    normal_target: str = "decoded"
    confidence_weighted: bool = True
    min_alpha: float = 0.5

    def __post_init__(self) -> None:
        check_choice("loss.gaussian.normal_target", self.normal_target, ("render", "decoded", "gt"))

    def hits(self, rendered: Render) -> Tensor:
        """Returns ``[B, R, H, W]`` bool: which pixels show a surface."""
        return (rendered.depth > 0) & (rendered.alpha > self.min_alpha)

    def __call__(self, rendered: Render, cameras: Cameras, targets: RenderTargets, scale: Tensor) -> dict[str, Tensor]:
        """Returns the unweighted terms of one scene: scalars with gradient, named like the weights.

        Args:
            rendered: R views of the scene (B = 1), depth in scene units.
            cameras: cameras of the renders (B = 1).
            targets: targets of the same views.
            scale: scalar factor from scene units to the losses' unit, without gradient.
        """
        color, hits = where_it_counts(rendered.color[0], targets.images, targets.mask), self.hits(rendered)[0]
        depth = torch.where(hits, rendered.depth[0], 1.0)
        scaled = depth * scale
        decoded, trust = targets.decoded.detach(), targets.decoded_conf.detach()
        trust = trust if self.confidence_weighted else torch.ones_like(trust)
        near_decoded = hits & targets.decoded_valid & targets.comparable
        return {
            "color_l1": (color - targets.images).abs().mean(),
            "ssim": structure_loss(color, targets.images),
            "depth_consistency": weighted_mean((scaled - decoded).abs(), trust, near_decoded),
            "depth_gt": weighted_mean((scaled - targets.depth).abs(), torch.ones_like(scaled), hits & targets.valid),
            "normal": self._normal(rendered, cameras, targets, hits, trust),
        }

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """Returns the weighted sum of the terms."""
        return self.weight * torch.stack([getattr(self, name) * value for name, value in terms.items()]).sum()

    def _normal(
        self, rendered: Render, cameras: Cameras, targets: RenderTargets, hits: Tensor, trust: Tensor
    ) -> Tensor:
        weights, intrinsics = torch.ones_like(trust), cameras.intrinsics[0]
        if self.normal_target == "render":
            depth = torch.where(hits, rendered.depth[0], 0.0)
        elif self.normal_target == "decoded":
            depth, weights = torch.where(targets.decoded_valid, targets.decoded.detach(), 0.0), trust
        else:
            depth, intrinsics = torch.where(targets.valid, targets.depth, 0.0), targets.intrinsics
        expected, valid = normals_from_depth(depth, intrinsics)
        return normal_error(rendered.normal[0], expected, weights, hits & valid)


def where_it_counts(color: Tensor, images: Tensor, mask: Tensor | None) -> Tensor:
    """Replaces rendered colours ``[R, 3, H, W]`` by those of the images, in proportion to ``1 - mask [R, H, W]``."""
    return color if mask is None else torch.lerp(images, color, mask[:, None].to(color.dtype))


def normal_error(normals: Tensor, expected: Tensor, weights: Tensor, mask: Tensor) -> Tensor:
    """Returns the masked, weighted mean of ``1 - cos`` between normals ``[R, 3, H, W]`` of any length and unit ones."""
    length = (normals.square().sum(1) + 1e-12).sqrt()
    cosine = (normals * expected).sum(1) / length
    return weighted_mean(1 - cosine, weights, mask)


def weighted_mean(values: Tensor, weights: Tensor, mask: Tensor) -> Tensor:
    """Returns the weighted mean of the masked values; a zero with gradient if the mask is empty."""
    weights = torch.where(mask, weights, 0.0)
    return (torch.where(mask, values, 0.0) * weights).sum() / weights.sum().clamp(min=torch.finfo(weights.dtype).tiny)


def structure_loss(images: Tensor, reference: Tensor) -> Tensor:
    """Returns the mean of ``1 - SSIM`` (paper, eqn gsloss): 11 x 11 Gaussian window, sigma 1.5, reflected borders.

    Args:
        images: ``[R, C, H, W]``, at least 6 pixels high and wide.
        reference: ``[R, C, H, W]``, of the same dtype.

    Returns:
        A scalar, differentiable in the images. Compiled if both are float32 on a CPU and the reference has no gradient.
    """
    if compilable(images, reference) and not reference.requires_grad and min(images.shape[-2:]) > HALF:
        return Structure.apply(images, reference)  # pyright: ignore[reportReturnType]
    return structure_reference(images, reference)


def structure_reference(images: Tensor, reference: Tensor) -> Tensor:
    """:func:`structure_loss` with kornia, for any device; also differentiable in the reference."""
    window = get_gaussian_kernel1d(WINDOW, SIGMA, device=images.device, dtype=images.dtype)
    maps = torch.stack((images, reference, images * images, reference * reference, images * reference))
    smooth = filter2d_separable(maps.flatten(0, 1), window, window).view_as(maps)  # five maps in one pass
    mean, other, square, other_square, product = smooth
    both, squares = mean * other, mean * mean + other * other
    c1, c2 = 0.01**2, 0.03**2
    agreement = (2 * both + c1) * (2 * (product - both) + c2)
    return (1 - agreement / ((squares + c1) * (square + other_square - squares + c2))).mean()
