"""Per-scene optimisation of a feed-forward scene: sharper colour, with geometry held in place."""

from vg2gt.refinement.options import Observations, RefineLoss, RefineOptions, RefineRates
from vg2gt.refinement.parameters import RefinedScene
from vg2gt.refinement.refine import Refined, refine

__all__ = [
    "Observations",
    "RefineLoss",
    "RefineOptions",
    "RefineRates",
    "Refined",
    "RefinedScene",
    "refine",
]
