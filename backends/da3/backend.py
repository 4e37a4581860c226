"""Depth Anything 3 as a backend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import torch
from torch import Tensor, nn

from backends.da3.backbone import Backbone, ReferenceView
from backends.dpt import DPT, decode_geometry
from backends.network import NetworkBackend, decode_pose, encode_pose, normalize_images, predict
from backends.published import network_named
from backends.vit import ViTBlock, ViTMLP
from backends.weights import Weights
from vg2gt.geometry.cameras import invert_rigid, relative_to_first
from vg2gt.geometry.precision import full_precision, half_precision_on_gpu
from vg2gt.types import Cameras, Geometry, Hints, Tokens

POSE_DIM = 9
_MIN_MEDIAN_DISTANCE = 0.1


class _CameraDecoder(nn.Module):
    """Decodes a camera token ``[B, V, D]`` into a pose encoding ``[B, V, 9]``, without iterations."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.backbone = nn.Sequential(nn.Linear(dim, dim), nn.ReLU(), nn.Linear(dim, dim), nn.ReLU())
        self.fc_t = nn.Linear(dim, 3)
        self.fc_qvec = nn.Linear(dim, 4)
        self.fc_fov = nn.Sequential(nn.Linear(dim, 2), nn.ReLU())

    def forward(self, camera: Tensor) -> Tensor:
        """Predicts translation, quaternion (xyzw) and fields of view (vertical, horizontal)."""
        features = self.backbone(camera)
        return torch.cat((self.fc_t(features), self.fc_qvec(features), self.fc_fov(features)), -1)


class _CameraEncoder(nn.Module):
    """Encodes known cameras as camera tokens ``[B, V, C]``."""

    def __init__(self, dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.trunk = nn.Sequential(*(ViTBlock(dim, num_heads, layer_scale=0.01, eps=1e-5) for _ in range(depth)))
        self.token_norm = nn.LayerNorm(dim, eps=1e-5)
        self.trunk_norm = nn.LayerNorm(dim, eps=1e-5)
        self.pose_branch = ViTMLP(POSE_DIM, dim // 2, dim)

    def forward(self, cameras: Cameras) -> Tensor:
        """Encodes cameras, normalised by :func:`normalize_cameras`."""
        encoding = encode_pose(invert_rigid(cameras.world_to_camera), cameras.intrinsics, cameras.size)
        return self.trunk_norm(self.trunk(self.token_norm(self.pose_branch(encoding))))


def normalize_cameras(cameras: Cameras) -> Cameras:
    """Moves the world frame to view 0 and divides translations by the cameras' median distance to it (at least 0.1)."""
    relative = relative_to_first(cameras)
    distance = invert_rigid(relative.world_to_camera)[..., :3, 3].norm(dim=-1)
    # Lower median by sorting, as Tensor.median cannot be exported.
    unit = distance.sort(-1).values[:, (distance.shape[1] - 1) // 2].clamp_min(_MIN_MEDIAN_DISTANCE)
    poses = relative.world_to_camera.clone()
    poses[..., :3, 3] /= unit[:, None, None]
    return Cameras(poses, relative.intrinsics, relative.size)


RAY_BRANCH = tuple(
    f"head.scratch.{part}_aux."
    for part in (*(f"refinenet{level}" for level in (1, 2, 3, 4)), "output_conv1", "output_conv2")
)

NESTED_PARTS = ("model.da3.", "model.da3_metric.")  # a nested file holds two networks


class DA3Decoder(nn.Module):
    """Depth head and camera decoder; names and shapes as published."""

    def __init__(self, token_dim: int, features: int, out_channels: Sequence[int], patch_size: int) -> None:
        super().__init__()
        sizes = {"token_dim": token_dim, "features": features, "patch_size": patch_size}
        self.arguments: dict[str, Any] = {**sizes, "out_channels": list(out_channels)}
        self.head = DPT(token_dim, features, out_channels, 2, patch_size)
        self.cam_dec = _CameraDecoder(token_dim)

    def decode(self, tokens: Tokens, chunk: int | None, cameras: Cameras | None = None) -> Geometry:
        """See :meth:`Backend.decode`; the depth head runs on at most ``chunk`` views at a time."""
        return decode_geometry(self.head, tokens, cameras or self.decode_cameras(tokens), chunk)

    def decode_cameras(self, tokens: Tokens) -> Cameras:
        """See :meth:`Backend.decode_cameras`."""
        with full_precision(tokens.camera):
            camera_to_world, intrinsics = decode_pose(self.cam_dec(tokens.camera), tokens.size)
        return Cameras(invert_rigid(camera_to_world), intrinsics, tokens.size)


class _DA3Network(DA3Decoder):
    """Backbone, decoder and, unless None, camera encoder; names as published."""

    def __init__(
        self, backbone: Backbone, cam_enc: _CameraEncoder | None, features: int, out_channels: Sequence[int]
    ) -> None:
        token_dim = 2 * backbone.cls_token.shape[-1]
        super().__init__(token_dim, features, out_channels, backbone.patch_size)
        self.backbone = nn.ModuleDict({"pretrained": backbone})
        self.cam_enc = cam_enc


class DA3Backend(NetworkBackend):
    """Depth Anything 3 (Lin et al., 2025): relative geometry in the frame of a reference view.

    Args (for the others see :class:`NetworkBackend`; tokens have 2C channels):
        reference_view: strategy to choose the view that defines the predicted world frame.
        given_poses: whether to pass ``hints.cameras`` to the camera encoder, which makes them required.

    Raises:
        ValueError: if the reference-view strategy is unknown.
    """

    camera_name = "cam_dec"
    network: _DA3Network

    def __init__(
        self,
        name: str,
        reference_view: ReferenceView = "first",
        given_poses: bool = False,
        pretrained: bool = True,
        revision: str | None = None,
        path: str | None = None,
        seed: int = 0,
        head_chunk: int | None = 8,
        freeze: bool = True,
        **shape: Any,
    ) -> None:
        if reference_view not in get_args(ReferenceView):
            known = ", ".join(get_args(ReferenceView))
            raise ValueError(f"backend.reference_view is {reference_view!r}; choose one of {known}")
        net = network_named(name, shape)

        def make() -> _DA3Network:
            """Makes the network, with random weights."""
            network = _DA3Network(
                Backbone(
                    net.dim, net.depth, net.num_heads, net.ffn, net.multiview_from, net.image_size, net.patch_size
                ),
                _CameraEncoder(net.dim, net.camera_depth, net.camera_heads) if given_poses else None,
                net.features,
                net.out_channels,
            )
            decoder = network.cam_dec  # predicts about the identity pose and fields of view of 1 rad
            predict(decoder.fc_t, (0, 0, 0))
            predict(decoder.fc_qvec, (0, 0, 0, 1))
            predict(decoder.fc_fov[0], (1, 1))
            return network

        unused = (*RAY_BRANCH, "gs_head.", *(() if given_poses else ("cam_enc.",)))
        ignorable = (*(net.prefix + part for part in unused), *(part for part in NESTED_PARTS if part != net.prefix))
        weights = Weights(name, net.licence, pretrained, net.repo, revision, path, seed, net.prefix, ignorable)
        super().__init__(
            make, weights, net.patch_size, 2 * net.dim, net.taps, head_chunk, freeze, needs_hints=given_poses
        )
        self.reference_view: ReferenceView = reference_view

    def encode_checked(self, images: Tensor, hints: Hints | None) -> Tokens:
        """See :meth:`NetworkBackend.encode_checked`."""
        given = None
        if self.network.cam_enc is not None and hints is not None and hints.cameras is not None:
            with full_precision(images):
                given = self.network.cam_enc(normalize_cameras(hints.cameras))
        backbone = self.network.backbone["pretrained"]
        with half_precision_on_gpu(images):
            patch, camera = backbone(normalize_images(images), self.taps, self.reference_view, given)
        return self.as_tokens(images, patch, camera)
