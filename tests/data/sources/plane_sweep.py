"""Plane sweep: how well one image explains another at the best of many depths, from poses and intrinsics alone."""

import torch
from torch.nn.functional import avg_pool2d, grid_sample

from vg2gt.data import Frames
from vg2gt.geometry.cameras import project, unproject

from ..warping import camera

WINDOW = 9
CONTRAST = 0.01
"""Standard deviation of grey below which noise decides, as in front of a black background."""


def median_best_ncc(frames: Frames, near: float, far: float, planes: int = 64) -> float:
    """Median over the textured windows of the first frame of the best normalised cross-correlation with the second."""
    gray = frames.images.mean(1)
    textured = (_mean(gray[0] ** 2) - _mean(gray[0]) ** 2) > CONTRAST**2
    height, width = gray.shape[-2:]
    first, second = camera(frames, 0), camera(frames, 1)
    best = torch.full((height, width), -1.0)
    for depth in 1 / torch.linspace(1 / near, 1 / far, planes):
        pixels, z = project(unproject(torch.full((1, 1, height, width), float(depth)), first), second)
        grid = (pixels[0] + 0.5) * (2 / torch.tensor([width, height])) - 1
        warped = grid_sample(gray[1][None, None], grid, padding_mode="border", align_corners=False)[0, 0]
        inside = (grid[0].abs() < 1).all(-1) & (z[0, 0] > 0)
        score = torch.where(_mean(inside.float()) > 0.999, _ncc(gray[0], warped), -1.0)
        best = torch.maximum(best, score)
    return float(best[textured & (best > -1)].median())


def _ncc(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    mean_a, mean_b = _mean(a), _mean(b)
    covariance = _mean(a * b) - mean_a * mean_b
    variances = (_mean(a * a) - mean_a**2) * (_mean(b * b) - mean_b**2)
    return covariance / variances.clamp(min=1e-10).sqrt()


def _mean(image: torch.Tensor) -> torch.Tensor:
    return avg_pool2d(image[None, None], WINDOW, 1, WINDOW // 2, count_include_pad=False)[0, 0]
