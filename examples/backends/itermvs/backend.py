"""IterMVS as a backend: tokens are its hidden states, decoded by its depth head and upsampling."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from backends.base import Backend
from backends.sweep.views import choose_sources
from backends.weights import Weights
from examples.backends.itermvs.depth_range import range_of, wide_range
from examples.backends.itermvs.matching import Projections
from examples.backends.itermvs.network import HIDDEN, STRIDE, IterMVSNet
from vg2gt.geometry.cameras import resize_intrinsics
from vg2gt.geometry.precision import full_precision
from vg2gt.types import Cameras, Geometry, Hints, Tokens

_PATCH = 8
_CELLS = _PATCH // STRIDE  # hidden states of a patch along each axis
_LEAST_CONFIDENCE = 1e-6
_CONFIDENT = 0.3  # confidence above which a pixel counts for the range


class IterMVSBackend(Backend):
    """IterMVS (Wang et al., CVPR 2022; needs cameras).

    Every view is matched with the views that overlap it best. A patch token holds the hidden states of 2x2 cells of 4x4
    pixels after the last update. ``depth_conf`` is the predicted probability that depth is accurate to 1/500 of the
    range of inverse depth. The range is that in the hints; without one, the network first runs at half the size over
    all depths that the cameras can measure.

    Args:
        pretrained: whether to load published weights from ``path``; otherwise random.
        path: checkpoint of the published code, ``checkpoints/*/model_000015.ckpt``.
        sources: number of views that each view is matched with; at least 1.
        iterations: number of updates; at least 1.
        seed: seed of random weights.

    Raises:
        FileNotFoundError: if the weights cannot be found.
        ValueError: if they do not fit, or a number is out of range.
    """

    needs_cameras: ClassVar[bool] = True

    def __init__(
        self, pretrained: bool = True, path: str | None = None, sources: int = 4, iterations: int = 4, seed: int = 0
    ) -> None:
        if sources < 1 or iterations < 1:
            raise ValueError(f"backend.sources and backend.iterations must be >= 1, got {sources} and {iterations}")
        licence = "MIT (https://github.com/FangjinhuaWang/IterMVS)"
        super().__init__("itermvs", _PATCH, (HIDDEN * _CELLS**2,), licence, needs_hints=True, predicts_cameras=False)
        unused = ("module.feature_net.inner3.",)
        weights = Weights(self.name, licence, pretrained, None, None, path, seed, "module.", unused, entry="model")
        self.network = weights.build(IterMVSNet)
        self.sources, self.iterations = sources, iterations
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """Matches the views; see :meth:`Backend.encode`. The world frame is that of view 0, in the cameras' unit.

        Raises:
            ValueError: also if the views have no parallax (one view, or all cameras at the same position).
        """
        hints, cameras = self.require_parallax(images, hints)
        states, contexts, ranges = [], [], []
        with full_precision(images):
            for scene, pictures in enumerate(2 * images.float() - 1):
                views = cameras.scene(scene)
                given = hints.depth_range
                ranges.append(self.find_range(pictures, views) if given is None else given[scene].float())
                hidden, context = self._match(pictures, views, ranges[-1])
                states.append(hidden)
                contexts.append(context)
        patch = F.pixel_unshuffle(torch.cat(states), _CELLS).flatten(2).mT.unflatten(0, images.shape[:2])
        state = {"context": torch.stack(contexts), "depth_range": torch.stack(ranges), "cameras": cameras}
        return replace(self.as_tokens(images, [patch], patch.mean(2)), state=state)

    def find_range(self, images: Tensor, cameras: Cameras) -> Tensor:
        """Finds near and far ``[2]`` from the confident depths of a search at half the size.

        Args:
            images: ``[V, 3, H, W]`` in [-1, 1].
            cameras: cameras of this scene (B = 1).
        """
        wide = wide_range(cameras.world_to_camera[0])
        small = F.avg_pool2d(F.pad(images, (0, images.shape[-1] % 16, 0, images.shape[-2] % 16), mode="replicate"), 2)
        half = replace(cameras, intrinsics=resize_intrinsics(cameras.intrinsics, 0.5, 0.5))
        depth, confidence = self.network.decode(*self._match(small, half, wide), wide)
        return range_of(depth, confidence > _CONFIDENT, wide)

    def _match(self, images: Tensor, cameras: Cameras, depth_range: Tensor) -> tuple[Tensor, Tensor]:
        """Returns hidden states ``[V, HIDDEN, h, w]`` and features for the upsampling ``[V, 32, h, w]``."""
        size = (images.shape[-2], images.shape[-1])
        views = (cameras.world_to_camera[0], cameras.intrinsics[0])
        sources = choose_sources(*views, size, depth_range, self.sources)
        features = self.network.feature_net(images)
        hidden = self.network.encode(features, Projections.between(*views, sources), depth_range, self.iterations)
        return hidden, features[2]

    def decode(self, tokens: Tokens) -> Geometry:
        """Decodes depth and confidence; see :meth:`Backend.decode`."""
        state, views = tokens.state, tokens.camera.shape[:2]
        with full_precision(tokens.camera):
            cells = tokens.patch[0].float().flatten(0, 1).mT.unflatten(-1, tokens.grid)
            ranges = state["depth_range"].repeat_interleave(views[1], 0)
            both = self.network.decode(F.pixel_shuffle(cells, _CELLS), state["context"].flatten(0, 1), ranges)
        depth, confidence = (each.unflatten(0, views) for each in both)
        confidence = confidence.clamp_min(_LEAST_CONFIDENCE)
        return Geometry(depth, confidence, state["cameras"], torch.ones_like(depth[:, 0, 0, 0]))
