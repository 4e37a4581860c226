"""A backend that needs cameras and nothing else, as a plane sweep does."""

import torch
from torch import Tensor

from backends.base import Backend
from vg2gt.types import Geometry, Hints, Tokens


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
