"""Views that check each other's depth: our addition to the paper (docs/concepts/deviations.md)."""

from vg2gt.method.additions.visibility.check import Support, ViewCheck
from vg2gt.method.additions.visibility.counts import ViewCounts, count_points, count_views
from vg2gt.method.additions.visibility.partners import choose_partners

__all__ = ["Support", "ViewCheck", "ViewCounts", "choose_partners", "count_points", "count_views"]
