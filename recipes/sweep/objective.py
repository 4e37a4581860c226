"""Training objective of the plane sweep: log-depth at every stage, cross-entropy of planes, edges and uncertainty."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from backends.sweep.network import Sweep, SweepEncoding
from backends.sweep.volume import from_inverse, near_and_far
from recipes.sweep.samples import Sample

_CLAMP = 2.0  # log-depth errors are clamped to this
_BEYOND = 1.5  # times the farthest plane: for sky and farther surfaces, any depth from here on counts as correct
_ROOM = 1.0  # up to this much log-depth farther, so that depth does not diverge
_BEYOND_ERROR = 0.7  # minimum relative error that the uncertainty of such pixels is trained on
WEIGHTS = {"depth": 2.0, "uncertainty": 0.15, "gradient": 1.0, "planes": 0.4, "position": 2.0, "swept": 1.0}


def objective(
    encoding: SweepEncoding, depth: Tensor, log_scale: Tensor, sample: Sample
) -> tuple[Tensor, dict[str, Tensor]]:
    """Computes the training objective.

    Args:
        encoding: encoding of the sample's images.
        depth: decoded depth ``[V, H, W]``.
        log_scale: log-scale of its relative error ``[V, H, W]``.
        sample: ground-truth depth (0 is unknown, infinity is sky) and range of the planes.

    Returns:
        The weighted sum, and its unweighted terms.
    """
    # decoded depth; pixels beyond the planes only need to be far enough
    beyond_planes = _BEYOND * near_and_far(sample.depth_range)[1]  # [S V, 1, 1, 1]
    farthest = beyond_planes[..., 0]
    beyond = sample.depth > farthest
    seen = (sample.depth > 0).float()
    valid = seen * ~beyond
    error = depth.log() - torch.where(valid > 0, sample.depth, farthest).log()
    outside = (-error).clamp_min(0) + (error - _ROOM).clamp_min(0)
    absolute = torch.where(beyond, outside, error.abs()).clamp_max(_CLAMP)
    stated = torch.where(beyond, absolute.clamp_min(_BEYOND_ERROR), absolute)
    log_scale = log_scale.clamp(-6, 1)
    terms = {
        "depth": mean(absolute, seen),
        "uncertainty": mean(stated * torch.exp(-log_scale) + log_scale, seen),
        "gradient": sum((gradient(error[:, ::k, ::k], valid[:, ::k, ::k]) for k in (1, 2, 4)), torch.zeros(())),
    }
    # both sweeps, at 1/4 and 1/2 of the image
    planes, positions = [], []
    for sweep, cell in ((encoding.first, 4), (encoding.second, 2)):
        inverse, known = cell_inverse(sample.depth, cell)
        finite = known * (inverse > 1 / beyond_planes)
        inverse = inverse.clamp_min(1 / beyond_planes)
        t = from_inverse(inverse, sample.depth_range)
        planes.append(_cross_entropy(sweep, t, known))
        for position in (sweep.t, encoding.refined if cell == 4 else encoding.center):
            positions.append(mean((position - t).abs().clamp_max(0.3), known))
        if cell == 2:
            terms["swept"] = mean((encoding.swept[:, :1] + inverse.log()).abs().clamp_max(_CLAMP), finite)
    terms["planes"] = torch.stack(planes).sum()
    terms["position"] = torch.stack(positions).sum()
    return torch.stack([WEIGHTS[name] * term for name, term in terms.items()]).sum(), terms


def cell_inverse(depth: Tensor, cell: int) -> tuple[Tensor, Tensor]:
    """Downsamples depth ``[V, H, W]`` to cells of ``cell x cell`` pixels.

    The inverse depth at the centre of a cell is the mean of the four pixels around it, which is exact on planes.

    Returns:
        Inverse depth ``[V, 1, h, w]``, and a mask that is 1 where all four pixels are known.
    """
    at = (cell // 2 - 1, cell // 2)
    around = torch.stack([depth[:, i::cell, j::cell] for i in at for j in at], 1)
    known = (around > 0).all(1, keepdim=True)
    inverse = around.clamp_min(1e-3).reciprocal().mean(1, keepdim=True)
    return torch.where(known, inverse, 1.0), known.float()


def mean(values: Tensor, weights: Tensor) -> Tensor:
    """Returns the weighted mean; weights that sum to less than 1 count as if they did to 1."""
    return (values * weights).sum() / weights.sum().clamp_min(1)


def gradient(error: Tensor, valid: Tensor) -> Tensor:
    """Returns the mean absolute difference of neighbouring errors; invariant to the scale of depth."""
    down = (error[:, 1:] - error[:, :-1]).abs().clamp_max(1) * valid[:, 1:] * valid[:, :-1]
    right = (error[:, :, 1:] - error[:, :, :-1]).abs().clamp_max(1) * valid[:, :, 1:] * valid[:, :, :-1]
    return down.mean() + right.mean()


def _cross_entropy(sweep: Sweep, t: Tensor, known: Tensor) -> Tensor:
    """Cross-entropy of the planes; the target ``t [V, 1, h, w]`` is split linearly between its two nearest planes."""
    position = sweep.position.expand(len(t), -1, *t.shape[-2:]) if sweep.position.shape[0] == 1 else sweep.position
    count = position.shape[1]
    spacing = position[:, 1:2] - position[:, :1]
    place = (t - position[:, :1]) / spacing
    if sweep.position.shape[-1] == 1:  # first sweep: surfaces beyond the farthest plane are assigned to it
        place = place.clamp_min(0)
    known = known * (place >= 0) * (place <= count - 1)
    low = place.floor().clamp(0, count - 2)
    share = (place - low).clamp(0, 1)
    likely = F.log_softmax(sweep.logits, 1)
    low = low.long()
    entropy = -(likely.gather(1, low) * (1 - share) + likely.gather(1, low + 1) * share)
    return mean(entropy, known)
