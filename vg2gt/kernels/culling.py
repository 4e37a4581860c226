"""Which Gaussians a view may show, in one compiled pass (:func:`vg2gt.refinement.growth.in_front`)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from vg2gt.kernels.compiled import kernel
from vg2gt.kernels.threads import parallel_for

_CHUNK = 16384  # Gaussians


def rows_in_front(scales: Tensor, means: Tensor, pose: Tensor, intrinsics: Tensor, limits: tuple[float, ...]) -> Tensor:
    """Returns the index ``[N]`` of the Gaussians that may be visible, as the reference does.

    Args:
        scales: ``[G, 3]`` logarithm of the standard deviations, float32 on the CPU like all others.
        means: ``[G, 3]`` positions.
        pose: ``[4, 4]`` world to camera.
        intrinsics: ``[3, 3]``.
        limits: width and height in pixels, near plane, standard deviations up to which a Gaussian is visible, and
            pixels added to this radius.
    """
    found = np.empty(len(means), np.bool_)
    arrays = [each.detach().contiguous().numpy() for each in (scales, means, pose, intrinsics)]
    numbers = np.array(limits, np.float32)

    def work(first: int) -> None:
        _mark(*arrays, numbers, first, min(first + _CHUNK, len(found)), found)

    parallel_for(range(0, len(found), _CHUNK), work)
    return torch.from_numpy(np.flatnonzero(found))


@kernel(error_model="numpy", nogil=True, fastmath={"contract", "nsz"})
def _mark(scales, means, pose, intrinsics, numbers, begin, end, found):
    width, height, near, reach, margin = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    focal = max(fx, fy)
    for i in range(begin, end):
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        found[i] = False
        if not depth > near:
            continue
        u = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth
        v = (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth
        size = math.exp(max(scales[i, 0], scales[i, 1], scales[i, 2]))
        radius = reach * focal * size / depth * math.sqrt(np.float32(1) + u * u + v * v) + margin
        column, row = fx * u + cx, fy * v + cy
        found[i] = (column > -radius) & (column < width + radius) & (row > -radius) & (row < height + radius)
