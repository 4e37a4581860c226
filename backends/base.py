"""Interface of a frozen visual foundation model (VFM): images to tokens, tokens to geometry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import ClassVar

import torch
from torch import Tensor, nn

from vg2gt.geometry.cameras import relative_to_first
from vg2gt.io.tensors import tensors_digest
from vg2gt.types import Cameras, Geometry, Hints, Tokens


class Backend(nn.Module, ABC):
    """A frozen network whose tokens can be modified and decoded again.

    A subclass calls ``super().__init__`` with the arguments below, builds its modules, and ends its constructor with
    ``self.freeze()``. It implements ``encode`` and ``decode``, and may override ``decode_cameras`` and
    ``predict_cameras`` with cheaper versions.

    Args:
        name: name in checkpoints and messages.
        patch_size: edge of a patch in pixels; image sizes must be multiples of it.
        token_dims: channels of the patch tokens, one entry per tapped layer, in tap order.
        licence: licence of the weights, printed when they are loaded.
        is_metric: True if ``Geometry.scale`` turns the decoded depth into metres.
        needs_hints: True if ``encode`` requires hints, at least cameras.
        predicts_cameras: False if its cameras are those of the hints.

    Attributes:
        frozen: whether all weights are frozen.
        needs_cameras: whether the class always needs cameras, either known or estimated beforehand.
        needs_depth: whether ``encode`` also needs the data's depth. Such a backend cannot run on photographs; commands
            refuse it before building it.
    """

    frozen = True
    needs_depth: ClassVar[bool] = False
    needs_cameras: ClassVar[bool] = False

    def __init__(
        self,
        name: str,
        patch_size: int,
        token_dims: tuple[int, ...],
        licence: str,
        is_metric: bool = False,
        needs_hints: bool = False,
        predicts_cameras: bool = True,
    ) -> None:
        super().__init__()
        self.name = name
        self.patch_size = patch_size
        self.token_dims = tuple(token_dims)
        self.licence = licence
        self.is_metric = is_metric
        self.needs_hints = needs_hints
        self.predicts_cameras = predicts_cameras
        self._identity: dict[str, str] | None = None

    @abstractmethod
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """Runs the frozen backbone, without gradient.

        Args:
            images: ``[B, V, 3, H, W]`` in [0, 1]; H and W multiples of ``patch_size``.
            hints: known cameras, depth and so on of the same views; None if nothing is known.

        Returns:
            The tokens exactly as the frozen heads take them.

        Raises:
            ValueError: from :meth:`check_images` and, if hints are needed, :meth:`require_hints`.
        """

    @abstractmethod
    def decode(self, tokens: Tokens) -> Geometry:
        """Runs the frozen heads in float32; equal tokens give bit-equal geometry.

        Args:
            tokens: output of ``encode``, whose patch tokens may be modified.

        Returns:
            Depth, confidence and raw cameras; depth and confidence are differentiable with respect to ``tokens.patch``.
        """

    def decode_again(self, tokens: Tokens, cameras: Cameras) -> Geometry:
        """Decodes modified patch tokens with a camera token that was decoded before.

        Args:
            tokens: as for :meth:`decode`.
            cameras: raw cameras of the camera token; an override may return them instead of decoding them again.
        """
        return self.decode(tokens)

    def decode_cameras(self, tokens: Tokens) -> Cameras:
        """Returns the raw cameras of :meth:`decode`, bit-equal; cheaper if the network has a camera head."""
        return self.decode(tokens).cameras

    @torch.no_grad()
    def predict_cameras(self, images: Tensor, hints: Hints | None = None) -> Cameras:
        """Returns the raw cameras of ``decode(encode(images, hints))``, bit-equal; may skip all other work."""
        return self.decode_cameras(self.encode(images, hints))

    def compile_blocks(self) -> None:
        """Compiles the transformer blocks, for ``training.compile_blocks``.

        Raises:
            ValueError: if the network has none.
        """
        raise ValueError(
            f"training.compile_blocks=true: backend {self.name} has no transformer blocks of ours; use vggt_1b or da3_*"
        )

    def freeze(self) -> None:
        """Disables gradients of all parameters, unless not ``frozen``, and sets eval mode."""
        self.requires_grad_(not self.frozen)
        self.eval()
        if not self.frozen:
            self.identity()

    def train(self, mode: bool = True) -> Backend:
        """Stays in eval mode whatever ``mode`` is."""
        return super().train(False)

    def identity(self) -> dict[str, str]:
        """Returns the name and the sha256 of the weights (names, shapes, values, in sorted order); computed once."""
        if self._identity is None:
            self._identity = {"name": self.name, "weights": tensors_digest(self.state_dict())}
        return self._identity

    def check_images(self, images: Tensor) -> None:
        """Checks the images given to ``encode``.

        Raises:
            ValueError: if they have the wrong shape, size or range.
        """
        if images.dim() != 5 or images.shape[2] != 3 or 0 in images.shape:
            raise ValueError(f"images must be [B, V, 3, H, W] with no empty dimension, got {list(images.shape)}")
        height, width = images.shape[-2:]
        if height % self.patch_size or width % self.patch_size:
            size = f"image size {height}x{width} is not a multiple of the patch size {self.patch_size}"
            raise ValueError(f"{size} of backend {self.name}: resize or crop the images")
        low, high = torch.aminmax(images)
        if not ((low >= 0) & (high <= 1)):  # one value to wait for; also catches NaN
            raise ValueError(f"images must be finite and in [0, 1], got {float(low):.4g} to {float(high):.4g}")

    def as_tokens(self, images: Tensor, patch: Sequence[Tensor], camera: Tensor) -> Tokens:
        """Packs the outputs of a backbone as float32 tokens.

        Args:
            images: encoded images ``[B, V, 3, H, W]``.
            patch: patch tokens ``[B, V, P, D]`` of every tapped layer.
            camera: camera tokens ``[B, V, Dc]``.
        """
        size = (images.shape[-2], images.shape[-1])
        grid = (size[0] // self.patch_size, size[1] // self.patch_size)
        return Tokens(tuple(tap.float() for tap in patch), camera.float(), grid, size)

    def require_hints(self, images: Tensor, hints: Hints | None, *names: str) -> Hints:
        """Returns ``hints`` if they hold the named fields for all views of ``images``.

        Raises:
            ValueError: if a field is missing or has the wrong shape, or cameras are not valid.
        """
        missing = [name for name in names if getattr(hints, name, None) is None]
        if hints is None or missing:
            raise ValueError(
                f"backend {self.name} needs hints from the data, missing: {', '.join(missing)}. Pass batch.hints, "
                "or choose a backend that works from images alone (backend=vggt_1b, backend=da3_small, ...)"
            )
        views = tuple(images.shape[:2])
        shapes = {"depth": (*views, *images.shape[-2:]), "cameras": (*views, 4, 4), "frame_ids": views}
        for name in names:
            value = getattr(hints, name)
            found = len(value) if name == "scene_key" else getattr(value, "world_to_camera", value).shape
            expected = views[0] if name == "scene_key" else shapes.get(name, found)
            if found != expected:
                raise ValueError(f"hints.{name} must be {expected} for these images, got {found}")
        if "cameras" in names and hints.cameras is not None:
            poses, intrinsics = hints.cameras.world_to_camera[..., :3, :], hints.cameras.intrinsics
            finite = torch.isfinite(torch.cat((poses.flatten(-2), intrinsics.flatten(-2)), -1)).all(-1)
            bad = ~finite | (intrinsics[..., [0, 1], [0, 1]] <= 0).any(-1)  # [B, V]
            if bad.any():
                scene, view = bad.nonzero()[0].tolist()
                place = f"hints.cameras of scene {scene}, view {view}"
                raise ValueError(f"{place} are not finite or have no positive focal length: leave the view out")
        return hints

    def require_parallax(self, images: Tensor, hints: Hints | None) -> tuple[Hints, Cameras]:
        """Returns hints with cameras that see the scenes of ``images`` from several positions.

        Returns:
            The hints, and their cameras relative to view 0 of each scene, in float32.

        Raises:
            ValueError: if :meth:`check_images` or :meth:`require_hints` fails, or a scene has a single view or all its
                cameras are at the same position.
        """
        self.check_images(images)
        hints = self.require_hints(images, hints, "cameras")
        assert hints.cameras is not None
        cameras = relative_to_first(hints.cameras.map(Tensor.double)).map(Tensor.float)
        centers = torch.linalg.inv(cameras.world_to_camera)[..., :3, 3]
        if (centers == centers[:, :1]).all(-1).all(-1).any():
            raise ValueError(
                f"backend {self.name} estimates depth from parallax, but got a single view, or all cameras are at the "
                "same position: take photos from different positions, or choose a single-image backend "
                "(backend=vggt_1b, backend=da3_small, ...)"
            )
        return hints, cameras


@contextmanager
def seeded_initialisation(seed: int) -> Iterator[None]:
    """Context in which module initialisation depends on ``seed`` only; the global generator is left unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        yield
