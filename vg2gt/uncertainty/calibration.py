"""Calibrated bounds of the depth error from evidence (split conformal prediction).

An error e says that the true depth and the decoded one differ by a factor of 1 + e, whichever is larger. Neither it nor
its bounds have an upper limit: relative to one of the two depths, errors in one direction could not exceed 1.

Pixels are grouped by status, and the calibration scenes are split in two halves. The first half ranks the pixels of a
group: a sum of piecewise linear functions of the evidence is fitted to the logarithm of the error. The second half
calibrates the ranking: pixels are binned by the fitted value, and the bounds of a bin are the quantiles of its errors
(Lei et al., Distribution-Free Predictive Inference for Regression, 2018, in bins as in Mondrian conformal prediction).
The bounds therefore hold on average over scenes like these, even if the backbone's confidence is unreliable.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json, write_json
from vg2gt.types import TensorRecord
from vg2gt.visibility.evidence import EVIDENCE, Status

LEVELS = (0.5, 0.8, 0.9, 0.95)
STATED = 0.9  # level of the bound called ``error``
_UNKNOWN = math.inf  # bound where no depth is measured
MEASURED = (Status.CONTRADICTED, Status.SINGLE, Status.AGREED)  # statuses with a depth
_KNOTS, _BINS = 8, 24
_SCENE_KNOTS = 2  # for evidence shared by a whole scene, which has few distinct values
FEWEST = 4  # minimum number of scenes
SMALLEST = 1e-4  # smaller errors are clamped to this
_RIDGE = 1e-3  # per sample, so that constant evidence gets no weight
LEAST = 50 * _BINS  # minimum number of pixels of a status


@dataclass(frozen=True)
class Samples(TensorRecord):
    """Pixels with a known error.

    Attributes:
        evidence: ``[N, F]`` of :data:`vg2gt.visibility.evidence.EVIDENCE`.
        status: ``[N]``, see :class:`vg2gt.visibility.evidence.Status`.
        error: ``[N]`` error of the decoded depth, see the module docstring.
        scene: ``[N]`` int64 scene index of each pixel.
    """

    evidence: Tensor
    status: Tensor
    error: Tensor
    scene: Tensor

    def select(self, rows: Tensor) -> Samples:
        """Returns some of the pixels."""
        return self.map(lambda column: column[rows])

    @staticmethod
    def joined(parts: Sequence[Samples]) -> Samples:
        """Joins the pixels of several scenes."""
        return Samples(*(torch.cat([getattr(part, each.name) for part in parts]) for each in fields(Samples)))


@dataclass(frozen=True)
class Curve:
    """Map from evidence to error bounds, for the pixels of one group.

    Attributes:
        knots: increasing positions, for each kind of evidence.
        values: contribution to the logarithm of the error at each knot.
        scores: ``[K]`` increasing sums of contributions.
        bounds: ``[L, K]`` bounds of the error at these scores, for each of :data:`LEVELS`.
    """

    knots: tuple[Tensor, ...]
    values: tuple[Tensor, ...]
    scores: Tensor
    bounds: Tensor

    def score(self, evidence: Tensor) -> Tensor:
        """Returns the fitted logarithm of the error ``[N]``, up to a constant, for evidence ``[N, F]``."""
        parts = zip(evidence.unbind(-1), self.knots, self.values, strict=True)
        return torch.stack([_interpolate(column, knots, values) for column, knots, values in parts]).sum(0)

    def __call__(self, evidence: Tensor) -> Tensor:
        """Returns the bounds ``[L, N]`` for evidence ``[N, F]``."""
        score = self.score(evidence)
        return torch.stack([_interpolate(score, self.scores, bound.log()).exp() for bound in self.bounds])


@dataclass(frozen=True)
class Calibration:
    """Bounds of the depth error for one model.

    Attributes:
        curves: by status.
        made_for: digest of the trained weights, or of the backbone's if nothing is trained.
        scenes: number of scenes it was made from.
    """

    curves: Mapping[Status, Curve]
    made_for: str
    scenes: int

    def bounds(self, evidence: Tensor, status: Tensor) -> Tensor:
        """Returns bounds ``[L, ...]`` at :data:`LEVELS` for evidence ``[..., F]``; infinite without a depth."""
        flat, statuses = evidence.flatten(0, -2), status.flatten()
        found = torch.full((len(LEVELS), len(flat)), _UNKNOWN, device=evidence.device)
        for kind, curve in self.curves.items():
            rows = (statuses == kind).nonzero()[:, 0]
            found[:, rows] = curve(flat[rows])
        return found.unflatten(1, status.shape)

    def error(self, evidence: Tensor, status: Tensor) -> Tensor:
        """Returns the bound ``[...]`` that nine of ten pixels stay below."""
        return self.bounds(evidence, status)[LEVELS.index(STATED)]

    @property
    def digest(self) -> str:
        """SHA-256 of the written content."""
        return hashlib.sha256(json.dumps(self._content(), sort_keys=True).encode()).hexdigest()

    def write(self, path: str | Path) -> Path:
        """Writes the calibration as JSON."""
        return write_json(path, self._content())

    def _content(self) -> dict[str, Any]:
        curves = {
            kind.name.lower(): {
                "knots": [_list(knots) for knots in curve.knots],
                "values": [_list(values) for values in curve.values],
                "scores": _list(curve.scores),
                "bounds": [_list(bound) for bound in curve.bounds],
            }
            for kind, curve in self.curves.items()
        }
        facts = {"evidence": list(EVIDENCE), "levels": list(LEVELS)}
        return {"made_for": self.made_for, "scenes": self.scenes, **facts, "curves": curves}


def read_calibration(path: str | Path) -> Calibration:
    """Reads a calibration written by :meth:`Calibration.write`.

    Raises:
        FileNotFoundError: if the file does not exist.
        FormatError: if it is damaged, or from a version with other evidence or levels.
    """
    try:
        content = read_json(path)
        if content["evidence"] != list(EVIDENCE) or content["levels"] != list(LEVELS):
            raise ValueError(f"it uses evidence {content['evidence']} at levels {content['levels']}")
        curves = {Status[name.upper()]: _curve(curve) for name, curve in content["curves"].items()}
        if set(curves) != set(MEASURED):
            raise ValueError("a status is missing")
        return Calibration(curves, str(content["made_for"]), int(content["scenes"]))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(
            f"{path} is not a calibration for this version ({error}): create one with vg2gt calibrate"
        ) from error


def calibrate(samples: Samples, made_for: str) -> Calibration:
    """Makes a calibration from pixels of many scenes (see the module docstring).

    A group with too few pixels uses the curve of all pixels.

    Raises:
        ValueError: if there are fewer than 4 scenes or too few pixels.
    """
    scenes = samples.scene.unique()
    if len(scenes) < FEWEST or len(samples.error) < 2 * LEAST:
        raise ValueError(
            f"{len(scenes)} scenes with {len(samples.error)} pixels of known depth are too few for a calibration: give "
            f"at least {FEWEST} scenes and {2 * LEAST} pixels"
        )
    whole, curves = _fit(*_halves(samples)), {}
    for kind in MEASURED:
        halves = [half.select(half.status == kind) for half in _halves(samples)]
        curves[kind] = _fit(*halves) if min(len(half.error) for half in halves) >= LEAST else whole
    return Calibration(curves, made_for, len(scenes))


def _halves(samples: Samples) -> tuple[Samples, Samples]:
    """Returns the pixels of every other scene, and the rest."""
    first = torch.isin(samples.scene, samples.scene.unique()[::2])
    return samples.select(first), samples.select(~first)


def _fit(order: Samples, meaning: Samples) -> Curve:
    """Fits a curve: one half of the pixels ranks the evidence, the other calibrates the bounds."""
    knots = tuple(_knots(column, name) for column, name in zip(order.evidence.unbind(-1), EVIDENCE, strict=True))
    basis = torch.cat(
        [_hats(column.double(), k) for column, k in zip(order.evidence.unbind(-1), knots, strict=True)], 1
    )
    target = order.error.double().clamp(min=SMALLEST).log()
    normal = basis.T @ basis + _RIDGE * len(basis) * torch.eye(basis.shape[1], dtype=torch.float64)
    solved = torch.linalg.solve(normal, basis.T @ (target - target.mean()))
    values = solved.split([len(k) for k in knots])
    curve = Curve(tuple(k.float() for k in knots), tuple(v.float() for v in values), torch.zeros(1), torch.ones(1, 1))
    score = curve.score(meaning.evidence)
    bins = score.argsort(stable=True).tensor_split(_BINS)
    errors = [meaning.error[rows].clamp(min=SMALLEST) for rows in bins]
    bounds = torch.stack([increasing_quantiles(errors, level) for level in LEVELS])
    return Curve(curve.knots, curve.values, torch.stack([score[rows].mean() for rows in bins]), bounds)


def _knots(column: Tensor, name: str) -> Tensor:
    """Returns increasing quantiles ``[K]`` of one kind of evidence."""
    steps = np.linspace(0, 1, _SCENE_KNOTS if name == "differences" else _KNOTS)
    return torch.from_numpy(np.quantile(column.double().numpy(), steps)).unique()


def increasing_quantiles(errors: Sequence[Tensor], level: float) -> Tensor:
    """Returns bounds ``[K]`` that increase and hold for a share ``level`` of the errors of K bins.

    Bins in the wrong order are pooled, and the bound of a pool is the quantile of all its errors (isotonic regression
    by pooling adjacent violators). So it holds as often as it says for every pool; a mean of bounds would not.
    """
    pools: list[tuple[Tensor, int, float]] = []  # errors, number of bins, bound
    for own in errors:
        pool = (own, 1, _quantile(own, level))
        while pools and pools[-1][2] > pool[2]:
            before = pools.pop()
            joined = torch.cat((before[0], pool[0]))
            pool = (joined, before[1] + pool[1], _quantile(joined, level))
        pools.append(pool)
    return torch.tensor([bound for _, bins, bound in pools for _ in range(bins)])


def _quantile(errors: Tensor, level: float) -> float:
    """Returns the error that a further one stays below with a probability of ``level`` or more."""
    return float(errors.kthvalue(min(math.ceil((len(errors) + 1) * level), len(errors))).values)


def _hats(column: Tensor, knots: Tensor) -> Tensor:
    """Returns weights ``[N, K]`` of linear interpolation between knots."""
    return torch.stack([_interpolate(column, knots, unit) for unit in torch.eye(len(knots)).to(knots)], 1)


def _interpolate(places: Tensor, knots: Tensor, values: Tensor) -> Tensor:
    """Interpolates linearly between ``values [K]`` at ``knots [K]``; constant beyond them."""
    knots, values = knots.to(places), values.to(places)
    if len(knots) == 1:
        return values.expand_as(places)
    right = torch.bucketize(places.contiguous(), knots).clamp(1, len(knots) - 1)
    share = ((places - knots[right - 1]) / (knots[right] - knots[right - 1]).clamp(min=1e-12)).clamp(0, 1)
    return torch.lerp(values[right - 1], values[right], share)


def _list(values: Tensor) -> list[float]:
    return [float(f"{value:.6g}") for value in values.tolist()]


def _curve(content: Mapping[str, Any]) -> Curve:
    knots, values = (tuple(torch.tensor(part) for part in content[name]) for name in ("knots", "values"))
    scores, bounds = (torch.tensor(content[name]) for name in ("scores", "bounds"))
    shapes = [part.shape for part in values] == [part.shape for part in knots]
    shapes = shapes and len(knots) == len(EVIDENCE) and bounds.shape == (len(LEVELS), len(scores))
    finite = all(part.isfinite().all() for part in (*knots, *values, scores, bounds)) and (bounds > 0).all()
    if not (shapes and finite):
        raise ValueError("its arrays have inconsistent shapes, or values that are not finite and positive")
    return Curve(knots, values, scores, bounds)
