"""Options of an evaluation; its configuration and its report contain all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from vg2gt.data.views.drawn import ViewSelection
from vg2gt.metrics.depth import ALIGNMENTS


@dataclass(frozen=True)
class PointOptions:
    """Options of the point-cloud comparison; lengths are in the data's unit.

    Args:
        threshold: distance below which a point counts as correct.
        downsample: edge length of the cells in which one point is kept; None keeps all points.
        cap: distances of at least this length are left out of the means; None: no cap.
    """

    threshold: float = 0.05
    downsample: float | None = 0.02
    cap: float | None = None


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of an evaluation.

    Args:
        selection: selects the views of a scene.
        alignment: alignment of depth, see :func:`vg2gt.metrics.depth_metrics`; the paper uses ``median``.
        depth_range: ``(nearest, farthest)`` in the data's unit; true depths outside count as unknown, for depth,
            normals and points. None: no bound.
        neighbors: number of neighbours k of the uniformity CV.
        points: options of the point-cloud comparison.
        lpips: ``auto`` (weights in torch hub's cache), ``download``, the weights' path, or None: no LPIPS.
        pictures: number of scenes, for each number of views, of which pictures are written.
        refine: number of refinement steps; the refined scene is scored in separate rows. 0: no refinement.
        table: data set in the paper's tables whose rows are printed below ours; None: no rows of the paper.

    Raises:
        ValueError: if the alignment is unknown or the depth range is empty.
    """

    selection: ViewSelection = field(default_factory=ViewSelection)
    alignment: str = "median"
    depth_range: Sequence[float | None] = (None, None)
    neighbors: int = 8
    points: PointOptions = field(default_factory=PointOptions)
    lpips: str | None = "auto"
    pictures: int = 0
    refine: int = 0
    table: str | None = None

    def __post_init__(self) -> None:
        if self.alignment not in ALIGNMENTS:
            raise ValueError(f"evaluation.alignment={self.alignment!r}: choose one of {', '.join(ALIGNMENTS)}")
        if not 0 <= self.nearest < self.farthest:
            raise ValueError(
                f"evaluation.depth_range={list(self.depth_range)} leaves no depth: give [nearest,farthest] with "
                "0 <= nearest < farthest, null for no bound"
            )

    @property
    def nearest(self) -> float:
        """The nearest true depth that counts."""
        return self.depth_range[0] or 0.0

    @property
    def farthest(self) -> float:
        """The farthest true depth that counts."""
        return float("inf") if self.depth_range[1] is None else self.depth_range[1]
