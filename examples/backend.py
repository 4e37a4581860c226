"""Example of a custom backend around a network that predicts depth; cameras come from the data."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.base import Backend
from vg2gt.geometry.precision import full_precision
from vg2gt.types import Geometry, Hints, Tokens


class BrightIsNear(nn.Module):
    """A placeholder for your network."""

    def forward(self, images: Tensor) -> Tensor:
        """Maps images ``[N, 3, H, W]`` to depth ``[N, 1, H, W]``."""
        return 2 - images.mean(1, keepdim=True)


class LocalDepthBackend(Backend):
    """Depth network as a backend; a token holds colour and log-depth of all pixels of a patch.

    Args:
        network: maps images ``[N, 3, H, W]`` to depth ``[N, 1, H, W]``; None uses the placeholder.
        patch_size: edge of a patch in pixels.
    """

    def __init__(self, network: nn.Module | None = None, patch_size: int = 14) -> None:
        super().__init__(
            "local_depth", patch_size, (4 * patch_size**2,), "mine", needs_hints=True, predicts_cameras=False
        )
        self.network = network or BrightIsNear()
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """Encodes images ``[B, V, 3, H, W]`` as tokens."""
        self.check_images(images)
        hints = self.require_hints(images, hints, "cameras")
        height, width = images.shape[-2:]
        log_depth = self.network(images.flatten(0, 1)).clamp_min(1e-3).log()
        pixels = torch.cat((images.flatten(0, 1), log_depth), 1)
        patch = F.pixel_unshuffle(pixels, self.patch_size).flatten(2).mT.unflatten(0, images.shape[:2])
        grid = (height // self.patch_size, width // self.patch_size)
        return Tokens((patch,), patch.mean(2), grid, (height, width), {"cameras": hints.cameras})

    def decode(self, tokens: Tokens) -> Geometry:
        """Decodes tokens to depth, confidence and cameras; differentiable in ``tokens.patch``."""
        with full_precision(tokens.camera):
            cells = tokens.patch[0].float().flatten(0, 1).mT.unflatten(-1, tokens.grid)
            depth = F.pixel_shuffle(cells, self.patch_size)[:, 3].exp().unflatten(0, tokens.camera.shape[:2])
        return Geometry(depth, torch.ones_like(depth), tokens.state["cameras"], torch.ones_like(depth[:, 0, 0, 0]))
