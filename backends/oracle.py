"""Simulated foundation model: predicts ground-truth depth and cameras plus noise; needs no weights.

It behaves like a real model, so that token enhancement can be trained and measured. Depth errors are smooth in the
image plane, differ between views and lower the confidence. Tokens encode the predicted geometry, never the ground
truth, and the decoded depth changes smoothly with them.
"""

from __future__ import annotations

import hashlib
import math
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.base import Backend, seeded_initialisation
from backends.vit import PatchEmbed, ViTBlock
from vg2gt.geometry.cameras import invert_rigid, relative_to_first, unproject
from vg2gt.geometry.precision import full_precision
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.types import Cameras, Geometry, Hints, Tokens

_NOISE_GRID = (4, 8)
_SMOOTH_SHARE, _VIEW_SHARE = 0.8, 0.6  # 0.8^2 + 0.6^2 = 1
_BLEED_THRESHOLD = 0.02
_INVALID_CONFIDENCE = 1e-3
CELLS = 2  # the depth residual has CELLS x CELLS values per patch
_WAVELENGTHS = (1.0, 0.5, 0.25)  # of the position encoding of patches, in median depths
_GEOMETRY_CHANNELS = CELLS * CELLS + 1 + 3 + 3 + 3 + 6 * len(_WAVELENGTHS)


class OracleBackend(Backend):
    """Simulated VFM (needs hints).

    Depth is ``gt * (1 + depth_noise * (0.8 s + 0.6 c))``, where s is a smooth field of unit deviation (bicubic from 4x8
    normal values) and c is one normal value per view. It is then blurred at depth edges, as in decoded depth.
    Confidence is 1 plus ``4 exp(-|relative error| / max(depth_noise, 0.01))`` times log-normal noise. Standard
    deviations of the camera errors, per axis, are ``0.5 * pose_noise`` rad for rotations and ``pose_noise`` median
    depths of the view for positions; view 0 is exact. The noise of a view is seeded by (seed, scene, frame) and does
    not depend on the order and number of views.

    Tokens concatenate the image features of a small frozen random ViT with the predicted geometry of the patch, and mix
    the channels by a fixed rotation. ``decode`` multiplies depth by ``exp(response * u)``, where u is a fixed random
    projection of the token change, averaged over the taps and upsampled bicubically. A change with independent
    unit-variance channels gives u about unit variance.

    Args:
        patch_size: edge of a patch in pixels.
        dim: channels of a token; a multiple of 4 and at least twice the 32 geometry channels.
        taps: number of tapped layers.
        depth_noise: standard deviation of the relative depth error.
        pose_noise: see above; None means ``0.1 * depth_noise``.
        response: change of log-depth per unit change of the tokens.
        seed: seed of the noise and of the frozen weights.

    Raises:
        ValueError: if ``dim`` does not fit, or a noise level is negative.
    """

    needs_depth: ClassVar[bool] = True

    def __init__(
        self,
        patch_size: int = 14,
        dim: int = 64,
        taps: int = 4,
        depth_noise: float = 0.02,
        pose_noise: float | None = None,
        response: float = 0.02,
        seed: int = 0,
    ) -> None:
        pose_noise = 0.1 * depth_noise if pose_noise is None else pose_noise
        if dim < 2 * _GEOMETRY_CHANNELS or dim % 4:
            raise ValueError(f"backend.dim must be a multiple of 4 and at least {2 * _GEOMETRY_CHANNELS}, got {dim}")
        if depth_noise < 0 or pose_noise < 0:
            raise ValueError(f"noise must not be negative: depth_noise {depth_noise}, pose_noise {pose_noise}")
        super().__init__("oracle", patch_size, (dim,) * taps, licence="Apache-2.0 (no weights)", needs_hints=True)
        self.depth_noise = depth_noise
        self.pose_noise = pose_noise
        self.response = response
        self.seed = seed
        image_dim = dim - _GEOMETRY_CHANNELS
        with seeded_initialisation(seed):
            self.patch_embed = PatchEmbed(patch_size, image_dim)
            self.blocks = nn.ModuleList(ViTBlock(image_dim, 4) for _ in range(taps))
            self.camera_projection = nn.Linear(16 + 4, dim)
            mixing = torch.stack([torch.linalg.qr(torch.randn(dim, dim))[0] for _ in range(taps)])
            readout = torch.randn(taps, dim, CELLS * CELLS) / math.sqrt(dim / taps)
        self.mixing = nn.Parameter(mixing)
        self.readout = nn.Parameter(readout)
        self.freeze()
        # Do not hash the weights: the last bits of a QR decomposition depend on the machine and number of threads.
        made_of = f"oracle {patch_size} {dim} {taps} {seed}"
        self._identity = {"name": self.name, "weights": hashlib.sha256(made_of.encode()).hexdigest()}

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """Simulates the backbone; see :meth:`Backend.encode`. The world frame is that of view 0, in the data's unit."""
        hints, depth, cameras = self._checked(images, hints)
        height, width = images.shape[-2:]
        grid = (height // self.patch_size, width // self.patch_size)
        with full_precision(images):
            images, depth = images.float(), depth.float()
            relative, poses, doubt = self._draw(hints, (height, width), depth)
            cameras = self._predict_cameras(cameras, depth, poses)
            predicted = _bleed(depth * (1 + self.depth_noise * relative))
            error = (predicted / depth.clamp_min(1e-6) - 1).abs()
            confidence = 1 + 4 * torch.exp(-error / max(self.depth_noise, 0.01)) * torch.exp(0.3 * doubt)
            confidence = torch.where(depth > 0, confidence, _INVALID_CONFIDENCE)
            geometry = _describe_patches(predicted, confidence, cameras, grid)
            patch = self._tokens(images, geometry)
            camera = self.camera_projection(_describe_cameras(cameras, _median_depth(predicted)))
        state = {"patch": patch, "depth": predicted, "confidence": confidence, "cameras": cameras}
        return Tokens(patch, camera, grid, (height, width), state)

    def decode(self, tokens: Tokens) -> Geometry:
        """Decodes token changes as a smooth log-depth residual; see :meth:`Backend.decode`."""
        depth, cameras = tokens.state["depth"], tokens.state["cameras"]
        rows, columns = tokens.grid
        with full_precision(depth):
            changes = [
                (patch.float() - before) @ readout
                for patch, before, readout in zip(tokens.patch, tokens.state["patch"], self.readout, strict=True)
            ]
            cells = torch.stack(changes).mean(0).flatten(0, 1).transpose(1, 2).unflatten(-1, (rows, columns))
            residual = F.interpolate(F.pixel_shuffle(cells, CELLS), tokens.size, mode="bicubic", align_corners=False)
            depth = depth * torch.exp(self.response * residual.reshape(depth.shape))
        return Geometry(depth, tokens.state["confidence"], cameras, torch.ones_like(depth[:, 0, 0, 0]))

    @torch.no_grad()
    def predict_cameras(self, images: Tensor, hints: Hints | None = None) -> Cameras:
        """See :meth:`Backend.predict_cameras`; makes neither tokens nor depth."""
        hints, depth, cameras = self._checked(images, hints)
        with full_precision(images):
            depth = depth.float()
            poses = self._noise(hints, (_NOISE_GRID, (1, 1), (6,)), depth)[2]
            return self._predict_cameras(cameras, depth, poses)

    def _checked(self, images: Tensor, hints: Hints | None) -> tuple[Hints, Tensor, Cameras]:
        """Returns the hints, their depth and their cameras if they are there for all images."""
        self.check_images(images)
        hints = self.require_hints(images, hints, "depth", "cameras", "scene_key", "frame_ids")
        assert hints.depth is not None
        assert hints.cameras is not None
        return hints, hints.depth, hints.cameras

    def _draw(self, hints: Hints, size: tuple[int, int], like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unit noise of depth ``[B, V, H, W]``, cameras ``[B, V, 6]`` and confidence ``[B, V, H, W]``."""
        fields, constants, poses, doubt = self._noise(hints, (_NOISE_GRID, (1, 1), (6,), size), like)
        smooth = F.interpolate(fields, size, mode="bicubic", align_corners=True)
        smooth = smooth / smooth.std((-2, -1), keepdim=True)
        return _SMOOTH_SHARE * smooth + _VIEW_SHARE * constants, poses, doubt

    def _noise(self, hints: Hints, shapes: tuple[tuple[int, ...], ...], like: Tensor) -> list[Tensor]:
        """Draws ``[B, V, *shape]`` of every shape, in this order, from one generator per view."""
        assert hints.frame_ids is not None
        named = zip(hints.scene_key, hints.frame_ids.tolist(), strict=True)
        names = [f"{self.seed}/{scene}/{frame}" for scene, frames in named for frame in frames]
        digests = [hashlib.sha256(name.encode()).digest() for name in names]
        rngs = [np.random.default_rng(int.from_bytes(digest, "big")) for digest in digests]
        views = [[rng.standard_normal(shape, dtype=np.float32) for shape in shapes] for rng in rngs]
        parts = zip(*views, strict=True)
        return [torch.from_numpy(np.stack(part)).to(like).unflatten(0, like.shape[:2]) for part in parts]

    def _predict_cameras(self, cameras: Cameras, depth: Tensor, pose_noise: Tensor) -> Cameras:
        """Perturbs every camera but the first in its own frame; the world frame becomes that of view 0."""
        half = self.pose_noise * 0.5 * pose_noise[..., :3] / 2
        quats = torch.cat((torch.ones_like(half[..., :1]), half), -1)  # small angles: tan(x) = x
        identity = torch.eye(4, dtype=depth.dtype, device=depth.device)
        error = identity.repeat(*depth.shape[:2], 1, 1)
        error[..., :3, :3] = quat_to_matrix(quats)
        error[..., :3, 3] = self.pose_noise * pose_noise[..., 3:] * _median_depth(depth, per_view=True)[..., None]
        error[:, 0] = identity
        exact = relative_to_first(cameras.map(Tensor.double)).map(Tensor.float)
        return Cameras(invert_rigid(error) @ exact.world_to_camera, exact.intrinsics, exact.size)

    def _tokens(self, images: Tensor, geometry: Tensor) -> tuple[Tensor, ...]:
        """Mixes the image features of every tapped block with the geometry ``[B, V, P, 32]``."""
        features = self.patch_embed((images.flatten(0, 1) - 0.5) * 4)
        tokens = []
        for block, mixing in zip(self.blocks, self.mixing, strict=True):
            features = block(features)
            content = F.layer_norm(features, features.shape[-1:]).unflatten(0, images.shape[:2])
            tokens.append(torch.cat((content, geometry), -1) @ mixing)
        return tuple(tokens)


def _median_depth(depth: Tensor, per_view: bool = False) -> Tensor:
    """Median of the valid depth ``[B, V, H, W]`` per scene ``[B]`` or view ``[B, V]``; 1 if none is valid."""
    flat = depth.flatten(2 if per_view else 1)
    median = torch.where(flat > 0, flat, torch.nan).nanmedian(-1).values
    return median.nan_to_num(1.0)


def _bleed(depth: Tensor) -> Tensor:
    """Blurs depth edges: averages ``[B, V, H, W]`` with its 3x3 mean where they differ by more than 2 %."""
    padded = F.pad(depth, (1, 1, 1, 1), mode="replicate")
    share = F.avg_pool2d((padded > 0).to(depth), 3, 1)
    mean = F.avg_pool2d(padded, 3, 1) / share.clamp_min(1e-6)
    soft = (mean - depth).abs() > _BLEED_THRESHOLD * depth
    return torch.where(soft & (depth > 0), (depth + mean) / 2, depth)


def _describe_patches(depth: Tensor, confidence: Tensor, cameras: Cameras, grid: tuple[int, int]) -> Tensor:
    """Geometry that the simulated network predicts per patch, ``[B, V, P, 32]``, channels of order one.

    Channels: log-depth of 2x2 cells, log-confidence, position, ray direction and camera position of the patch, and
    sines and cosines of its position. Lengths are in median depths of the scene.
    """
    unit = _median_depth(depth)[:, None, None, None]
    cells = (grid[0] * CELLS, grid[1] * CELLS)
    valid = (depth > 0).to(depth)
    share = F.adaptive_avg_pool2d(valid, cells)
    log_depth = F.adaptive_avg_pool2d(torch.where(depth > 0, depth / unit, 1.0).log(), cells) / share.clamp_min(1e-6)
    log_depth = F.pixel_unshuffle(log_depth.flatten(0, 1)[:, None], CELLS)
    log_confidence = F.adaptive_avg_pool2d(confidence.log(), grid).flatten(0, 1)[:, None]

    points = unproject(depth, cameras) / unit[..., None]
    centers = invert_rigid(cameras.world_to_camera)[..., :3, 3] / unit[..., 0]
    weighted = (points * valid[..., None]).permute(0, 1, 4, 2, 3).flatten(0, 1)
    weight = F.adaptive_avg_pool2d(valid, grid).flatten(0, 1)[:, None]
    place = F.adaptive_avg_pool2d(weighted, grid) / weight.clamp_min(1e-6)
    centers = centers.flatten(0, 1)[..., None, None].expand_as(place)
    ray = F.normalize(place - centers, dim=1)
    phases = [2 * math.pi / wavelength * place for wavelength in _WAVELENGTHS]
    waves = [wave for phase in phases for wave in (phase.sin(), phase.cos())]
    described = torch.cat((log_depth, log_confidence, place, ray, centers, *waves), 1)
    described = torch.where(weight > 0, described, 0.0)
    return described.flatten(2).transpose(1, 2).unflatten(0, depth.shape[:2])


def _describe_cameras(cameras: Cameras, unit: Tensor) -> Tensor:
    """Pose and intrinsics as ``[B, V, 20]``, channels of order one."""
    poses = cameras.world_to_camera.clone()
    poses[..., :3, 3] /= unit[:, None, None]
    intrinsics = cameras.intrinsics[..., :2, :] / max(cameras.size)
    return torch.cat((poses.flatten(2), intrinsics[..., [0, 1, 0, 1], [0, 1, 2, 2]]), -1)
