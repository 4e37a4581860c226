"""Training samples of the cascade: 2 to 12 views, some of them matched with no other view, and weights of pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor
from torch.utils.data import Dataset

from backends.cascade.planes import COARSE_SOURCES, coarse_sources
from recipes.sweep import samples as views_of
from recipes.sweep.scenes import read_scene
from vg2gt.metrics.kinds import pixel_kinds
from vg2gt.types import Cameras

_FEWER_SHARE = 0.4  # of samples whose views have fewer sources than the network would take
_ORPHAN_SHARE = 0.2  # of samples in which views, or a region of them, are matched with no source
_ALONE, _BARE = 1.0, 0.5  # added to the weight of pixels that no other view sees, and of those without texture


class Sample(NamedTuple):
    """V views of one scene.

    Attributes:
        images: ``[V, 3, H, W]`` in [0, 1].
        depth: ground-truth depth ``[V, H, W]``; 0 is unknown, infinity is sky.
        world_to_camera: ``[V, 4, 4]``, with realistic noise in some samples.
        intrinsics: ``[V, 3, 3]`` in pixels.
        sources: indices of the source views of each view ``[V, n]``.
        shown: 0 where a view is matched with no source, else 1, ``[V, 1, H / 8, W / 8]``.
        weight: weight of the pixels in the objective ``[V, H, W]``.
    """

    images: Tensor
    depth: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    sources: Tensor
    shown: Tensor
    weight: Tensor


class CascadeSamples(Dataset[Sample]):
    """Random training samples. Sample n depends on ``(seed, n)`` and the files only, so that training can resume.

    Args:
        files: files of cached scenes.
        seed: seed of all random draws.
        more: files of a second kind of scenes (rooms of Infinigen).
        share: probability that a scene is drawn from ``more``, if it is not empty.
        shapes: views, image size and probability, ``((views, height, width, share), ...)``.
        any_views: share of the samples, except walks, whose views are drawn whether they overlap or not.
        plain: whether colours, poses, sources and views stay as they are (validation).
    """

    def __init__(
        self,
        files: Sequence[Path],
        seed: int,
        more: Sequence[Path] = (),
        share: float = 0.25,
        shapes: Sequence[Sequence[float]] = ((4, 80, 160, 1.0),),
        any_views: float = 0.0,
        plain: bool = False,
    ) -> None:
        self.files, self.seed, self.plain = list(files), seed, plain
        self.more, self.share, self.any_views = list(more), share if more else 0.0, any_views
        self.shapes = [(int(views), (int(height), int(width))) for views, height, width, _ in shapes]
        shares = np.array([share for *_, share in shapes])
        self.shares = shares / shares.sum()

    def __getitem__(self, index: int) -> Sample:
        rng = np.random.default_rng((self.seed, index))
        count, size = self.shapes[rng.choice(len(self.shapes), p=self.shares)]
        turns = views_of.draw_turns(rng)
        while True:
            files = self.more if self.share and rng.random() < self.share else self.files
            path = files[rng.integers(len(files))]
            views = views_of.choose_views(read_scene(path), count, self.any_views, rng)
            views = views_of.turn(views_of.crop(views, size, rng), 0 if self.plain else turns)
            valid = views.depth[(views.depth > 0) & views.depth.isfinite()]
            if len(valid) >= views_of.LEAST_PIXELS * views.depth.numel() / 51_200:
                return self._finish(views, valid, rng)

    def _finish(self, views: views_of.Crop, valid: Tensor, rng: Generator) -> Sample:
        """Draws the unit of length, pose noise, sources, orphans and colours of a sample."""
        unit = math.exp(rng.normal(0, 0.5))  # random unit, so that the network cannot rely on it
        poses, depth = views.world_to_camera.clone(), views.depth * unit
        poses[:, :3, 3] *= unit
        count, size = len(poses), (depth.shape[-2], depth.shape[-1])
        cameras = Cameras(poses[None], views.intrinsics[None], size)
        kinds = pixel_kinds(views.images, torch.where(depth.isfinite(), depth, 0.0), cameras)
        alone, bare = kinds["alone"].float(), kinds["bare"].float()
        shown = torch.ones(count, 1, size[0] // 8, size[1] // 8)
        most, noise = min(COARSE_SOURCES, count - 1), None
        images = views.images
        if not self.plain:
            low, middle = (float(unit * torch.quantile(valid[:: len(valid) // 4000 + 1], q)) for q in (0.01, 0.5))
            poses = views_of.with_noise(poses, min(middle, 3 * low), rng)
            if most > 1 and rng.random() < _FEWER_SHARE:
                most = int(rng.integers(1 if rng.random() < 0.3 else 2, most + 1))
            noise = torch.from_numpy(rng.normal(0, views_of.SOURCE_NOISE, (count, count))).float()
            if rng.random() < _ORPHAN_SHARE:
                shown = _orphan(shown, rng)
            images = views_of.recolour(images, rng)
        sources = coarse_sources(poses, views.intrinsics, size, most, noise)
        hidden = 1 - shown[:, 0].repeat_interleave(8, 1).repeat_interleave(8, 2)
        weight = 1 + _ALONE * torch.maximum(alone, hidden) + _BARE * bare * (1 - hidden)
        return Sample(images, depth, poses, views.intrinsics, sources, shown, weight)


def _orphan(shown: Tensor, rng: Generator) -> Tensor:
    """Hides the sources of one or two views, or of a region of each view."""
    views, _, height, width = shown.shape
    shown = shown.clone()
    if rng.random() < 0.5:
        shown[rng.permutation(views)[: 1 + int(views > 3 and rng.random() < 0.4)]] = 0
        return shown
    for view in range(views):
        if rng.random() < 0.6:
            rows, columns = (max(1, int(n * rng.uniform(0.25, 0.8))) for n in (height, width))
            top, left = int(rng.integers(0, height - rows + 1)), int(rng.integers(0, width - columns + 1))
            shown[view, :, top : top + rows, left : left + columns] = 0
    return shown
