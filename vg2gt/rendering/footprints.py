"""Where Gaussians are on the images, how large, and the gradient there: what densification asks for.

The positions are a leaf of the autograd graph that renderers take as one more input.
"""

from __future__ import annotations

import torch
from torch import Tensor

from vg2gt.rendering.options import RenderOptions
from vg2gt.rendering.projection import half_box
from vg2gt.types import Footprints


def make_footprints(views: int, count: int, like: Tensor, options: RenderOptions) -> Footprints | None:
    """Returns the footprints of Gaussians that no view sees, in the dtype and on the device of ``like``.

    None if the options do not ask for any. The positions require gradients unless gradients are off.
    """
    if not (options.footprints or options.absgrad):
        return None
    means2d, radii = like.new_zeros(views, count, 2), like.new_zeros(views, count)
    absgrad = torch.zeros_like(means2d) if options.absgrad else None
    return Footprints(means2d.requires_grad_(torch.is_grad_enabled()), radii, absgrad)


@torch.no_grad()
def note_visible(
    footprints: Footprints,
    views: Tensor | int,
    gaussians: Tensor,
    center: Tensor,
    conic: Tensor,
    tilt: Tensor,
    curvature: Tensor,
    cutoff: Tensor,
) -> None:
    """Writes the positions and radii of N visible Gaussians.

    Args:
        footprints: what is written into.
        views: ``[N]`` view of each, or one of all.
        gaussians: ``[N]`` index of each.
        center: ``[N, 2]``, this and the next three as in :class:`vg2gt.rendering.projection.Splats`.
        conic: ``[N, 3]``.
        tilt: ``[N, 2]``.
        curvature: ``[N]``.
        cutoff: ``[N]``, ``2 ln(255 opacity)``.
    """
    footprints.means2d.detach()[views, gaussians] = center
    footprints.radii[views, gaussians] = half_box(conic, tilt, curvature, cutoff)[1].amax(-1)
