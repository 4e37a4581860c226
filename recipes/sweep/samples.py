"""Training samples: overlapping views of a scene, cropped, zoomed and recoloured, with slightly wrong poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from kornia.filters import gaussian_blur2d
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import Dataset

from backends.sweep.views import choose_sources
from recipes.sweep.scenes import SceneFrames, is_room, read_scene
from vg2gt.geometry.cameras import crop_intrinsics, project, resize_intrinsics, rigid_motions, unproject
from vg2gt.types import Cameras

_UPRIGHT_SHARE = 0.3  # of samples rotated by 90 degrees to portrait format
_CUT_SHARE = 0.25  # of samples whose planes do not cover the whole depth of the scene
# Range of the depth quantile at which they end; higher indoors, where walls are near.
_CUT, _CUT_INDOORS = (0.5, 0.98), (0.85, 0.98)
_LEAST_OVERLAP = 0.15
_WALK_FRAMES, _WALK_STEP = 14, math.radians(9)  # maximum frames and median rotation between frames of a walk
_PLANES = (32, 48)  # few sizes, as convolutions on CPUs are compiled for each
_SOURCES, _SOURCE_SHARES = (2, 3), (0.7, 0.3)
SOURCE_NOISE = 0.4  # on log-scores, so that training also sees pairs other than the best
_POSE_SHARE, _TURN, _SHIFT = 0.5, 0.0015, 0.002  # share of samples with pose noise; rad; in depths
LEAST_PIXELS = 5000  # with known depth, of four views of 80x160; samples with fewer are drawn again
_GREY_SHARE = 0.2


class Sample(NamedTuple):
    """V views of one or more scenes, with the configuration of the sweep.

    Attributes:
        images: ``[V, 3, H, W]`` in [0, 1].
        depth: ground-truth depth ``[V, H, W]``; 0 is unknown, infinity is sky.
        world_to_camera: ``[V, 4, 4]``, with realistic noise in some samples.
        intrinsics: ``[V, 3, 3]`` in pixels.
        depth_range: near and far of the planes ``[V, 2]``.
        sources: indices of the source views of each view ``[V, n]``.
        planes: number of planes.
        scenes: number of scenes, with the same number of views each.
    """

    images: Tensor
    depth: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    depth_range: Tensor
    sources: Tensor
    planes: int = 0
    scenes: int = 1


class TrainingSamples(Dataset[Sample]):
    """Random training samples. Sample n depends on ``(seed, n)`` only, so that training can resume.

    Args:
        files: files of cached scenes.
        count: number of samples.
        seed: seed of all random draws.
        more: files of a second kind of scenes (rooms of Infinigen).
        share: probability that a scene is drawn from ``more``, if it is not empty.
        scenes: number of scenes per sample.
        views: number of views per scene.
        sizes: image sizes and their probabilities, ``((height, width, share), ...)``.
        any_views: share of the samples, except walks, whose views are drawn whether they overlap or not.
    """

    def __init__(
        self,
        files: Sequence[Path],
        count: int,
        seed: int,
        more: Sequence[Path] = (),
        share: float = 0.25,
        scenes: int = 1,
        views: int = 4,
        sizes: Sequence[Sequence[float]] = ((80, 160, 1.0),),
        any_views: float = 0.0,
    ) -> None:
        self.files, self.count, self.seed = list(files), count, seed
        self.more, self.share = list(more), share if more else 0.0
        self.scenes, self.views, self.any_views = scenes, views, any_views
        self.sizes = [(int(height), int(width)) for height, width, _ in sizes]
        shares = np.array([share for *_, share in sizes])
        self.shares = shares / shares.sum()

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Sample:
        rng = np.random.default_rng((self.seed, index))
        # equal for all scenes of a sample, so that they can be concatenated
        size = self.sizes[rng.choice(len(self.sizes), p=self.shares)]
        turns = draw_turns(rng)
        planes, sources = int(rng.choice(_PLANES)), int(rng.choice(_SOURCES, p=_SOURCE_SHARES))
        parts = [self._scene(size, turns, sources, rng) for _ in range(self.scenes)]
        parts = [part._replace(sources=part.sources + n * self.views) for n, part in enumerate(parts)]
        joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in Sample._fields[:6]}
        return Sample(**joined, planes=planes, scenes=self.scenes)

    def _scene(self, size: tuple[int, int], turns: int, sources: int, rng: Generator) -> Sample:
        while True:
            files = self.more if self.share and rng.random() < self.share else self.files
            path = files[rng.integers(len(files))]
            views = choose_views(read_scene(path), self.views, self.any_views, rng)
            views = turn(crop(views, size, rng), turns)
            valid = views.depth[(views.depth > 0) & views.depth.isfinite()]
            if len(valid) >= LEAST_PIXELS:
                return _finish(views, valid, _CUT_INDOORS if is_room(path) else _CUT, sources, rng)


class Crop(NamedTuple):
    """Views cut from a scene, as in :class:`Sample`."""

    images: Tensor  # [V, 3, H, W] in [0, 1]
    depth: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor  # [V, 3, 3]


def choose_views(scene: SceneFrames, count: int, any_views: float, rng: Generator) -> Crop:
    """Draws overlapping views: from a section of a walk, or for other paths, by overlap with a random view."""
    rotations = scene.world_to_camera[:, :3, :3]
    frames = len(scene.images)
    step = np.median([_angle(*pair) for pair in pairwise(rotations)])
    if frames <= _WALK_FRAMES and step < _WALK_STEP:
        field = 2 * math.atan(0.5 * scene.images.shape[2] / float(scene.intrinsics[0, 0, 0]))
        most = field * rng.uniform(0.3, 1.1)
        first = int(rng.integers(0, frames - count + 1))
        end = first + count
        while end < frames and _angle(rotations[first], rotations[end]) < most:
            end += 1
        rows = np.sort(first + rng.permutation(end - first)[:count])
    else:
        rows = _overlapping(scene, count, any_views, rng)
    images = scene.images[rows].permute(0, 3, 1, 2).float() / 255
    return Crop(images, scene.depth[rows].float(), scene.world_to_camera[rows], scene.intrinsics[rows])


def _overlapping(scene: SceneFrames, count: int, any_views: float, rng: Generator) -> NDArray[np.int64]:
    """Draws a random view, and others with a probability that increases with their overlap, or any others."""
    first = int(rng.integers(len(scene.images)))
    height, width = scene.depth.shape[-2:]
    cameras = Cameras(scene.world_to_camera[None], scene.intrinsics[None], (height, width))
    depth = scene.depth[first].float()
    # sample points of the first view: [P, 3]
    points = unproject(depth.nan_to_num(posinf=0)[None, None], cameras.select(slice(first, first + 1)))[0, 0]
    points = points[6::12, 6::12][(depth > 0)[6::12, 6::12] & depth.isfinite()[6::12, 6::12]]  # [P, 3]
    # share of them that is visible in each view: [N]
    pixels, z = project(points[None, None].expand(1, len(scene.images), -1, -1), cameras)
    u, v, z = pixels[0, ..., 0].round().long(), pixels[0, ..., 1].round().long(), z[0]
    inside = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    rows = torch.arange(len(u))[:, None]
    there = scene.depth[rows, v.clamp(0, height - 1), u.clamp(0, width - 1)].float()
    overlap = (inside & (z < 1.05 * there)).float().mean(1).numpy() if len(points) else np.ones(len(u))
    likely = np.maximum(overlap, 1e-3) ** rng.uniform(0, 2) * np.where(overlap > _LEAST_OVERLAP, 1.0, 1e-4)
    if any_views and rng.random() < any_views:
        likely = np.ones(len(likely))
    likely[first] = 0
    return np.append(first, rng.choice(len(likely), count - 1, replace=False, p=likely / likely.sum()))


def _angle(first: Tensor, second: Tensor) -> float:
    cosine = (float((first * second).sum()) - 1) / 2
    return math.acos(max(-1.0, min(1.0, cosine)))


def crop(views: Crop, target: tuple[int, int], rng: Generator) -> Crop:
    """Crops all views to one random window and resizes them to ``target`` (height, width); mirrors half the samples."""
    height, width = views.depth.shape[-2:]
    most = min(height / target[0], width / target[1])
    zoom = math.exp(rng.uniform(math.log(min(0.8, most)), math.log(most)))
    rows, columns = int(target[0] * zoom), int(target[1] * zoom)
    top, left = int(rng.integers(0, height - rows + 1)), int(rng.integers(0, width - columns + 1))
    window = (..., slice(top, top + rows), slice(left, left + columns))
    images = F.interpolate(views.images[window], target, mode="bilinear", align_corners=False, antialias=True)
    depth = F.interpolate(views.depth[window][:, None], target, mode="nearest-exact")[:, 0]
    intrinsics = crop_intrinsics(views.intrinsics, left, top)
    intrinsics = resize_intrinsics(intrinsics, target[1] / columns, target[0] / rows)
    poses = views.world_to_camera
    if rng.random() < 0.5:
        images, depth = images.flip(-1), depth.flip(-1)
        intrinsics[:, 0, 2] = target[1] - 1 - intrinsics[:, 0, 2]
        mirror = torch.diag(torch.tensor([-1.0, 1, 1, 1]))
        poses = mirror @ poses @ mirror
    return Crop(images.clamp(0, 1), depth, poses.clone(), intrinsics)


def draw_turns(rng: Generator) -> int:
    """Draws how often a sample is turned (:func:`turn`)."""
    return int(rng.choice(4, p=(1 - _UPRIGHT_SHARE, _UPRIGHT_SHARE / 2, 0, _UPRIGHT_SHARE / 2)))


def turn(views: Crop, turns: int) -> Crop:
    """Rotates all views by 90 degrees to the left, ``turns`` times."""
    images, depth, poses, intrinsics = views
    turn = torch.tensor([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for _ in range(turns):
        turned = torch.zeros_like(intrinsics)  # pixel (x, y) moves to (y, W - 1 - x)
        turned[:, 0, 0], turned[:, 1, 1], turned[:, 2, 2] = intrinsics[:, 1, 1], intrinsics[:, 0, 0], 1.0
        turned[:, 0, 2], turned[:, 1, 2] = intrinsics[:, 1, 2], images.shape[-1] - 1 - intrinsics[:, 0, 2]
        images, depth = images.rot90(1, (-2, -1)), depth.rot90(1, (-2, -1))
        poses, intrinsics = turn @ poses, turned
    return Crop(images.contiguous(), depth.contiguous(), poses, intrinsics)


def _finish(views: Crop, valid: Tensor, cut: tuple[float, float], sources: int, rng: Generator) -> Sample:
    """Draws the unit of length, the range of the planes, pose noise, sources and colours of a sample.

    The range contains the true one, except in some samples whose planes end at a depth quantile within ``cut``.
    """
    unit = math.exp(rng.normal(0, 0.5))  # random unit, so that the network cannot rely on it
    poses, depth = views.world_to_camera.clone(), views.depth * unit
    poses[:, :3, 3] *= unit
    some = valid[:: max(len(valid) // 4000, 1)]
    low, middle, high = (float(unit * torch.quantile(some, q)) for q in (0.01, 0.5, 0.99))
    if rng.random() < _CUT_SHARE:  # as when structure from motion finds no points in the background
        high = float(unit * torch.quantile(some, rng.uniform(*cut)))
    near = low * math.exp(-(rng.uniform(0.02, 0.5) if rng.random() < 0.75 else rng.uniform(0, 1.8)))
    far = high * math.exp(rng.uniform(0, 0.6) if rng.random() < 0.75 else rng.uniform(0, 2.5))
    poses = with_noise(poses, min(middle, 3 * low), rng)
    depth_range, size = torch.tensor([near, far]), (depth.shape[-2], depth.shape[-1])
    noise = torch.from_numpy(rng.normal(0, SOURCE_NOISE, (len(poses), len(poses)))).float()
    chosen = choose_sources(poses, views.intrinsics, size, depth_range, sources, noise)
    look = recolour(views.images, rng)
    return Sample(look, depth, poses, views.intrinsics, depth_range.expand(len(poses), 2), chosen)


def with_noise(poses: Tensor, unit: float, rng: Generator) -> Tensor:
    """Adds realistic noise to poses ``[V, 4, 4]`` in some samples; shifts are relative to ``unit``."""
    if rng.random() >= _POSE_SHARE:
        return poses
    turns = torch.from_numpy(rng.normal(0, _TURN, (len(poses), 3))).float()
    shifts = torch.from_numpy(rng.normal(0, _SHIFT * unit, (len(poses), 3))).float()
    return rigid_motions(turns, shifts) @ poses


def recolour(images: Tensor, rng: Generator) -> Tensor:
    """Augments views ``[V, 3, H, W]`` with colour mixing, contrast, gamma, exposure, white balance, blur and noise.

    Exposure, white balance and blur differ between views; the other changes are common to all.
    """
    mixing = torch.eye(3)
    if rng.random() < 0.6:
        mixing = mixing + torch.from_numpy(rng.normal(0, 0.12, (3, 3))).float()
    if rng.random() < _GREY_SHARE:
        mixing = torch.full((3, 3), 0.3) + 0.1 * mixing
    images = torch.einsum("ij,vjhw->vihw", mixing, images).clamp(1e-3, 1)
    mean = images.mean()
    images = (mean + (images - mean) * rng.uniform(0.45, 1.25)) * rng.uniform(0.5, 1.3)
    images = images.clamp(1e-3, 1) ** math.exp(rng.uniform(-0.6, 0.6))
    views = len(images)
    if rng.random() < 0.6:
        exposure = rng.normal(1, 0.07, (views, 1, 1, 1)) * rng.normal(1, 0.02, (views, 3, 1, 1))
        images = images * torch.from_numpy(exposure).float()
        images = images + torch.from_numpy(rng.normal(0, 0.015, (views, 1, 1, 1))).float()
    if rng.random() < 0.35:
        deviation = rng.uniform(0.4, 1.1)
        blurred = gaussian_blur2d(images, 5, (deviation, deviation), separable=False)
        chosen = torch.from_numpy(rng.random(views) < rng.uniform(0.3, 1.0))
        images = torch.where(chosen[:, None, None, None], blurred, images)
    if rng.random() < 0.7:
        noise = torch.from_numpy(rng.standard_normal(tuple(images.shape), dtype=np.float32)) * rng.uniform(0, 0.025)
        if rng.random() < 0.5:  # correlated, as after denoising in a camera
            noise = 2 * F.avg_pool2d(noise, 3, 1, 1)
        images = images + noise
    return images.clamp(0, 1)
