"""Gaussian head of Depth Anything 3: tokens of the frozen backbone and images to raw Gaussians per pixel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from backends.dpt import DPT
from backends.network import normalize_images
from vg2gt.geometry.precision import full_precision
from vg2gt.types import Tokens

SH_DEGREE = 2
PARTS = (2, 3, 4, 3 * (SH_DEGREE + 1) ** 2, 1, 1)


class GaussianHead(DPT):
    """A DPT that adds image features to its fused map; names and shapes as published (``gs_head``).

    Args:
        token_dim: channels of the tokens.
        features: channels of the DPT's fusion stages.
        out_channels: DPT channels of the four taps.
        patch_size: edge of a patch in pixels.
    """

    def __init__(self, token_dim: int, features: int, out_channels: Sequence[int], patch_size: int) -> None:
        super().__init__(token_dim, features, out_channels, sum(PARTS), patch_size, normalize=False)
        width = features // 2
        layers: list[nn.Module] = []
        for inside, outside in ((3, width // 4), (width // 4, width // 2), (width // 2, width)):
            layers += [nn.Conv2d(inside, outside, 3, padding=1), nn.GELU()]
        self.images_merger = nn.Sequential(*layers)

    @torch.no_grad()
    def predict(self, tokens: Tokens, images: Tensor, chunk: int | None) -> Tensor:
        """Predicts raw Gaussians, at most ``chunk`` views at a time.

        Args:
            tokens: tokens of the backbone that the head was trained with.
            images: ``[B, V, 3, H, W]`` in [0, 1].
            chunk: maximum number of views at a time; None predicts all at once.

        Returns:
            ``[B, V, H, W, sum(PARTS)]``. Per pixel: offset in pixels, logits of the scales, quaternion (xyzw, in camera
            axes), SH coefficients (channel by channel, in camera axes), depth offset, logit of the opacity.
        """
        taps = [tap.flatten(0, 1) for tap in tokens.patch]
        with full_precision(images):
            parts = []
            for views in torch.arange(len(taps[0]), device=images.device).split(chunk or len(taps[0])):
                fused = self.fuse([tap[views] for tap in taps], tokens.grid)
                merged = fused + self.images_merger(normalize_images(images).flatten(0, 1)[views])
                parts.append(self.scratch.get_submodule("output_conv2")(merged))
        return torch.cat(parts).unflatten(0, images.shape[:2]).permute(0, 1, 3, 4, 2)
