"""Learned plane-sweep multi-view stereo as a backend."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from backends.base import Backend
from backends.sweep.network import PosedViews, SweepEncoding, SweepNet
from backends.sweep.tokens import DIM, PATCH, TAPS
from backends.sweep.views import choose_sources
from backends.weights import Weights
from vg2gt.geometry.precision import full_precision
from vg2gt.types import Geometry, Hints, Tokens

SHIPPED = Path(__file__).parent / "weights" / "sweep.safetensors"
_LICENCE = "Apache-2.0"
_CONFIDENCE = (0.37, 400.0)  # bounds of 1 / expected relative error


class PlaneSweepBackend(Backend):
    """Base class of plane sweeps: encodes one scene after the other, and decodes depth and its expected error.

    Depth has the unit of the camera translations. ``depth_conf`` is one over the expected relative error of depth.

    Args:
        name: name in checkpoints and messages.
        make: builds the network, whose ``head`` takes taps and ``state``.
        pretrained: whether to load weights from ``path``; otherwise random.
        path: safetensors file with weights.
        seed: seed of random weights.

    Attributes:
        state: fields of the encoding that the head takes after the taps.
    """

    needs_cameras: ClassVar[bool] = True
    state: ClassVar[tuple[str, ...]] = ("context", "context_fine", "swept")
    network: Any

    def __init__(self, name: str, make: Callable[[], nn.Module], pretrained: bool, path: str | None, seed: int) -> None:
        super().__init__(name, PATCH, (DIM,) * TAPS, _LICENCE, needs_hints=True, predicts_cameras=False)
        self.network = Weights(name, _LICENCE, pretrained, None, None, path, seed).build(make)
        self.freeze()

    @abstractmethod
    def match(self, views: PosedViews, depth_range: Tensor | None) -> Any:
        """Encodes the views of one scene; ``depth_range`` is the near and far ``[2]`` of the hints, if they have it."""

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """Matches the views; see :meth:`Backend.encode`. The world frame is that of view 0, in the cameras' unit.

        Raises:
            ValueError: also if the views have no parallax (one view, or all cameras at the same position).
        """
        hints, cameras = self.require_parallax(images, hints)
        encoded = []
        with full_precision(images):
            for scene, pictures in enumerate(images.float()):
                views = PosedViews(pictures, cameras.world_to_camera[scene], cameras.intrinsics[scene])
                given = hints.depth_range
                encoded.append(self.match(views, None if given is None else given[scene].float()))
        taps = [torch.stack([each.taps[tap] for each in encoded]) for tap in range(TAPS)]
        state = {name: torch.stack([getattr(each, name) for each in encoded]) for name in self.state}
        camera = taps[-1].mean(2)  # no camera token, as the network predicts no cameras: use the mean patch token
        return replace(self.as_tokens(images, taps, camera), state=state | {"cameras": cameras})

    def decode(self, tokens: Tokens) -> Geometry:
        """Decodes depth and its expected error; see :meth:`Backend.decode`."""
        scenes, views = tokens.camera.shape[:2]
        with full_precision(tokens.camera):
            taps = tuple(tap.float().flatten(0, 1) for tap in tokens.patch)
            depth, log_scale = self.network.head(taps, *(tokens.state[name].flatten(0, 1) for name in self.state))
            confidence = torch.exp(-log_scale).clamp(*_CONFIDENCE)
        depth, confidence = (each.unflatten(0, (scenes, views)) for each in (depth, confidence))
        return Geometry(depth, confidence, tokens.state["cameras"], torch.ones_like(depth[:, 0, 0, 0]))


class SweepBackend(PlaneSweepBackend):
    """Plane-sweep multi-view stereo (needs cameras).

    Every view is matched with the views that overlap it best, on planes between a near and a far depth. Preliminary
    wide sweeps find this range, starting from the cameras alone or from the range in the hints. Depth has the unit of
    the camera translations. ``depth_conf`` is one over the expected relative error of depth.

    Args:
        pretrained: whether to load weights, those shipped with the package unless ``path`` is given; otherwise random.
        path: safetensors file with other weights, such as your own training.
        planes: number of planes of the first of the two sweeps; at least 8.
        sources: number of views that each view is matched with; at least 1.
        seed: seed of random weights.

    Raises:
        FileNotFoundError: if the weights cannot be found.
        ValueError: if they do not fit, or a number is out of range.
    """

    def __init__(
        self, pretrained: bool = True, path: str | None = None, planes: int = 48, sources: int = 3, seed: int = 0
    ) -> None:
        if planes < 8 or sources < 1:
            raise ValueError(f"backend.planes must be >= 8 and backend.sources >= 1, got {planes} and {sources}")
        super().__init__("sweep", SweepNet, pretrained, path or (str(SHIPPED) if pretrained else None), seed)
        self.planes, self.sources = planes, sources

    def match(self, views: PosedViews, depth_range: Tensor | None) -> SweepEncoding:
        """Finds the depth range and runs the sweeps; see :meth:`PlaneSweepBackend.match`."""
        features = self.network.features(views.images)
        found = self.network.find_range(features, views, self.sources, depth_range)
        sources = choose_sources(views.world_to_camera, views.intrinsics, views.size, found, self.sources)
        return self.network.encode(features, views, found, sources, self.planes)
