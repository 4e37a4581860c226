"""VGGT as a backend."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from backends.base import Backend, half_precision_on_gpu
from backends.vggt.camera_head import ITERATIONS
from backends.vggt.network import Aggregator, VGGTNetwork
from backends.weights import Weights
from vg2gt.types import Geometry, Hints, Tokens

IGNORABLE = ("track_head.", "point_head.", "aggregator.patch_embed.mask_token")


class VGGTBackend(Backend):
    """VGGT (Wang et al., 2025): relative geometry in the frame of the first view.

    Args:
        name: stands in checkpoints and messages.
        licence: of the weights.
        dim: channels C; tokens have 2C.
        depth: pairs of alternating blocks.
        encoder_depth: blocks of the per-view encoder.
        num_heads: attention heads.
        taps: four block pairs whose tokens feed the heads.
        features: DPT width.
        out_channels: DPT channels of the four taps.
        camera_depth: blocks of the camera head.
        camera_heads: attention heads of the camera head.
        image_size: native image edge.
        patch_size: in pixels.
        pretrained: whether to load weights; random ones (by ``seed``) otherwise.
        repo: Hugging Face repository of the weights.
        revision: its branch, tag or commit.
        path: local weight file or folder instead.
        seed: of random weights.
        head_chunk: views decoded at a time; None decodes all at once.
        compile: whether to ``torch.compile`` the backbone.
    """

    def __init__(
        self,
        name: str = "vggt_1b",
        licence: str = "VGGT research licence",
        dim: int = 1024,
        depth: int = 24,
        encoder_depth: int = 24,
        num_heads: int = 16,
        taps: Sequence[int] = (4, 11, 17, 23),
        features: int = 256,
        out_channels: Sequence[int] = (256, 512, 1024, 1024),
        camera_depth: int = 4,
        camera_heads: int = 16,
        image_size: int = 518,
        patch_size: int = 14,
        pretrained: bool = True,
        repo: str | None = "facebook/VGGT-1B",
        revision: str | None = None,
        path: str | None = None,
        seed: int = 0,
        head_chunk: int | None = 8,
        compile: bool = False,
    ) -> None:
        super().__init__(name, patch_size, (2 * dim,) * len(taps), licence)
        self.taps = tuple(taps)
        self.head_chunk = head_chunk

        def make() -> VGGTNetwork:
            aggregator = Aggregator(dim, depth, encoder_depth, num_heads, image_size, patch_size)
            network = VGGTNetwork(aggregator, features, out_channels, camera_depth, camera_heads)
            _face_forward(network.camera_head.pose_branch.fc2)
            return network

        self.weights = Weights(name, licence, pretrained, repo, revision, path, seed, ignorable=IGNORABLE)
        self.network = self.weights.build(make)
        if compile:
            self.network.aggregator.compile()
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """See :meth:`Backend.encode`; hints are not used."""
        self.check_images(images)
        return self.encode_checked(images, hints)

    @torch.no_grad()
    def encode_checked(self, images: Tensor, hints: Hints | None) -> Tokens:
        """Encodes what :meth:`encode` has checked: tensor operations only, so that it can be exported."""
        with half_precision_on_gpu(images):
            patch, camera = self.network.aggregator(images, self.taps)
        return self.as_tokens(images, patch, camera)

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`; the principal point is (W/2, H/2)."""
        return self.network.decode(tokens, self.head_chunk)


@torch.no_grad()
def _face_forward(layer: nn.Linear) -> None:
    """Makes random weights predict about the identity pose and a field of view of 1 rad, summed over the rounds."""
    layer.weight.mul_(0.1)
    layer.bias.copy_(layer.bias.new_tensor([0, 0, 0, 0, 0, 0, 1, 1, 1]) / ITERATIONS)
