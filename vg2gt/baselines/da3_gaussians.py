"""Depth Anything 3's own Gaussians, one per pixel, without training (paper, Baselines, "DA3")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.base import Backend
from backends.da3 import DA3Backend
from backends.dpt import DPT
from backends.network import normalize_images
from vg2gt.baselines.pixels import SMALLEST_FOOTPRINT, PixelReconstructor, Pixels, ReadViews
from vg2gt.geometry.precision import full_precision
from vg2gt.geometry.rotations import matrix_to_quat, multiply_quats
from vg2gt.method.gaussian_head import harmonic_gains
from vg2gt.model import Background, SceneScale
from vg2gt.types import Cameras, Gaussians, Geometry, Hints, Tokens
from vg2gt.visibility import ViewCheck

MIN_SCALE, MAX_SCALE = 1e-5, 30.0  # in _SCALE_UNIT times the sum of a pixel's sides
_SCALE_UNIT = 0.1
_SH_DEGREE = 2
PARTS = (2, 3, 4, 3 * (_SH_DEGREE + 1) ** 2, 1, 1)


class GaussianHead(DPT):
    """A DPT that adds image features to its fused map; names, shapes and arguments as published (``gs_head``)."""

    def __init__(self, token_dim: int, features: int, out_channels: Sequence[int], patch_size: int) -> None:
        super().__init__(token_dim, features, out_channels, sum(PARTS), patch_size, normalize=False)
        width = features // 2
        layers: list[nn.Module] = []
        for inside, outside in ((3, width // 4), (width // 4, width // 2), (width // 2, width)):
            layers += [nn.Conv2d(inside, outside, 3, padding=1), nn.GELU()]
        self.images_merger = nn.Sequential(*layers)

    @torch.no_grad()
    def predict(self, tokens: Tokens, images: Tensor, chunk: int | None) -> Tensor:
        """Predicts raw Gaussians ``[B, V, H, W, sum(PARTS)]`` of images, at most ``chunk`` views (None: all) at a time.

        Per pixel: offset in pixels, logits of the scales, quaternion (xyzw, in camera axes), SH coefficients (channel
        by channel, in camera axes), depth offset, logit of the opacity.
        """
        taps = [tap.flatten(0, 1) for tap in tokens.patch]
        with full_precision(images):
            parts = []
            for views in torch.arange(len(taps[0]), device=images.device).split(chunk or len(taps[0])):
                fused = self.fuse([tap[views] for tap in taps], tokens.grid)
                merged = fused + self.images_merger(normalize_images(images).flatten(0, 1)[views])
                parts.append(self.scratch.get_submodule("output_conv2")(merged))
        return torch.cat(parts).unflatten(0, images.shape[:2]).permute(0, 1, 3, 4, 2)


class DA3Gaussians(PixelReconstructor):
    """Gaussians of DA3's ``gs_head``, with the weights of the backend's checkpoint.

    The head expects cameras with the principal point at the image centre, half a pixel from DA3's cameras for depth.
    :meth:`run_backbone` and :meth:`predict_cameras` return such cameras. See :class:`vg2gt.model.Reconstructor` for the
    other arguments.

    Args:
        backend: DA3 with a Gaussian head: GIANT, or random weights.

    Raises:
        ValueError: if the backend has no Gaussian head.
    """

    backend: DA3Backend

    def __init__(
        self,
        backend: Backend,
        scale: SceneScale,
        background: Background = "black",
        visibility: ViewCheck | None = None,
    ) -> None:
        if not isinstance(backend, DA3Backend):
            raise ValueError(f"model=da3_gs requires backend=da3_giant, got {backend.name}")
        super().__init__(backend, scale, background, visibility)
        # from the same file as the backbone; only that of GIANT has one
        weights = replace(backend.weights, prefix=f"{backend.weights.prefix}gs_head.", ignorable=("",))
        try:
            self.head = weights.build(lambda: GaussianHead(**backend.network.arguments)).requires_grad_(False)
        except ValueError as error:
            raise ValueError(f"backend {backend.name} has no Gaussian head, da3_giant has one: {error}") from error

    def run_backbone(self, images: Tensor, hints: Hints | None) -> tuple[Tokens, Geometry]:
        """See :meth:`vg2gt.model.Reconstructor.run_backbone`."""
        tokens, geometry = super().run_backbone(images, hints)
        return tokens, replace(geometry, cameras=_centred(geometry.cameras))

    def predict_cameras(self, images: Tensor, hints: Hints | None) -> Cameras:
        """See :meth:`vg2gt.model.Reconstructor.predict_cameras`."""
        return _centred(super().predict_cameras(images, hints))

    def features(self, tokens: Tokens, images: Tensor) -> Tensor:
        """Runs the Gaussian head."""
        return self.head.predict(tokens, images, self.backend.head_chunk).flatten(0, 3)

    @torch.no_grad()
    def make_gaussians(self, features: Tensor, pixels: Pixels, views: ReadViews) -> Gaussians:
        """Returns one Gaussian per pixel."""
        tokens, geometry, unit = views
        own = self.backend.decode_cameras(tokens).world_to_camera[..., :3, :3].mT.flatten(0, 1)
        frame = geometry.cameras.world_to_camera[..., :3, :3].mT.flatten(0, 1) @ own.mT
        return place(features, pixels, unit, matrix_to_quat(own), matrix_to_quat(frame))


def place(raw: Tensor, pixels: Pixels, unit: Tensor, own: Tensor, frame: Tensor) -> Gaussians:
    """Converts raw head outputs to Gaussians of the scene.

    Args:
        raw: ``[N, sum(PARTS)]``, see :meth:`GaussianHead.predict`.
        pixels: the same N pixels.
        unit: ``[B]`` scene units per unit of the network.
        own: ``[B * V, 4]`` camera-to-world quaternions predicted by the network.
        frame: ``[B * V, 4]`` quaternions from the network's world to the scene.
    """
    shift, scale, rotation, color, change, opacity = raw.split(PARTS, -1)
    depth = pixels.depth + unit[pixels.batch] * change[:, 0]
    pixel = pixels.footprint / pixels.depth[:, None]  # sides at depth 1
    rays = pixels.rays + F.pad(shift * pixel, (0, 1))
    # Unlike elsewhere, depth is the distance along the ray.
    means = pixels.to_world(F.normalize(rays, dim=-1) * depth[:, None])
    sides = MIN_SCALE + (MAX_SCALE - MIN_SCALE) * torch.sigmoid(scale)
    scales = _SCALE_UNIT * (depth * pixel.sum(-1))[:, None].abs() * sides
    # As in the official code: read (z, w, x, y) of its xyzw as wxyz, rotate to its world, render the xyzw as wxyz.
    quats = multiply_quats(own[pixels.view], F.normalize(rotation, dim=-1).roll(2, -1)).roll(-1, -1)
    quats = multiply_quats(frame[pixels.view], quats)
    sh = harmonic_gains(_SH_DEGREE).to(color) * color.unflatten(-1, (3, -1)).mT
    return Gaussians(
        means=means,
        quats=quats,
        scales=scales.clamp(min=SMALLEST_FOOTPRINT),
        opacities=torch.sigmoid(opacity[:, 0]),
        sh=pixels.turn_to_world(sh),
        batch=pixels.batch,
    )


def _centred(cameras: Cameras) -> Cameras:
    """Moves the principal point by half a pixel towards the origin."""
    half = cameras.intrinsics.new_tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return replace(cameras, intrinsics=cameras.intrinsics - half)
