"""How a scene is refined: every option stands in its configuration (``configs/refine``)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace

from vg2gt.geometry.spherical_harmonics import MAX_DEGREE
from vg2gt.refinement.loss import RefineLoss

RENDERINGS = 12  # of each view, where nobody says how long


@dataclass(frozen=True)
class RefineRates:
    """Learning rates of Adam, which are about the change of each step; 0 keeps a thing as it is.

    Args:
        means: in middle standard deviations of each Gaussian.
        quats: of unit quaternions.
        scales: of the logarithm of the standard deviations.
        opacities: of the logit.
        sh: of the constant colour coefficient; the others change a twentieth as fast (3DGS).
        cameras: turns and shifts, in pixels: a turn by one pixel, and a shift that moves the median depth by one.
        focal: of the logarithm of one factor for all focal lengths.
        exposure: of each view's gain (its logarithm) and bias, a colour each.

    Raises:
        ValueError: naming a rate that is negative.
    """

    means: float = 0.2
    quats: float = 0.01
    scales: float = 0.02
    opacities: float = 0.05
    sh: float = 0.02
    cameras: float = 0.03
    focal: float = 0.0
    exposure: float = 0.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not value >= 0:
                raise ValueError(f"refine.rates.{name} must be at least 0, got {value}")


@dataclass(frozen=True)
class RefineOptions:
    """How long and how a scene is refined.

    Args:
        steps: most steps; None: only ``seconds`` ends it, or, without these, 12 renderings of each view.
        seconds: most seconds by the clock; None: only ``steps`` ends it. The same number of steps gives the same scene
            on a CPU, the same number of seconds does not.
        views_per_step: views rendered in a step.
        final_rate: rates fall to this share of theirs, exponentially.
        check_every: steps from one check to the next. Between two checks some views are left out, in turns; at the
            check they are scored, what has become transparent is pruned and what is wrong is split.
        holdout: every this many-th view is never trained on, but scored before and after; None: none.
        sh_degree: of the colours, if it is higher than the scene's; None: the scene's.
        fill: side in pixels of the blocks that get a Gaussian where the scene has none; 0: they stay empty.
        min_views: Gaussians that fewer views' depth agrees with, or more views look through than agree with, are left
            out at the start: what a single view supports overfits it. 0: all stay.
        merge_cells: those that two views agree with, but not ``min_views``, are merged at the start, in cells so many
            times as wide as what the median Gaussian covers. 0: they are left out.
        prune_opacity: Gaussians less opaque are removed.
        split_share: share of the Gaussians that a check splits, those whose positions are pulled the most.
        max_growth: the scene has at most this many times its Gaussians.
        dropout: share of the Gaussians that a step at the end leaves out at random, growing from 0 (DropGaussian, Park
            et al. 2025): with few views no Gaussian may matter for one of them alone.
        seed: of the order of the views and of what is left out.
        rates: learning rates.
        loss: what is lowered.

    Raises:
        ValueError: naming an option that is out of range.
    """

    steps: int | None = None
    seconds: float | None = None
    views_per_step: int = 1
    final_rate: float = 0.1
    check_every: int = 20
    holdout: int | None = None
    sh_degree: int | None = None
    fill: int = 4
    min_views: int = 0
    merge_cells: float = 0.0
    prune_opacity: float = 0.02
    split_share: float = 0.0
    max_growth: float = 1.5
    dropout: float = 0.0
    seed: int = 0
    rates: RefineRates = field(default_factory=RefineRates)
    loss: RefineLoss = field(default_factory=RefineLoss)

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("steps", self.steps is None or self.steps >= 1, "at least 1, or null"),
            ("seconds", self.seconds is None or self.seconds > 0, "positive, or null"),
            ("views_per_step", self.views_per_step >= 1, "at least 1"),
            ("final_rate", 0 < self.final_rate <= 1, "above 0 and at most 1"),
            ("check_every", self.check_every >= 1, "at least 1"),
            ("holdout", self.holdout is None or self.holdout >= 2, "at least 2, or null"),
            ("sh_degree", self.sh_degree is None or 0 <= self.sh_degree <= MAX_DEGREE, f"0 to {MAX_DEGREE}, or null"),
            ("fill", self.fill >= 0, "at least 0"),
            ("min_views", self.min_views >= 0, "at least 0"),
            ("merge_cells", self.merge_cells >= 0, "at least 0"),
            ("prune_opacity", 0 <= self.prune_opacity < 1, "at least 0 and below 1"),
            ("split_share", 0 <= self.split_share <= 1, "between 0 and 1"),
            ("max_growth", self.max_growth >= 1, "at least 1"),
            ("dropout", 0 <= self.dropout < 1, "at least 0 and below 1"),
        ):
            if not good:
                raise ValueError(f"refine.{name} must be {expected}, got {getattr(self, name)}")

    def of(self, views: int) -> RefineOptions:
        """The same options for so many trained views, with an end."""
        if self.steps is not None or self.seconds is not None:
            return self
        return replace(self, steps=-(-RENDERINGS * views // self.views_per_step))

    def done(self, step: int, seconds: float) -> float:
        """Share of the refinement that is done after so many steps and seconds, at most 1."""
        shares = [0.0]
        if self.steps is not None:
            shares.append(step / self.steps)
        if self.seconds is not None:
            shares.append(seconds / self.seconds)
        return min(1.0, max(shares))
