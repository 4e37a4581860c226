"""Per-scene optimisation of a feed-forward scene: sharper colour, with geometry held in place."""

from vg2gt.refinement.exposure import exposure_rates
from vg2gt.refinement.options import FullSizeOptions, Observations, RefineLoss, RefineOptions, RefineRates
from vg2gt.refinement.parameters import RefinedScene
from vg2gt.refinement.photographs import Photographs
from vg2gt.refinement.refine import Refined, refine, sharpened, split_views
from vg2gt.refinement.sharpen import Sharpened, fold_of, sharpen

__all__ = [
    "FullSizeOptions",
    "Observations",
    "Photographs",
    "RefineLoss",
    "RefineOptions",
    "RefineRates",
    "Refined",
    "RefinedScene",
    "Sharpened",
    "exposure_rates",
    "fold_of",
    "refine",
    "sharpen",
    "sharpened",
    "split_views",
]
