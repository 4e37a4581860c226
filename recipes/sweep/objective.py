"""Training objective of the plane sweep: log-depth of every stage, cross-entropy of planes, edges and uncertainty."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from backends.sweep.network import ROWS, SweepEncoding
from backends.sweep.planes import PLANES, Planes
from backends.sweep.stage import Stage
from backends.sweep.views import baselines
from recipes.sweep.samples import Sample

_CLAMP, _SLOPE = 2.0, 0.2  # log-depth errors above this count by the slope only
_SKY_BELOW = 1.5 / (PLANES - 1)  # position from which on any greater depth counts as correct, as for sky
_ROOM = 1.0  # up to this much log-depth farther, so that depth does not diverge
_BEYOND_ERROR = 0.7  # minimum relative error that the uncertainty of such pixels is trained on
_TERM_WEIGHTS = {
    "depth": 2.0,
    "uncertainty": 0.15,
    "gradient": 1.0,
    "planes": 0.3,
    "stages": 0.5,
    "centers": 0.5,
    "guess": 0.3,
}


def objective(
    encoding: SweepEncoding, depth: Tensor, log_scale: Tensor, sample: Sample
) -> tuple[Tensor, dict[str, Tensor]]:
    """Computes the training objective.

    Args:
        encoding: encoding of the sample's images.
        depth: decoded depth ``[V, H, W]``.
        log_scale: log-scale of its relative error ``[V, H, W]``.
        sample: ground-truth depth (0 is unknown, infinity is sky) and weights of the pixels.

    Returns:
        The weighted sum, and its unweighted terms.
    """
    planes = Planes(baselines(sample.world_to_camera))
    farthest = planes.inverse(torch.full_like(sample.depth[:, None, :1, :1], _SKY_BELOW)).reciprocal()  # [V, 1, 1, 1]
    known = (sample.depth > 0).float()
    error, beyond = _log_error(depth.log()[:, None], sample.depth[:, None], farthest)
    error, beyond = error[:, 0], beyond[:, 0]
    stated = torch.where(beyond, error.abs().clamp_min(_BEYOND_ERROR), error.abs()).clamp_max(_CLAMP)
    valid = known * ~beyond
    log_scale = log_scale.clamp(-6, 1)
    terms = {
        "depth": _mean(_limited(error), known * sample.weight),
        "uncertainty": _mean(stated * torch.exp(-log_scale) + log_scale, known),
        "gradient": sum((_gradient(error[:, ::k, ::k], valid[:, ::k, ::k]) for k in (1, 2, 4)), torch.zeros(())),
    }
    sums: dict[str, list[Tensor]] = {"planes": [], "stages": [], "centers": [], "guess": []}
    for stage, center, cell, rows in zip(encoding.stages, encoding.centers, (8, 4, 2), ROWS, strict=True):
        inverse, seen = cell_inverse(sample.depth, cell)
        weight = seen * F.avg_pool2d(sample.weight[:, None], cell)
        truth = inverse.clamp_min(1e-9).reciprocal()
        found = -planes.inverse(stage.t).log()
        sums["planes"].append(plane_entropy(stage, planes.position(truth.log()), seen, rows))
        looked = {"stages": found, "centers": center} | ({"guess": encoding.guess} if cell == 8 else {})
        for name, log_depth in looked.items():
            off = _limited(_log_error(log_depth, truth, farthest)[0])
            sums[name].append(_mean(off, seen if name == "stages" else weight))
    terms |= {name: torch.stack(values).sum() for name, values in sums.items()}
    return torch.stack([_TERM_WEIGHTS[name] * term for name, term in terms.items()]).sum(), terms


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


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    """Returns the weighted mean; weights that sum to less than 1 count as if they did to 1."""
    return (values * weights).sum() / weights.sum().clamp_min(1)


def _gradient(error: Tensor, valid: Tensor) -> Tensor:
    """Returns the mean absolute difference of neighbouring errors; invariant to the scale of depth."""
    down = (error[:, 1:] - error[:, :-1]).abs().clamp_max(1) * valid[:, 1:] * valid[:, :-1]
    right = (error[:, :, 1:] - error[:, :, :-1]).abs().clamp_max(1) * valid[:, :, 1:] * valid[:, :, :-1]
    return down.mean() + right.mean()


def _log_error(log_depth: Tensor, truth: Tensor, farthest: Tensor) -> tuple[Tensor, Tensor]:
    """Error of log-depth, and whether the truth is beyond the farthest plane, where it only has to be far enough."""
    beyond = truth > farthest
    truth = torch.where(beyond | (truth <= 0), farthest, truth)
    error = log_depth - truth.log()
    outside = error.clamp_max(0) + (error - _ROOM).clamp_min(0)
    return torch.where(beyond, outside, error), beyond


def _limited(error: Tensor) -> Tensor:
    """Absolute error, less of what is gross; never flat, as planes reach to infinity."""
    return error.abs().clamp_max(_CLAMP) + _SLOPE * (error.abs() - _CLAMP).clamp_min(0)


def plane_entropy(stage: Stage, t: Tensor, known: Tensor, rows: int = 1) -> Tensor:
    """Cross-entropy of the planes of a stage; the target is split linearly between its two nearest planes.

    Args:
        stage: the stage.
        t: true positions ``[V, 1, h, w]``.
        known: 1 where they are known, else 0, ``[V, 1, h, w]``.
        rows: number of rows of evenly spaced planes; the target is in the first row that holds it.

    Returns:
        The mean over the pixels whose target is in a row; 0 if there are none.
    """
    entropy, every = torch.zeros_like(t), torch.zeros_like(t)
    likely = F.log_softmax(stage.logits, 1)
    for position, row in zip(stage.position.chunk(rows, 1), likely.chunk(rows, 1), strict=True):
        count = position.shape[1]
        place = count - 1 - (position[:, -1:] - t) / (position[:, -1:] - position[:, -2:-1])
        held = known * (place >= 0) * (place <= count - 1) * (1 - every)
        low = place.floor().clamp(0, count - 2)
        share, low = (place - low).clamp(0, 1), low.long()
        entropy = entropy - held * (row.gather(1, low) * (1 - share) + row.gather(1, low + 1) * share)
        every = every + held
    return entropy.sum() / every.sum().clamp_min(1)
