"""Learned plane-sweep multi-view stereo as a backend."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from backends.base import Backend
from backends.sweep.network import PosedViews, SweepNet
from backends.sweep.tokens import DIM, PATCH, TAPS
from backends.sweep.views import sources_of
from backends.weights import Weights
from vg2gt.geometry.precision import full_precision
from vg2gt.types import Geometry, Hints, Tokens

SHIPPED = Path(__file__).parent / "weights" / "sweep.safetensors"
_LICENCE = "Apache-2.0"
_CONFIDENCE = (0.37, 400.0)  # bounds of 1 / expected relative error
_STATE = ("context", "context_fine", "swept", "origin")  # fields of the encoding that the head takes after the taps


class SweepBackend(Backend):
    """Plane-sweep multi-view stereo (needs cameras).

    Every view is matched with up to six other views over all depths from a fraction of the cameras' distance to
    infinity; what does not match is filled in, and two narrower stages refine the depth. Of the hints, only the cameras
    are used.
    Depth has the unit of the camera translations. ``depth_conf`` is one over the expected relative error of depth.

    Args:
        pretrained: whether to load weights, those shipped with the package unless ``path`` is given; otherwise random.
        path: safetensors file with other weights, such as your own training.
        seed: seed of random weights.

    Raises:
        FileNotFoundError: if the weights cannot be found.
        ValueError: if they do not fit.
    """

    needs_cameras: ClassVar[bool] = True

    def __init__(self, pretrained: bool = True, path: str | None = None, seed: int = 0) -> None:
        super().__init__("sweep", PATCH, (DIM,) * TAPS, _LICENCE, needs_hints=True, predicts_cameras=False)
        path = path or (str(SHIPPED) if pretrained else None)
        self.network: SweepNet = Weights("sweep", _LICENCE, pretrained, None, None, path, seed).build(SweepNet)
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """Matches the views; see :meth:`Backend.encode`. The world frame is that of view 0, in the cameras' unit.

        Raises:
            ValueError: also if the views have no parallax (one view, or all cameras at the same position).
        """
        _, cameras = self.require_parallax(images, hints)
        encoded = []
        with full_precision(images):
            for scene, pictures in enumerate(images.float()):
                views = PosedViews(pictures, cameras.world_to_camera[scene], cameras.intrinsics[scene])
                sources = sources_of(views.world_to_camera, views.intrinsics, views.size)
                encoded.append(self.network.encode(self.network.features(views.images), views, sources))
        taps = [torch.stack([each.taps[tap] for each in encoded]) for tap in range(TAPS)]
        state = {name: torch.stack([getattr(each, name) for each in encoded]) for name in _STATE}
        camera = taps[-1].mean(2)  # no camera token, as the network predicts no cameras: use the mean patch token
        return replace(self.as_tokens(images, taps, camera), state=state | {"cameras": cameras})

    def decode(self, tokens: Tokens) -> Geometry:
        """Decodes depth and its expected error; see :meth:`Backend.decode`."""
        scenes, views = tokens.camera.shape[:2]
        with full_precision(tokens.camera):
            taps = tuple(tap.float().flatten(0, 1) for tap in tokens.patch)
            depth, log_scale = self.network.head(taps, *(tokens.state[name].flatten(0, 1) for name in _STATE))
            confidence = torch.exp(-log_scale).clamp(*_CONFIDENCE)
        depth, confidence = (each.unflatten(0, (scenes, views)) for each in (depth, confidence))
        return Geometry(depth, confidence, tokens.state["cameras"], torch.ones_like(depth[:, 0, 0, 0]))
