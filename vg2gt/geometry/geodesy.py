"""Positions on the Earth: latitude, longitude and altitude in metres; the place of a scene by its cameras' GPS."""

from __future__ import annotations

import cmath
import logging
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vg2gt.geometry.alignment import align_points

log = logging.getLogger(__name__)

_EQUATOR, _FLATTENING = 6378137.0, 1 / 298.257223563  # WGS 84, radius in metres
_FEWEST = 4  # positions
_DRAWS = 300
_AGREE = 0.8  # share of the positions that a candidate must fit
_WITHIN = 3.0  # median distances up to which a position counts
_SURE = 0.05  # metres within which it always does
_SEVERAL = 12  # positions from which on altitudes of two references can be told
_SPLIT = 1 / 3  # of the distances: what remains of them with two references. Of noise alone, about a half remains
_STEP = 1 / 8  # of the step between the references: the same
_COARSE = 0.05  # largest relative error of the scale
_LINE = 1e-3  # width of the positions, relative to their length, up to which they are on a line
_TILT = 0.05  # largest standard error of the turn about that line, in radians


@dataclass(frozen=True, eq=False)
class Place:
    """Where cameras are on the Earth.

    Attributes:
        to_enu: ``[4, 4]`` float64 similarity from the cameras' world to metres east, north and up of the origin.
        origin: latitude and longitude in degrees (WGS 84), altitude in metres.
        error: median distance between the cameras and their measured positions, in metres.
        scale_error: estimated relative standard error of the scale.
        used: number of positions that agree.
        is_level: whether the positions determine the direction up; cameras on one line do not.
    """

    to_enu: NDArray[np.float64]
    origin: tuple[float, float, float]
    error: float
    scale_error: float
    used: int
    is_level: bool

    @property
    def scale(self) -> float:
        """Metres per unit of the cameras' world."""
        return float(np.cbrt(np.linalg.det(self.to_enu[:3, :3])))

    @property
    def up(self) -> NDArray[np.float64]:
        """Direction up ``[3]`` in the cameras' world, of length 1."""
        return self.to_enu[2, :3] / self.scale


def enu(positions: NDArray[np.float64], origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Converts positions to metres east, north and up of an origin.

    Args:
        positions: ``[N, 3]`` latitude and longitude in degrees (WGS 84), altitude in metres.
        origin: latitude, longitude and altitude ``[3]`` of the origin.

    Returns:
        ``[N, 3]``.
    """
    # its columns are up, east and north
    turn = Rotation.from_euler("ZY", [origin[1], -origin[0]], degrees=True).as_matrix()
    up_east_north = (_earth_centred(positions) - _earth_centred(origin[None])) @ turn
    return up_east_north[:, [1, 2, 0]]


def from_utm(east: float, north: float, zone: int, is_south: bool) -> tuple[float, float]:
    """Returns latitude and longitude in degrees of UTM coordinates in metres (WGS 84), by Krueger's series."""
    n = _FLATTENING / (2 - _FLATTENING)
    radius = _EQUATOR / (1 + n) * (1 + n**2 / 4 + n**4 / 64) * 0.9996
    flat = complex((north - 1e7 * is_south) / radius, (east - 5e5) / radius)
    terms = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    flat -= sum(term * cmath.sin(2 * order * flat) for order, term in enumerate(terms, 1))
    conformal = math.asin(math.sin(flat.real) / math.cosh(flat.imag))
    terms = (2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15)
    latitude = conformal + sum(term * math.sin(2 * order * conformal) for order, term in enumerate(terms, 1))
    longitude = math.atan2(math.sinh(flat.imag), math.cos(flat.real))
    return math.degrees(latitude), math.degrees(longitude) + 6 * zone - 183


def fit_place(centers: NDArray[np.float64], positions: NDArray[np.float64]) -> Place | None:
    """Fits a similarity from camera centres to measured positions; outliers do not count.

    Candidates are the similarities of three cameras each; the one that fits four fifths of the positions best is fitted
    again to all positions within three times the median distance. Altitudes of two references, such as sea level and
    the ellipsoid, are brought to one, named in a warning.

    Args:
        centers: ``[N, 3]`` in the cameras' world.
        positions: ``[N, 3]`` latitude, longitude, altitude; NaN where unknown.

    Returns:
        The place; None if there are fewer than four positions, or they are too coarse for the cameras' distances: the
        relative error of the scale would exceed 5 %.
    """
    known = np.isfinite(positions).all(1)
    if known.sum() < _FEWEST:
        return None
    origin = np.median(positions[known], 0)
    source, target = (torch.from_numpy(each) for each in (centers[known], enu(positions[known], origin)))
    generator = torch.Generator().manual_seed(0)
    draws = torch.stack([torch.randperm(len(source), generator=generator)[:3] for _ in range(_DRAWS)])
    candidates = align_points(source[draws], target[draws])
    off = candidates.apply(source.expand(_DRAWS, -1, -1)) - target
    best, score = _best(off)
    if len(source) >= _SEVERAL and score > _SURE:
        is_low, steps = _two_levels(off[..., 2])
        split, left = _best(torch.cat((off[..., :2], off[..., 2:] - steps[..., None]), -1))
        low, step = is_low[split].numpy(), float(steps[split].max() - steps[split].min())
        if left < min(_SPLIT * score, _STEP * step) and 1 - _AGREE <= low.mean() <= _AGREE:
            log.warning(
                "the altitudes of the positions have two references, %.0f m apart (such as sea level and the "
                "ellipsoid): %d of %d are raised to the others' reference", step, low.sum(), len(low),
            )  # fmt: skip
            return fit_place(centers[known], positions[known] + np.outer(low, (0, 0, step)))
    near = _agreeing(off[best].norm(dim=-1))
    for _ in range(3):
        fit = align_points(source[None, near], target[None, near])
        near = _agreeing((fit.apply(source[None]) - target).norm(dim=-1)[0])
    place = place_of_points(source[near].numpy(), positions[known][near.numpy()])
    return place if place.scale_error <= _COARSE else None


def _best(off: torch.Tensor) -> tuple[int, float]:
    """Returns the candidate that fits four fifths of the positions best by its offsets ``[C, N, 3]``, and how well."""
    scores = off.norm(dim=-1).quantile(_AGREE, 1, interpolation="higher").nan_to_num(torch.inf)
    return int(scores.argmin()), float(scores.min())


def _two_levels(heights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns which heights ``[C, N]`` are in the upper of two groups, and the median of each one's group."""
    is_upper = heights > heights.quantile(torch.tensor([0.1, 0.9], dtype=heights.dtype), 1).mean(0)[:, None]
    upper, lower = (heights.where(part, torch.nan).nanmedian(1, keepdim=True).values for part in (is_upper, ~is_upper))
    return is_upper, upper.where(is_upper, lower)


def _agreeing(distance: torch.Tensor) -> torch.Tensor:
    """Returns which positions count, by their distances ``[N]``: four fifths of them in any case."""
    limit = torch.maximum(_WITHIN * distance.median(), distance.quantile(_AGREE, interpolation="higher"))
    return distance <= limit.clamp(min=_SURE)


def place_of_points(points: NDArray[np.float64], positions: NDArray[np.float64]) -> Place:
    """Fits a similarity from at least three points to their positions, all of which count.

    Args:
        points: ``[N, 3]``.
        positions: ``[N, 3]`` latitude, longitude, altitude of the same points.
    """
    origin = np.median(positions, 0)
    source, target = torch.from_numpy(points), torch.from_numpy(enu(positions, origin))
    fit = align_points(source[None], target[None])
    distance = (fit.apply(source[None]) - target).norm(dim=-1)[0]
    spread = torch.linalg.svdvals(target - target.mean(0))
    scale_error = float(distance.square().mean().sqrt() / spread[:2].norm()) if spread[0] > 0 else float("inf")
    matrix = np.eye(4)
    matrix[:3, :3] = float(fit.scale[0]) * fit.rotation[0].numpy()
    matrix[:3, 3] = fit.translation[0].numpy()
    noise = float(distance.square().mean().sqrt()) / 3**0.5  # along an axis
    is_level = bool(spread[1] > max(_LINE * float(spread[0]), noise / _TILT))
    latitude, longitude, altitude = origin.tolist()
    return Place(matrix, (latitude, longitude, altitude), float(distance.median()), scale_error, len(points), is_level)


def _earth_centred(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Converts latitude, longitude and altitude ``[N, 3]`` to metres from the Earth's centre."""
    latitude, longitude, altitude = np.radians(positions[:, 0]), np.radians(positions[:, 1]), positions[:, 2]
    squared = _FLATTENING * (2 - _FLATTENING)  # eccentricity
    radius = _EQUATOR / np.sqrt(1 - squared * np.sin(latitude) ** 2)
    across = (radius + altitude) * np.cos(latitude)
    polar = (radius * (1 - squared) + altitude) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), polar], 1)
