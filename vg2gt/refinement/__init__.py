"""Per-scene optimisation of a feed-forward scene: sharper colour, with geometry held in place."""

from vg2gt.refinement.loss import Observations, RefineLoss
from vg2gt.refinement.options import RefineOptions, RefineRates
from vg2gt.refinement.parameters import RefinedScene
from vg2gt.refinement.refine import Check, Progress, Refined, refine

__all__ = [
    "Check",
    "Observations",
    "Progress",
    "RefineLoss",
    "RefineOptions",
    "RefineRates",
    "Refined",
    "RefinedScene",
    "refine",
]
