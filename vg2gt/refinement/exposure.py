"""Finds out whether the views of a scene were exposed differently."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from vg2gt.refinement.options import Observations, RefineRates
from vg2gt.rendering import Renderer
from vg2gt.types import Cameras, Gaussians

_DARKEST, _BRIGHTEST = 0.05, 0.95  # pixels outside are clipped or noise
COVERED = 0.5  # opacity of a pixel that shows a surface
_DIFFERENT = 0.1  # over the views, standard deviation: 0.02 to 0.06 on photographs, 0.3 with gains of 1/2 to 1.6
RATE = 0.004


@torch.no_grad()
def log_exposures(gaussians: Gaussians, cameras: Cameras, seen: Observations, renderer: Renderer) -> Tensor:
    """Returns ``[V, 3]`` the logarithm of each view's exposure by colour channel, relative to the scene's.

    The colours of a feed-forward scene are means over its views, so the median ratio of a view's pixels to their
    renderings tells how much brighter the view is than the others.

    Args:
        gaussians: the scene (B = 1).
        cameras: cameras of its V views (B = 1).
        seen: observations of the views.
        renderer: renderer of the scene.
    """
    plain, found = replace(renderer, geometry=False), []
    for view in range(len(seen.images)):
        shown = plain(gaussians, cameras.select(slice(view, view + 1)))
        color, image = shown.color[0, 0], seen.images[view]
        good = (shown.alpha[0, 0] > COVERED) & (torch.minimum(color, image).amin(0) > _DARKEST)
        good &= torch.maximum(color, image).amax(0) < _BRIGHTEST
        if seen.mask is not None:
            good &= seen.mask[view] > COVERED
        ratio = (image[:, good].log() - color[:, good].log()).median(-1).values if good.any() else image.new_zeros(3)
        found.append(ratio)
    return torch.stack(found)


def exposure_rates(
    rates: RefineRates, gaussians: Gaussians, cameras: Cameras, seen: Observations, renderer: Renderer
) -> RefineRates:
    """Returns the rates with that of exposures set, if it is None; arguments as for :func:`log_exposures`."""
    if rates.exposure is not None:
        return rates
    found = log_exposures(gaussians, cameras, seen, renderer)
    differ = len(found) > 1 and bool((found.std(0) > _DIFFERENT).any())
    return replace(rates, exposure=RATE if differ else 0.0)
