"""Options of a refinement; the configurations in ``configs/refine`` list all of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace

from vg2gt.geometry.spherical_harmonics import MAX_DEGREE
from vg2gt.refinement.loss import RefineLoss

RENDERINGS = 12  # of each view, if neither steps nor seconds are set


@dataclass(frozen=True)
class RefineRates:
    """Learning rates of Adam, roughly the change per step; 0 keeps a parameter fixed.

    Args:
        means: of the positions, in middle standard deviations of each Gaussian.
        quats: of the unit quaternions.
        scales: of the logarithm of the standard deviations.
        opacities: of the logit of the opacities.
        sh: of the constant colour coefficient; the higher bands have a twentieth of it (as in 3DGS).
        cameras: of rotations and shifts, in pixels: a rotation by one pixel, or a shift that moves points at the median
            depth by one pixel.
        focal: of the logarithm of one factor for all focal lengths.
        exposure: of each view's log gain and bias, one per colour channel.

    Raises:
        ValueError: if a rate is negative.
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
    """Options of a refinement.

    Args:
        steps: maximum number of steps; None: end by ``seconds`` or, if that is None too, after 12 renderings of each
            view.
        seconds: maximum time; None: end by ``steps``. On a CPU, a number of steps is reproducible, a time is not.
        views_per_step: number of views rendered per step.
        final_rate: factor to which rates decay exponentially.
        check_every: number of steps between checks. In between, some views are left out, in rotation. A check scores
            them, prunes transparent Gaussians and, in the first half, splits those with large position gradients.
        holdout: never train on every N-th view, but score it before and after; None: train on all.
        sh_degree: degree of the colours, if higher than the scene's; None: the scene's.
        fill: side in pixels of the blocks that get a Gaussian where the scene has none; 0: keep holes.
        min_views: remove Gaussians at the start if fewer views' depth agrees with them, or more views look through them
            than agree: Gaussians that a single view supports overfit it. 0: keep all.
        merge_cells: merge Gaussians at the start if at least two, but fewer than ``min_views``, views agree with them,
            in cells this many times as wide as what the median Gaussian covers. 0: remove them.
        prune_opacity: opacity below which Gaussians are removed.
        split_share: share of the Gaussians to split at a check, those with the largest position gradients.
        max_growth: maximum number of Gaussians, as a multiple of the initial number.
        seed: random seed of the view order.
        rates: learning rates.
        loss: loss to minimise.

    Raises:
        ValueError: if an option is out of range.
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
        ):
            if not good:
                raise ValueError(f"refine.{name} must be {expected}, got {getattr(self, name)}")

    def of(self, views: int) -> RefineOptions:
        """Returns the options for this number of trained views, with ``steps`` set if they have no end."""
        if self.steps is not None or self.seconds is not None:
            return self
        return replace(self, steps=-(-RENDERINGS * views // self.views_per_step))

    def done(self, step: int, seconds: float) -> float:
        """Returns the share of the refinement that is done after ``step`` steps and ``seconds``, at most 1."""
        shares = [0.0]
        if self.steps is not None:
            shares.append(step / self.steps)
        if self.seconds is not None:
            shares.append(seconds / self.seconds)
        return min(1.0, max(shares))
