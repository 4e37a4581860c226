"""Options and loss of a refinement; the configurations in ``configs/refine`` list all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from vg2gt.geometry.normals import normals_from_depth
from vg2gt.geometry.spherical_harmonics import MAX_DEGREE
from vg2gt.losses.gaussian import normal_error, structure_loss, weighted_mean
from vg2gt.types import Cameras, Gaussians, Render, TensorRecord, check_ranges

if TYPE_CHECKING:
    from vg2gt.refinement.parameters import RefinedScene

_RENDERINGS = 12  # of each view, if neither steps nor seconds are set
_MIN_ALPHA = 0.5
_MIN_CROP = 16  # pixels: SSIM needs its window


class Progress(NamedTuple):
    """State of a refinement after a step.

    Attributes:
        steps: number of steps made.
        share: share of the stage that is done, in [0, 1].
        psnr: mean PSNR of the last 20 steps in dB; 0 if all that they showed was masked.
        scene: returns the current scene, without autograd graph.
    """

    steps: int
    share: float
    psnr: float
    scene: Callable[[], RefinedScene]


Observer = Callable[[Progress], None]


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

    def shown(self) -> Tensor:
        """Returns ``[V]`` bool, on the CPU: the views of which not all pixels are masked."""
        if self.mask is None:
            return torch.ones(len(self.images), dtype=torch.bool)
        return (self.mask > 0).any(-1).any(-1).cpu()

    def views(self, views: Tensor) -> Observations:
        """Returns the observations of some views."""
        return self.map(lambda tensor: tensor[views])


@dataclass(frozen=True)
class RefineLoss:
    """Loss of rendered views and of the Gaussians themselves.

    Colour alone roughens surfaces: Gaussians in front of and behind a surface explain a pixel as well. The geometry
    terms hold Gaussians at the decoded depth, weighted by its confidence, and orient them along the surface that they
    form. They count where the accumulated opacity exceeds one half.

    Args:
        color_l1: weight of the L1 colour error.
        ssim: weight of ``1 - SSIM`` (11 x 11 window, sigma 1.5).
        depth_consistency: weight of the L1 distance to the decoded depth, in median depths of the scene.
        normal_render: weight of ``1 - cos`` between rendered normals and the normals of the rendered depth.
        normal_decoded: weight of ``1 - cos`` between rendered normals and the normals of the decoded depth.
        opacity: weight of the mean opacity of what trained views show, which makes Gaussians that no image needs
            transparent.

    Raises:
        ValueError: if a weight is negative.
    """

    color_l1: float = 1.0
    ssim: float = 0.2
    depth_consistency: float = 2.0
    normal_render: float = 0.1
    normal_decoded: float = 0.1
    opacity: float = 0.0

    def __post_init__(self) -> None:
        _not_negative(self, "loss")

    @property
    def needs_geometry(self) -> bool:
        """Whether any term uses rendered depth or normals."""
        return bool(self.depth_consistency or self.normal_render or self.normal_decoded)

    def with_geometry(self, factor: float) -> RefineLoss:
        """Returns the loss with the weights of the terms that use depth or normals multiplied."""
        names = ("depth_consistency", "normal_render", "normal_decoded")
        return replace(self, **{name: factor * getattr(self, name) for name in names})

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
        hits = (depth > 0) & (rendered.alpha[0] > _MIN_ALPHA)
        if self.depth_consistency:
            error = (torch.where(hits, depth, 0.0) - seen.depth).abs() / unit
            terms["depth_consistency"] = weighted_mean(error, seen.depth_conf, hits & (seen.depth > 0))
        if self.normal_render:
            expected, valid = normals_from_depth(torch.where(hits, depth, 0.0), cameras.intrinsics[0])
            terms["normal_render"] = normal_error(normal, expected, torch.ones_like(depth), hits & valid)
        if self.normal_decoded:
            expected, valid = normals_from_depth(seen.depth, cameras.intrinsics[0])
            terms["normal_decoded"] = normal_error(normal, expected, seen.depth_conf, hits & valid)
        return terms

    def of_gaussians(self, gaussians: Gaussians, seen: Tensor) -> dict[str, Tensor]:
        """Returns the unweighted terms of the Gaussians whose weight is not 0.

        Args:
            gaussians: the G Gaussians.
            seen: ``[G]`` weights of their opacities in [0, 1].
        """
        return {"opacity": (seen * gaussians.opacities).mean()} if self.opacity else {}

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """Returns the weighted sum of the terms."""
        return torch.stack([getattr(self, name) * value for name, value in terms.items()]).sum()


def _not_negative(options: RefineLoss | RefineRates, name: str) -> None:
    for key, value in asdict(options).items():
        if value is not None and not value >= 0:
            raise ValueError(f"refine.{name}.{key} must be at least 0, got {value}")


@dataclass(frozen=True)
class RefineRates:
    """Learning rates of Adam, roughly the change per step; 0 keeps a parameter fixed.

    Args:
        means: of the positions, in middle standard deviations of each Gaussian.
        quats: of the unit quaternions.
        scales: of the logarithm of the standard deviations.
        opacities: of the logit of the opacities.
        sh: of the constant colour coefficient; the higher bands have a fifth of it.
        cameras: of rotations and shifts, in pixels: a rotation by one pixel, or a shift that moves points at the median
            depth by one pixel.
        exposure: of each view's log gain and bias, one per colour channel. None: 0.004 if the views were exposed
            differently (:mod:`vg2gt.refinement.exposure`), else 0.

    Raises:
        ValueError: if a rate is negative.
    """

    means: float = 0.2
    quats: float = 0.01
    scales: float = 0.02
    opacities: float = 0.05
    sh: float = 0.02
    cameras: float = 0.03
    exposure: float | None = 0.0

    def __post_init__(self) -> None:
        _not_negative(self, "rates")


@dataclass(frozen=True)
class FullSizeOptions:
    """Options of the second stage of a refinement, on the photographs at their own size.

    Each step renders a random crop. Gaussians that are larger than the pixels ask for are split. A fixed fold of the
    views is left out at first: where it gets worse, the stage ends early. Then all views are trained.

    Args:
        size: longer side of the photographs in pixels, at most.
        steps: maximum number of steps, if the refinement has no maximum time.
        renderings: maximum number of times that each pixel of the photographs is rendered: more would overfit.
        crop: longest side of a crop in pixels.
        coarse: share of the stage, at its start, on photographs of half the size, of which a crop shows four times as
            much; only if they are much larger than the working size.
        rate: factor on the rates of positions and colours. Of five sets of photographs, one loses 0.2 dB at 0.25, and
            one 2 dB at 1.
        max_gaussians: no Gaussian is split if there would be more.
        footprint: standard deviation in pixels above which a Gaussian is split.
        least: contribution below which a Gaussian is removed, in pixels of a view of 280.
        thinnest: smallest standard deviation in pixels of the view that sees a Gaussian best; 0: any. Smaller ones
            show details that no photograph has, as needles (Yu et al., Mip-Splatting, 2024: its 3D smoothing filter).
        grow_every: number of steps between splits.
        grow_until: share of the stage after which no Gaussian is split.
        fold: leave out one view of this many at first; 0: none. Fewer than six views are never left out.
        opened: share of the stage after which all views are trained.
        geometry_every: as in :class:`RefineOptions`.
        sh_degree: degree of the colours, if higher than the scene's; None: the scene's.
        ssim: factor on the weight of ``1 - SSIM``. With 2 instead of 1, a head of fur at 1,008 pixels had an SSIM of
            0.864 instead of 0.861 on unseen views, and 0.04 dB less.

    Raises:
        ValueError: if an option is out of range.
    """

    size: int = 1600
    steps: int = 480
    renderings: float = 40.0
    crop: int = 320
    coarse: float = 0.5
    rate: float = 0.5
    max_gaussians: int = 400_000
    footprint: float = 3.0
    least: float = 0.3
    thinnest: float = 0.3
    grow_every: int = 150
    grow_until: float = 0.4
    fold: int = 16
    opened: float = 0.5
    geometry_every: int = 8
    sh_degree: int | None = 2
    ssim: float = 2.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "refine.full.",
            ("size", self.size >= _MIN_CROP, f"at least {_MIN_CROP}"),
            ("steps", self.steps >= 1, "at least 1"),
            ("renderings", self.renderings > 0, "positive"),
            ("crop", self.crop >= _MIN_CROP, f"at least {_MIN_CROP}"),
            ("coarse", 0 <= self.coarse < 1, "in [0, 1)"),
            ("rate", self.rate > 0, "positive"),
            ("max_gaussians", self.max_gaussians >= 1, "at least 1"),
            ("footprint", self.footprint > 0, "positive"),
            ("least", self.least >= 0, "at least 0"),
            ("thinnest", self.thinnest >= 0, "at least 0"),
            ("grow_every", self.grow_every >= 1, "at least 1"),
            ("grow_until", 0 <= self.grow_until <= 1, "in [0, 1]"),
            ("fold", self.fold == 0 or self.fold >= 2, "0 or at least 2"),
            ("opened", 0 < self.opened < 1, "between 0 and 1"),
            ("geometry_every", self.geometry_every >= 1, "at least 1"),
            ("sh_degree", self.sh_degree is None or 0 <= self.sh_degree <= MAX_DEGREE, f"0 to {MAX_DEGREE}, or null"),
            ("ssim", self.ssim >= 0, "at least 0"),
        )


@dataclass(frozen=True)
class RefineOptions:
    """Options of a refinement.

    Args:
        steps: maximum number of steps; None: end by ``seconds`` or, if that is None too, after 12 renderings of each
            view.
        seconds: maximum time; None: end by ``steps``. On a CPU, a number of steps is reproducible, a time is not.
        check_every: number of steps between checks. In between, some views are left out, in rotation. A check scores
            them and prunes transparent Gaussians.
        holdout: never train on every N-th view, but score it before and after; None: train on all.
        sh_degree: degree of the colours, if higher than the scene's; None: the scene's.
        fill: side in pixels of the blocks that get a Gaussian where the scene has none; 0: keep holes.
        min_views: remove Gaussians at the start if fewer views' depth agrees with them, or more views look through them
            than agree: Gaussians that a single view supports overfit it. 0: keep all.
        merge_cells: merge Gaussians at the start if at least two, but fewer than ``min_views``, views agree with them,
            in cells this many times as wide as what the median Gaussian covers; so are those that a single view agrees
            with, where it would otherwise show nothing or the background. 0: remove them.
        geometry_every: render depth and normals in every N-th step only, where the terms that need them count N times;
            rendering colour alone is twice as fast. If N > 1, states are compared by colour alone.
        seed: random seed of the view order.
        rates: learning rates.
        loss: loss to minimise.
        full: second stage on the photographs at their own size (:class:`FullSizeOptions`), for scenes that know their
            photographs; None: none.

    Raises:
        ValueError: if an option is out of range.
    """

    steps: int | None = None
    seconds: float | None = None
    check_every: int = 20
    holdout: int | None = None
    sh_degree: int | None = None
    fill: int = 4
    min_views: int = 0
    merge_cells: float = 0.0
    geometry_every: int = 1
    seed: int = 0
    rates: RefineRates = field(default_factory=RefineRates)
    loss: RefineLoss = field(default_factory=RefineLoss)
    full: FullSizeOptions | None = None

    def __post_init__(self) -> None:
        colored = self.loss.color_l1 + self.loss.ssim > 0
        check_ranges(
            self,
            "refine.",
            ("steps", self.steps is None or self.steps >= 1, "at least 1, or null"),
            ("seconds", self.seconds is None or self.seconds > 0, "positive, or null"),
            ("check_every", self.check_every >= 1, "at least 1"),
            ("holdout", self.holdout is None or self.holdout >= 2, "at least 2, or null"),
            ("sh_degree", self.sh_degree is None or 0 <= self.sh_degree <= MAX_DEGREE, f"0 to {MAX_DEGREE}, or null"),
            ("fill", self.fill >= 0, "at least 0"),
            ("min_views", self.min_views >= 0, "at least 0"),
            ("merge_cells", self.merge_cells >= 0, "at least 0"),
            ("geometry_every", self.geometry_every >= 1, "at least 1"),
            ("geometry_every", colored or self.geometry_every == 1, "1 without a term of colour, which scores states"),
            ("full", colored or self.full is None, "null without a term of colour, which most of its steps need"),
        )

    def of(self, views: int) -> RefineOptions:
        """Returns the options for this number of trained views, with ``steps`` set if they have no end."""
        endless = self.steps is None and self.seconds is None
        return replace(self, steps=_RENDERINGS * views) if endless else self

    def done(self, step: int, seconds: float) -> float:
        """Returns the share of the refinement that is done after ``step`` steps and ``seconds``, at most 1."""
        limits = ((step, self.steps), (seconds, self.seconds))
        return min(1.0, max(passed / limit for passed, limit in limits if limit is not None))
