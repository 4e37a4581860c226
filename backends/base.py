"""The interface of a frozen visual foundation model (VFM): images to tokens, tokens to geometry."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from vg2gt.types import Geometry, Hints, Tokens


class Backend(nn.Module, ABC):
    """A frozen network whose tokens can be changed and decoded again.

    A subclass calls ``super().__init__`` with what is said of it below, builds its modules, and ends its constructor
    with ``self.freeze()``. It implements ``encode`` and ``decode`` and nothing else.

    Args:
        name: stands in checkpoints and messages.
        patch_size: edge of a patch in pixels; image sizes must be multiples of it.
        token_dims: channels of the patch tokens, one entry a tapped layer, in tap order.
        licence: licence of the weights, printed when they are loaded.
        is_metric: True if the decoded depth is in metres.
        supports_gradient: True if ``decode`` is differentiable in ``tokens.patch``.
        needs_hints: True if ``encode`` cannot work without what the data knows.
    """

    def __init__(
        self,
        name: str,
        patch_size: int,
        token_dims: tuple[int, ...],
        licence: str,
        is_metric: bool = False,
        supports_gradient: bool = True,
        needs_hints: bool = False,
    ) -> None:
        super().__init__()
        self.name = name
        self.patch_size = patch_size
        self.token_dims = tuple(token_dims)
        self.licence = licence
        self.is_metric = is_metric
        self.supports_gradient = supports_gradient
        self.needs_hints = needs_hints
        self._identity: dict[str, str] | None = None

    @abstractmethod
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """Runs the frozen backbone, without gradient.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1]; H and W multiples of ``patch_size``.
            hints: what the data knows, of the same views; None if nothing.

        Returns:
            The tokens exactly as the frozen heads take them.

        Raises:
            ValueError: from :meth:`check_inputs`.
        """

    @abstractmethod
    def decode(self, tokens: Tokens) -> Geometry:
        """Runs the frozen heads in float32; equal tokens give bit-equal geometry.

        Args:
            tokens: from ``encode``, the patch tokens possibly changed.

        Returns:
            Depth and confidence (differentiable in ``tokens.patch`` where ``supports_gradient``) and raw cameras.
        """

    def freeze(self) -> None:
        """Takes every parameter out of training and puts every module into eval mode, for good."""
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> Backend:
        """Stays in eval mode whatever ``mode`` says: a frozen network has no training behaviour."""
        return super().train(False)

    def identity(self) -> dict[str, str]:
        """Name and sha256 of the weights (names, shapes, values, in sorted order); computed once."""
        if self._identity is None:
            digest = hashlib.sha256()
            for key, value in sorted(self.state_dict().items()):
                digest.update(f"{key} {tuple(value.shape)} {value.dtype}".encode())
                digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy())
            self._identity = {"name": self.name, "weights": digest.hexdigest()}
        return self._identity

    def check_inputs(self, images: Tensor, hints: Hints | None = None) -> None:
        """Checks what ``encode`` is given.

        Raises:
            ValueError: if images or hints have the wrong shape or range, or needed hints are missing; it says what
                was expected and what to do.
        """
        if images.dim() != 5 or images.shape[2] != 3 or 0 in images.shape:
            raise ValueError(f"images must be [B, V, 3, H, W] with nothing empty, got {list(images.shape)}")
        height, width = images.shape[-2:]
        if height % self.patch_size or width % self.patch_size:
            nearest = [max(round(size / self.patch_size), 1) * self.patch_size for size in (height, width)]
            raise ValueError(
                f"image size {height}x{width} is not a multiple of the patch size {self.patch_size} of backend "
                f"{self.name}: resize or crop, for example to {nearest[0]}x{nearest[1]}"
            )
        low, high = torch.aminmax(images)
        if not (low >= 0 and high <= 1):  # also catches NaN
            raise ValueError(
                f"images must be finite and in [0, 1], got values from {float(low):.4g} to {float(high):.4g}: "
                "divide 8-bit images by 255 and clamp after resizing"
            )
        if self.needs_hints:
            self._check_hints(images, hints)

    def _check_hints(self, images: Tensor, hints: Hints | None) -> None:
        batch, views, _, height, width = images.shape
        missing = [
            name
            for name in ("depth", "cameras", "scene_key", "frame_ids")
            if hints is None or getattr(hints, name) is None or (name == "scene_key" and len(hints.scene_key) != batch)
        ]
        if missing:
            raise ValueError(
                f"backend {self.name} needs hints from the data, missing: {', '.join(missing)}. Pass batch.hints, "
                "or choose a backend that works from images alone (backend=vggt_1b, backend=da3_small, ...)"
            )
        assert hints is not None
        assert hints.depth is not None
        if hints.depth.shape != (batch, views, height, width):
            raise ValueError(
                f"hints.depth must be [B, V, H, W] = {[batch, views, height, width]} as the images are, "
                f"got {list(hints.depth.shape)}"
            )


@contextmanager
def seeded_initialisation(seed: int) -> Iterator[None]:
    """Makes module initialisation inside the block depend on ``seed`` only and leaves the global generator alone."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield


def full_precision(like: Tensor) -> torch.autocast:
    """A context in which autocast is off on the device of ``like``."""
    return torch.autocast(like.device.type, enabled=False)
