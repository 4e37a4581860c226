"""Base class of backends around one published network, and its pose encoding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from backends.base import Backend
from backends.positions import size_tensor
from backends.vit import ViTBlock
from backends.weights import Weights
from vg2gt.geometry.precision import autocast_dtype, half_precision_on_gpu
from vg2gt.geometry.rotations import matrix_to_quat, quat_to_matrix
from vg2gt.types import Cameras, Geometry, Hints, Tokens

_IMAGENET_MEAN = (0.485, 0.456, 0.406)
_IMAGENET_STD = (0.229, 0.224, 0.225)


def normalize_images(images: Tensor) -> Tensor:
    """Normalises images ``[..., 3, H, W]`` in [0, 1] with the ImageNet mean and standard deviation."""
    mean, std = (images.new_tensor(values)[:, None, None] for values in (_IMAGENET_MEAN, _IMAGENET_STD))
    return (images - mean) / std


_MIN_TANGENT = 1e-6  # a field of view of 0 would make the focal length infinite


def encode_pose(transform: Tensor, intrinsics: Tensor, size: tuple[int, int]) -> Tensor:
    """Encodes rigid transforms ``[..., 4, 4]`` and intrinsics ``[..., 3, 3]`` as ``[..., 9]``.

    Channels: translation, quaternion (xyzw, w >= 0), vertical and horizontal field of view in rad.
    """
    quats = matrix_to_quat(transform[..., :3, :3])
    edges = size_tensor(size, intrinsics.dtype, intrinsics.device)
    fields = 2 * torch.atan(edges / 2 / intrinsics[..., [1, 0], [1, 0]])
    return torch.cat((transform[..., :3, 3], quats[..., [1, 2, 3, 0]], fields), -1)


def decode_pose(encoding: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Decodes ``[..., 9]`` into a rigid transform ``[..., 4, 4]`` and intrinsics ``[..., 3, 3]`` in pixels.

    The principal point is (W/2, H/2) in integer pixel coordinates, as published.
    """
    rotation = quat_to_matrix(encoding[..., [6, 3, 4, 5]])
    top = torch.cat((rotation, encoding[..., :3, None]), -1)
    last = torch.zeros_like(top[..., :1, :])
    last[..., 3] = 1
    transform = torch.cat((top, last), -2)

    half = size_tensor(size, encoding.dtype, encoding.device).flip(0) / 2
    focal = half / torch.tan(encoding[..., [8, 7]] / 2).clamp_min(_MIN_TANGENT)
    center = torch.cat((half, half.new_ones(1))).expand(*encoding.shape[:-1], 3)
    axes = torch.diag_embed(torch.cat((focal, torch.zeros_like(focal[..., :1])), -1))[..., :2]
    return transform, torch.cat((axes, center[..., None]), -1)


class NetworkBackend(Backend):
    """Base class of the VGGT and DA3 backends, whose constructors share these arguments.

    They pass it ``make``, which builds the network, and :class:`Weights`; ``properties`` are those of :class:`Backend`.

    Args:
        name: name in checkpoints and messages, and of the network in :data:`backends.published.NETWORKS`.
        pretrained: whether to load weights, otherwise random ones.
        revision: branch, tag or commit of the repository.
        path: local weight file or folder, instead of the repository.
        seed: seed of random weights.
        head_chunk: maximum number of views to decode at a time; None decodes all at once.
        freeze: whether to freeze the network. Otherwise all of it except the camera head is trained, and checkpoints
            include it. Cameras and initial geometry are treated as constants.
        shape: attributes of :class:`backends.published.Network` that differ from those of the name.
    """

    network: Any
    camera_name = ""  # name of the submodule that decodes cameras
    encoder_name = "backbone"  # name of the submodule that runs in half precision on a GPU

    def __init__(
        self,
        make: Callable[[], nn.Module],
        weights: Weights,
        patch_size: int,
        token_dim: int,
        taps: Sequence[int],
        head_chunk: int | None,
        freeze: bool = True,
        **properties: bool,
    ) -> None:
        super().__init__(weights.name, patch_size, (token_dim,) * len(taps), weights.licence, **properties)
        if list(taps) != sorted(set(taps)):
            raise ValueError(f"backend.taps={list(taps)} must be ascending: the heads expect shallow layers first")
        self.taps = tuple(taps)
        self.head_chunk = head_chunk
        self.weights = weights
        self.network = weights.build(make)
        self.frozen = freeze
        self._stored = torch.float32  # dtype of the encoder's matrices
        self.freeze()

    def freeze(self) -> None:
        """See :meth:`Backend.freeze`."""
        super().freeze()
        if not self.frozen:
            self.network.get_submodule(self.camera_name).requires_grad_(False)

    def compile_blocks(self) -> None:
        """See :meth:`Backend.compile_blocks`; blocks of equal structure share their code, and sizes are free."""
        for block in self.network.get_submodule(self.encoder_name).modules():
            if isinstance(block, ViTBlock):
                block.compile(dynamic=True)

    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """See :meth:`Backend.encode`; ``hints.cameras`` are required and used if the network takes given poses."""
        self.check_images(images)
        if self.needs_hints:
            hints = self.require_hints(images, hints, "cameras")
        if self.frozen:
            with half_precision_on_gpu(images):
                self._store(autocast_dtype(images))
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            return self.encode_checked(images, hints)

    def _store(self, dtype: torch.dtype) -> None:
        """Stores the encoder's matrices as autocast takes them, which casts weights without gradient in every pass.

        The result is bit-equal, with half the memory. On a CPU after a GPU, they are float32 again, but rounded.
        """
        if dtype != self._stored:
            self.identity()  # of the weights as published
            for module in self.network.get_submodule(self.encoder_name).modules():
                if isinstance(module, nn.Linear | nn.Conv2d):
                    module.to(dtype)
            self._stored = dtype

    def encode_checked(self, images: Tensor, hints: Hints | None) -> Tokens:
        """Encodes inputs checked by :meth:`encode`, with tensor operations only so that it can be exported."""
        raise NotImplementedError

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`; the principal point is (W/2, H/2)."""
        return self.network.decode(tokens, self.head_chunk)

    def decode_again(self, tokens: Tokens, cameras: Cameras) -> Geometry:
        """See :meth:`Backend.decode_again`; decodes depth and confidence only."""
        return self.network.decode(tokens, self.head_chunk, cameras)

    def decode_cameras(self, tokens: Tokens) -> Cameras:
        """See :meth:`Backend.decode_cameras`; does not run the depth head."""
        return self.network.decode_cameras(tokens)


@torch.no_grad()
def predict(layer: nn.Module, bias: Sequence[float]) -> None:
    """Initialises an output layer to predict about ``bias``, such as forward cameras with sensible fields of view."""
    assert isinstance(layer, nn.Linear)
    layer.weight.mul_(0.1)
    layer.bias.copy_(layer.bias.new_tensor(bias))
