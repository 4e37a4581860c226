"""Cross-view depth checks: our addition to the paper (docs/concepts/deviations.md)."""

from vg2gt.method.additions.visibility.check import Support, ViewCheck, choose_partners, depth_differences
from vg2gt.method.additions.visibility.counts import ViewCounts, count_points, count_views

__all__ = ["Support", "ViewCheck", "ViewCounts", "choose_partners", "count_points", "count_views", "depth_differences"]
