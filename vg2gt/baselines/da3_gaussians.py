"""Depth Anything 3's own Gaussians, one per pixel, without training (paper, Baselines, "DA3")."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from backends.base import Backend
from backends.da3 import DA3Backend
from backends.da3.gaussians import PARTS, SH_DEGREE
from vg2gt.baselines.pixels import SMALLEST_FOOTPRINT, Pixels, harmonic_gains, usable_pixels
from vg2gt.geometry.rotations import matrix_to_quat, multiply_quats
from vg2gt.method.additions.visibility import ViewCheck
from vg2gt.model import Background, Reconstructor, SceneScale
from vg2gt.profiling import stage
from vg2gt.types import Cameras, Gaussians, Geometry, Hints, Prediction, Tokens

MIN_SCALE, MAX_SCALE = 1e-5, 30.0  # in SCALE_UNIT times the sum of a pixel's sides
SCALE_UNIT = 0.1


class DA3Gaussians(Reconstructor):
    """Gaussians of DA3's ``gs_head``, with the weights of the backend's checkpoint.

    The head expects cameras with the principal point at the image centre, half a pixel from DA3's cameras for depth.
    :meth:`run_backbone` and :meth:`predict_cameras` return such cameras.

    Args:
        backend: DA3 with a Gaussian head: GIANT, or random weights.
        scale: fixes the scene unit.
        background: see :class:`vg2gt.model.Reconstructor`.
        visibility: see :class:`vg2gt.model.Reconstructor`.

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
        self.head = backend.gaussian_head()

    def run_backbone(self, images: Tensor, hints: Hints | None) -> tuple[Tokens, Geometry]:
        """See :meth:`vg2gt.model.Reconstructor.run_backbone`."""
        tokens, geometry = super().run_backbone(images, hints)
        return tokens, replace(geometry, cameras=_centred(geometry.cameras))

    def predict_cameras(self, images: Tensor, hints: Hints | None) -> Cameras:
        """See :meth:`vg2gt.model.Reconstructor.predict_cameras`."""
        return _centred(super().predict_cameras(images, hints))

    @torch.no_grad()
    def forward(
        self, images: Tensor, hints: Hints | None = None, generator: torch.Generator | None = None
    ) -> Prediction:
        """Reconstructs B scenes; see :meth:`vg2gt.model.Reconstructor.forward`. Deterministic."""
        tokens, geometry, unit = self.read_views(images, hints)
        support = self.support(geometry, hints)
        keep = None if support is None else support.keep
        with stage("fine"):
            raw = self.head.predict(tokens, images, self.backend.head_chunk).flatten(0, 3)
        with stage("gaussians"), torch.autocast(images.device.type, enabled=False):
            pixels = usable_pixels(geometry.where(keep), images)
            own = self.backend.decode_cameras(tokens).world_to_camera[..., :3, :3].mT.flatten(0, 1)
            frame = geometry.cameras.world_to_camera[..., :3, :3].mT.flatten(0, 1) @ own.mT
            gaussians = place(raw[pixels.rows], pixels, unit, matrix_to_quat(own), matrix_to_quat(frame))
        gaussians = self.with_background(gaussians, images, geometry.depth)
        return Prediction(geometry, geometry, unit, None, gaussians, keep)


def place(raw: Tensor, pixels: Pixels, unit: Tensor, own: Tensor, frame: Tensor) -> Gaussians:
    """Converts raw head outputs to Gaussians of the scene.

    Args:
        raw: ``[N, sum(PARTS)]``, see :meth:`backends.da3.gaussians.GaussianHead.predict`.
        pixels: the same N pixels.
        unit: ``[B]`` scene units per unit of the network.
        own: ``[B * V, 4]`` camera-to-world quaternions predicted by the network.
        frame: ``[B * V, 4]`` quaternions from the network's world to the scene.
    """
    shift, scale, rotation, color, change, opacity = raw.float().split(PARTS, -1)
    depth = pixels.depth + unit[pixels.batch] * change[:, 0]
    pixel = pixels.footprint / pixels.depth[:, None]  # sides at depth 1
    rays = pixels.rays + F.pad(shift * pixel, (0, 1))
    # Unlike elsewhere, depth is the distance along the ray.
    means = pixels.to_world(F.normalize(rays, dim=-1) * depth[:, None])
    sides = MIN_SCALE + (MAX_SCALE - MIN_SCALE) * torch.sigmoid(scale)
    scales = SCALE_UNIT * (depth * pixel.sum(-1))[:, None].abs() * sides
    # As in the official code: read (z, w, x, y) of its xyzw as wxyz, rotate to its world, render the xyzw as wxyz.
    quats = multiply_quats(own[pixels.view], F.normalize(rotation, dim=-1).roll(2, -1)).roll(-1, -1)
    quats = multiply_quats(frame[pixels.view], quats)
    sh = harmonic_gains(SH_DEGREE).to(color) * color.unflatten(-1, (3, -1)).mT
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
