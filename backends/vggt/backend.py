"""VGGT as a backend."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from backends.network import NetworkBackend, predict
from backends.vggt.network import ITERATIONS, Aggregator, VGGTNetwork
from backends.weights import Weights
from vg2gt.geometry.precision import half_precision_on_gpu
from vg2gt.types import Hints, Tokens

IGNORABLE = ("track_head.", "point_head.", "aggregator.patch_embed.mask_token")


class VGGTBackend(NetworkBackend):
    """VGGT (Wang et al., 2025): relative geometry in the frame of the first view. Hints are not used.

    Args (the others: see :class:`NetworkBackend`; tokens have 2C channels):
        depth: pairs of alternating blocks.
        encoder_depth: blocks of the per-view encoder.
        camera_depth: blocks of the camera head.
        camera_heads: attention heads of the camera head.
    """

    backbone_name = "aggregator"
    camera_name = "camera_head"
    network: VGGTNetwork

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
        freeze: bool = True,
    ) -> None:
        super().__init__(name, patch_size, (2 * dim,) * len(taps), licence)

        def make() -> VGGTNetwork:
            aggregator = Aggregator(dim, depth, encoder_depth, num_heads, image_size, patch_size)
            network = VGGTNetwork(aggregator, features, out_channels, camera_depth, camera_heads)
            # in every round a share of the identity pose and of fields of view of 1 rad
            predict(network.camera_head.pose_branch.fc2, [value / ITERATIONS for value in (0, 0, 0, 0, 0, 0, 1, 1, 1)])
            return network

        weights = Weights(name, licence, pretrained, repo, revision, path, seed, ignorable=IGNORABLE)
        self._build(make, weights, taps, head_chunk, compile, freeze)

    def encode_checked(self, images: Tensor, hints: Hints | None) -> Tokens:
        """See :meth:`NetworkBackend.encode_checked`."""
        with half_precision_on_gpu(images):
            patch, camera = self.network.aggregator(images, self.taps)
        return self.as_tokens(images, patch, camera)
