"""Which pixels and points the views agree on: our addition to the paper (docs/concepts/deviations.md)."""

from vg2gt.visibility.agreed import keep_agreed
from vg2gt.visibility.check import Support, ViewCheck, choose_partners, depth_differences
from vg2gt.visibility.counts import ViewCounts, count_points, count_views
from vg2gt.visibility.evidence import Status, pixel_evidence, point_support

__all__ = [
    "Status",
    "Support",
    "ViewCheck",
    "ViewCounts",
    "choose_partners",
    "count_points",
    "count_views",
    "depth_differences",
    "keep_agreed",
    "pixel_evidence",
    "point_support",
]
