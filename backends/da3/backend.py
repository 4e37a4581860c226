"""Depth Anything 3 as a backend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import torch
from torch import Tensor, nn

from backends.base import Backend, full_precision, half_precision_on_gpu
from backends.da3.backbone import Backbone, PretrainedBackbone, ReferenceView
from backends.da3.camera import CameraDecoder, CameraEncoder, normalize_cameras
from backends.dpt import DPT, in_chunks
from backends.normalization import normalize_images
from backends.poses import decode_pose
from backends.vit import FeedForward
from backends.weights import Weights
from vg2gt.geometry.cameras import invert_rigid
from vg2gt.types import Cameras, Geometry, Hints, Tokens

RAY_BRANCH = tuple(
    f"head.scratch.{part}_aux."
    for part in (*(f"refinenet{level}" for level in (1, 2, 3, 4)), "output_conv1", "output_conv2")
)

NESTED_PARTS = ("model.da3.", "model.da3_metric.")  # a nested file holds two networks


class DA3Decoder(nn.Module):
    """What stands behind the tokens: depth head and camera decoder; names and shapes as published.

    Args:
        token_dim: channels of the tokens.
        features: DPT width.
        out_channels: DPT channels of the four taps.
        patch_size: in pixels.
    """

    def __init__(self, token_dim: int, features: int, out_channels: Sequence[int], patch_size: int) -> None:
        super().__init__()
        self.arguments = {
            "token_dim": token_dim,
            "features": features,
            "out_channels": list(out_channels),
            "patch_size": patch_size,
        }
        self.head = DPT(token_dim, features, out_channels, 2, patch_size)
        self.cam_dec = CameraDecoder(token_dim)

    def decode(self, tokens: Tokens, chunk: int | None) -> Geometry:
        """See :meth:`Backend.decode`; at most ``chunk`` views at a time go through the depth head."""
        with full_precision(tokens.camera):
            out = in_chunks(self.head, tokens.patch, tokens.grid, chunk)
            camera_to_world, intrinsics = decode_pose(self.cam_dec(tokens.camera), tokens.size)
        depth, confidence = out[:, :, 0].exp(), 1 + out[:, :, 1].exp()
        cameras = Cameras(invert_rigid(camera_to_world), intrinsics, tokens.size)
        return Geometry(depth, confidence, cameras, torch.ones_like(depth[:, 0, 0, 0]))


class DA3Network(DA3Decoder):
    """The decoder with its backbone and, if wanted, camera encoder; names and shapes as published.

    Args:
        backbone: images to tokens.
        cam_enc: known cameras to camera tokens.
        features: DPT width.
        out_channels: DPT channels of the four taps.
    """

    def __init__(
        self, backbone: Backbone, cam_enc: CameraEncoder | None, features: int, out_channels: Sequence[int]
    ) -> None:
        token_dim = 2 * backbone.cls_token.shape[-1]
        super().__init__(token_dim, features, out_channels, backbone.patch_size)
        self.backbone = PretrainedBackbone(backbone)
        self.cam_enc = cam_enc


class DA3Backend(Backend):
    """Depth Anything 3 (Lin et al., 2025): relative geometry in the frame of a reference view.

    Args:
        name: stands in checkpoints and messages.
        licence: of the weights.
        dim: channels C; tokens have 2C.
        depth: blocks.
        num_heads: attention heads.
        ffn: feed-forward layer.
        multiview_from: first block of the alternating part.
        taps: four blocks whose tokens feed the heads.
        features: DPT width.
        out_channels: DPT channels of the four taps.
        camera_depth: blocks of the camera encoder.
        camera_heads: attention heads of the camera encoder.
        image_size: native image edge.
        patch_size: in pixels.
        reference_view: which view defines the predicted world frame.
        given_poses: whether ``hints.cameras`` go through the camera encoder (then they are needed).
        pretrained: whether to load weights; random ones (by ``seed``) otherwise.
        repo: Hugging Face repository of the weights.
        revision: its branch, tag or commit.
        path: local weight file or folder instead.
        prefix: of the names in the file.
        seed: of random weights.
        head_chunk: views decoded at a time; None decodes all at once.
        compile: whether to ``torch.compile`` the backbone.

    Raises:
        ValueError: if the reference-view strategy is unknown.
    """

    def __init__(
        self,
        name: str,
        licence: str,
        dim: int,
        depth: int,
        num_heads: int,
        multiview_from: int,
        taps: Sequence[int],
        features: int,
        out_channels: Sequence[int],
        ffn: FeedForward = "mlp",
        camera_depth: int = 4,
        camera_heads: int = 16,
        image_size: int = 518,
        patch_size: int = 14,
        reference_view: ReferenceView = "first",
        given_poses: bool = False,
        pretrained: bool = True,
        repo: str | None = None,
        revision: str | None = None,
        path: str | None = None,
        prefix: str = "model.",
        seed: int = 0,
        head_chunk: int | None = 8,
        compile: bool = False,
    ) -> None:
        if reference_view not in get_args(ReferenceView):
            known = ", ".join(get_args(ReferenceView))
            raise ValueError(f"backend.reference_view is {reference_view!r}; choose one of {known}")
        super().__init__(name, patch_size, (2 * dim,) * len(taps), licence, needs_hints=given_poses)
        self.taps = tuple(taps)
        self.reference_view = reference_view
        self.given_poses = given_poses
        self.head_chunk = head_chunk

        def make() -> DA3Network:
            network = DA3Network(
                Backbone(dim, depth, num_heads, ffn, multiview_from, image_size, patch_size),
                CameraEncoder(dim, camera_depth, camera_heads) if given_poses else None,
                features,
                out_channels,
            )
            _face_forward(network.cam_dec)
            return network

        unused = (*RAY_BRANCH, "gs_head.", *(() if given_poses else ("cam_enc.",)))
        ignorable = (*(prefix + part for part in unused), *(part for part in NESTED_PARTS if part != prefix))
        self.weights = Weights(name, licence, pretrained, repo, revision, path, seed, prefix, ignorable)
        self.network = self.weights.build(make)
        if compile:
            self.network.backbone.pretrained.compile()
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """See :meth:`Backend.encode`; ``hints.cameras`` are used if ``given_poses``."""
        self.check_images(images)
        if self.given_poses:
            hints = self.require_hints(images, hints, "cameras")
        return self.encode_checked(images, hints)

    @torch.no_grad()
    def encode_checked(self, images: Tensor, hints: Hints | None) -> Tokens:
        """Encodes what :meth:`encode` has checked: tensor operations only, so that it can be exported."""
        given = None
        if self.network.cam_enc is not None and hints is not None and hints.cameras is not None:
            with full_precision(images):
                given = self.network.cam_enc(normalize_cameras(hints.cameras))
        return self.encode_with(images, given)

    @torch.no_grad()
    def encode_with(self, images: Tensor, camera_tokens: Tensor | None) -> Tokens:
        """Encodes checked images, with camera tokens ``[B, V, C]`` from the camera encoder if there are any."""
        with half_precision_on_gpu(images):
            patch, camera = self.network.backbone.pretrained(
                normalize_images(images), self.taps, self.reference_view, camera_tokens
            )
        return self.as_tokens(images, patch, camera)

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`; the principal point is (W/2, H/2)."""
        return self.network.decode(tokens, self.head_chunk)


@torch.no_grad()
def _face_forward(decoder: CameraDecoder) -> None:
    """Makes random weights predict about the identity pose and a field of view of 1 rad."""
    field_of_view = decoder.fc_fov[0]
    assert isinstance(field_of_view, nn.Linear)
    for layer, bias in ((decoder.fc_t, (0, 0, 0)), (decoder.fc_qvec, (0, 0, 0, 1)), (field_of_view, (1, 1))):
        layer.weight.mul_(0.1)
        layer.bias.copy_(layer.bias.new_tensor(bias))
