"""Training samples: 2 to 12 views of a scene, cropped, zoomed and recoloured, with slightly wrong poses."""

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

from backends.sweep.views import SOURCES, sources_of
from recipes.sweep.scenes import FRAMES, SceneFrames, read_scene
from vg2gt.geometry.cameras import crop_intrinsics, project, resize_intrinsics, rigid_motions, unproject
from vg2gt.metrics.kinds import pixel_kinds
from vg2gt.types import Cameras

_UPRIGHT_SHARE = 0.3  # of samples rotated by 90 degrees to portrait format
_LEAST_OVERLAP = 0.15
_WALK_STEP = math.radians(9)  # maximum median rotation between frames of a walk
_FEWER_SHARE = 0.4  # of samples whose views have fewer sources than the network would take
_ORPHAN_SHARE = 0.2  # of samples in which views, or a region of them, are matched with no source
_ALONE, _BARE = 1.0, 0.5  # added to the weight of pixels that no other view sees, and of those without texture
_SOURCE_NOISE = 0.4  # on log-scores, so that training also sees pairs other than the best
_POSE_SHARE, _TURN, _SHIFT = 0.5, 0.0015, 0.002  # share of samples with pose noise; rad; in depths
_LEAST_PIXELS = 5000  # with known depth, of four views of 80x160; samples with fewer are drawn again
_GREY_SHARE = 0.2
_DRAWS = 100


class Crop(NamedTuple):
    """Views cut from a scene, as in :class:`Sample`."""

    images: Tensor  # [V, 3, H, W] in [0, 1]
    depth: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor  # [V, 3, 3]


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


class TrainingSamples(Dataset[Sample]):
    """Random training samples. Sample n depends on ``(seed, n)`` and the files only, so that training can resume.

    Args:
        files: files of cached scenes.
        seed: seed of all random draws.
        more: files of a second kind of scenes (rooms of Infinigen).
        share: probability that a scene is drawn from ``more``, if it is not empty.
        shapes: views, image size and probability, ``((views, height, width, share), ...)``.
        any_views: share of the samples, except walks, whose views are drawn whether they overlap or not.
    """

    def __init__(
        self,
        files: Sequence[Path],
        seed: int,
        more: Sequence[Path] = (),
        share: float = 0.25,
        shapes: Sequence[Sequence[float]] = ((4, 80, 160, 1.0),),
        any_views: float = 0.0,
    ) -> None:
        self.files, self.seed = list(files), seed
        self.more, self.share, self.any_views = list(more), share if more else 0.0, any_views
        self.shapes = [(int(views), (int(height), int(width))) for views, height, width, _ in shapes]
        shares = np.array([share for *_, share in shapes])
        self.shares = shares / shares.sum()

    def __getitem__(self, index: int) -> Sample:
        rng = np.random.default_rng((self.seed, index))
        count, size = self.shapes[rng.choice(len(self.shapes), p=self.shares)]
        turns = draw_turns(rng)
        for _ in range(_DRAWS):
            files = self.more if self.share and rng.random() < self.share else self.files
            path = files[rng.integers(len(files))]
            views = choose_views(read_scene(path), count, self.any_views, rng)
            views = turn(crop(views, size, rng), turns)
            valid = views.depth[(views.depth > 0) & views.depth.isfinite()]
            if len(valid) >= _LEAST_PIXELS * views.depth.numel() / 51_200:
                return self._finish(views, valid, rng)
        raise ValueError(f"{_DRAWS} draws of {count} views, the last from {path}, have too few pixels with a depth")

    def _finish(self, views: Crop, valid: Tensor, rng: Generator) -> Sample:
        """Draws the unit of length, pose noise, sources, orphans and colours of a sample."""
        unit = math.exp(rng.normal(0, 0.5))  # random unit, so that the network cannot rely on it
        poses, depth = views.world_to_camera.clone(), views.depth * unit
        poses[:, :3, 3] *= unit
        count, size = len(poses), (depth.shape[-2], depth.shape[-1])
        cameras = Cameras(poses[None], views.intrinsics[None], size)
        kinds = pixel_kinds(views.images, torch.where(depth.isfinite(), depth, 0.0), cameras)
        alone, bare = kinds["alone"].float(), kinds["bare"].float()
        shown = torch.ones(count, 1, size[0] // 8, size[1] // 8)
        most = min(SOURCES, count - 1)
        low, middle = (float(unit * torch.quantile(valid[:: len(valid) // 4000 + 1], q)) for q in (0.01, 0.5))
        poses = with_noise(poses, min(middle, 3 * low), rng)
        if most > 1 and rng.random() < _FEWER_SHARE:
            most = int(rng.integers(1 if rng.random() < 0.3 else 2, most + 1))
        noise = torch.from_numpy(rng.normal(0, _SOURCE_NOISE, (count, count))).float()
        if rng.random() < _ORPHAN_SHARE:
            shown = _orphan(shown, rng)
        images = recolour(views.images, rng)
        sources = sources_of(poses, views.intrinsics, size, most, noise)
        hidden = 1 - shown[:, 0].repeat_interleave(8, 1).repeat_interleave(8, 2)
        weight = 1 + _ALONE * torch.maximum(alone, hidden) + _BARE * bare * (1 - hidden)
        return Sample(images, depth, poses, views.intrinsics, sources, shown, weight)


def choose_views(scene: SceneFrames, count: int, any_views: float, rng: Generator) -> Crop:
    """Draws overlapping views: from a section of a walk, or for other paths, by overlap with a random view."""
    rotations = scene.world_to_camera[:, :3, :3]
    frames = len(scene.images)
    step = np.median([_angle(*pair) for pair in pairwise(rotations)])
    if frames <= FRAMES and step < _WALK_STEP:
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
