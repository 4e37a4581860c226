"""Conversion between one scene's Gaussians and the plain arrays of the Gaussian file formats."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vg2gt.types import Gaussians

log = logging.getLogger(__name__)

MIN_SCALE = 1e-10  # smaller standard deviations overflow the renderers' inverse covariance
OPACITY_MARGIN = 2.0**-24  # opacities are clipped to [this, 1 - this], so that their logits are finite
_FLOAT_MAX = float(np.finfo(np.float32).max)


@dataclass(frozen=True, eq=False)
class GaussianArrays:
    """Gaussians of one scene as float64 arrays of N rows; fields as in :class:`vg2gt.types.Gaussians`."""

    means: NDArray[np.floating]
    quats: NDArray[np.floating]
    scales: NDArray[np.floating]
    opacities: NDArray[np.floating]
    sh: NDArray[np.floating]


def to_arrays(gaussians: Gaussians) -> GaussianArrays:
    """Converts one scene's Gaussians to arrays.

    Raises:
        ValueError: if there is more than one scene, or a value cannot be written.
    """
    if len(gaussians) and int(gaussians.batch[0]) != int(gaussians.batch[-1]):
        raise ValueError("a file holds one scene, these Gaussians are of several; write Gaussians.scene(i) one by one")
    names = ("means", "quats", "scales", "opacities", "sh")
    arrays = {name: getattr(gaussians, name).detach().cpu().double().numpy() for name in names}
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} has {np.sum(~np.isfinite(values))} values that are not finite; leave them out")
    if (arrays["scales"] <= 0).any():
        raise ValueError(f"scales must be positive standard deviations, the smallest is {arrays['scales'].min()}")
    if not arrays["quats"].any(-1).all():
        raise ValueError("quats must have nonzero norm")
    if ((arrays["opacities"] < 0) | (arrays["opacities"] > 1)).any():
        raise ValueError("opacities must be in [0, 1] (not logits)")
    if arrays["sh"].ndim != 3 or arrays["sh"].shape[1] not in (1, 4, 9, 16):
        raise ValueError(f"sh must be [G, 1, 4, 9 or 16, 3], got {list(arrays['sh'].shape)}")
    return GaussianArrays(**arrays)


def to_gaussians(path: Path, arrays: GaussianArrays) -> Gaussians:
    """Converts the arrays of a file to Gaussians (float32, scene 0).

    Rows with a value that is not finite or a zero quaternion are dropped with a warning. Scales are clamped to at least
    ``MIN_SCALE``.
    """
    good = (arrays.quats != 0).any(-1)
    for values in (arrays.means, arrays.quats, arrays.scales, arrays.opacities, arrays.sh):
        good &= (np.abs(values) <= _FLOAT_MAX).all(axis=tuple(range(1, values.ndim)))  # false for NaN too
    if not good.all():
        log.warning("%s: %d of %d Gaussians are not finite and are left out", path, np.sum(~good), len(good))

    def tensor(values: NDArray[np.floating]) -> torch.Tensor:
        return torch.from_numpy(values[good].astype(np.float32))

    return Gaussians(
        tensor(arrays.means),
        tensor(arrays.quats),
        tensor(arrays.scales).clamp(min=MIN_SCALE),
        tensor(arrays.opacities),
        tensor(arrays.sh),
        torch.zeros(int(good.sum()), dtype=torch.int64),
    )
