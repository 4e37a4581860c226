"""Backends that stand in for others: their answer for a view does not depend on the other views."""

from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from backends.base import Backend
from vg2gt.data.base import Frames
from vg2gt.geometry.cameras import relative_to_first
from vg2gt.types import Cameras, Geometry, Hints, Tokens

TAPS, DIM = 4, 16


class ByItself(Backend):
    """Given cameras, given depth with an error that differs from view to view, and colours of patches as tokens."""

    needs_depth: ClassVar[bool] = True

    def __init__(self, error: float = 0.01) -> None:
        super().__init__("by_itself", 14, (DIM,) * TAPS, licence="none", needs_hints=True, predicts_cameras=False)
        self.error = error
        self._calls = 0
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        self.check_images(images)
        hints = self.require_hints(images, hints, "cameras", "depth", "frame_ids")
        self._calls += 1
        colors = F.avg_pool2d(images.flatten(0, 1), 14).flatten(2).transpose(1, 2).unflatten(0, images.shape[:2])
        tap = torch.cat([torch.sin((3 + i) * colors) for i in range(6)], -1)[..., :DIM]
        tokens = self.as_tokens(images, [tap] * TAPS, tap.mean(2))
        height, width = images.shape[-2:]
        phase = hints.frame_ids[..., None, None] + torch.linspace(0, 3, width) + torch.linspace(0, 2, height)[:, None]
        depth = hints.depth * (1 + self.error * torch.sin(phase))
        cameras = relative_to_first(hints.cameras.map(Tensor.double)).map(Tensor.float)
        return Tokens(tokens.patch, tokens.camera, tokens.grid, tokens.size, {"depth": depth, "cameras": cameras})

    def decode(self, tokens: Tokens) -> Geometry:
        depth = tokens.state["depth"]
        confidence = 1 + 0.5 * torch.cos(20 * depth)
        return Geometry(depth, confidence, tokens.state["cameras"], torch.ones(len(depth)))


class ByHeart(ByItself):
    """Knows the frames that it will see, and predicts their depth and cameras in a unit that differs every time."""

    needs_depth: ClassVar[bool] = False

    def __init__(self, frames: Frames, drift: float = 0.1) -> None:
        super().__init__(error=0.0)
        self.needs_hints, self.predicts_cameras = False, True
        self._frames, self._drift = frames, drift

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        known = self._frames
        ids = (images[0][:, None] - known.images).abs().mean((2, 3, 4)).argmin(1)  # [V]
        unit = 1 + self._drift * torch.sin(7.0 * ids.sum())
        poses = known.world_to_camera[ids].clone()
        poses[:, :3, 3] *= unit
        cameras = Cameras(poses[None], known.intrinsics[ids][None], (images.shape[-2], images.shape[-1]))
        return super().encode(images, Hints(known.depth[ids][None] * unit, cameras, ("heart",), ids[None]))


class PlaneAhead(Backend):
    """Depth is the middle of the range that it is told, else 1."""

    def __init__(self) -> None:
        super().__init__("plane_ahead", 14, (16,), licence="none", needs_hints=True)
        self.freeze()

    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        self.check_images(images)
        hints = self.require_hints(images, hints, "cameras")
        batch, views, _, height, width = images.shape
        patches = (height // 14) * (width // 14)
        tokens = self.as_tokens(images, [torch.zeros(batch, views, patches, 16)], torch.zeros(batch, views, 8))
        near_far = torch.ones(batch, 2) if hints.depth_range is None else hints.depth_range
        depth = near_far.mean(-1)[:, None, None, None].expand(batch, views, height, width)
        state = {"cameras": hints.cameras, "depth": depth}
        return Tokens(tokens.patch, tokens.camera, tokens.grid, tokens.size, state)

    def decode(self, tokens: Tokens) -> Geometry:
        depth = tokens.state["depth"] + 0 * tokens.patch[0].mean()
        return Geometry(depth, torch.ones_like(depth), tokens.state["cameras"], torch.ones(len(depth)))
