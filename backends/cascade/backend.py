"""The cascade plane sweep as a backend."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from backends.cascade.network import CascadeEncoding, CascadeNet
from backends.cascade.planes import coarse_sources
from backends.sweep.backend import PlaneSweepBackend
from backends.sweep.network import PosedViews


class CascadeBackend(PlaneSweepBackend):
    """Cascade plane-sweep multi-view stereo (needs cameras).

    Every view is matched with other views over all depths from a fraction of the cameras' distance to infinity; what
    does not match is filled in, and two narrower stages refine the depth. A depth range in the hints is not used.
    Depth has the unit of the camera translations. ``depth_conf`` is one over the expected relative error of depth.

    Args:
        pretrained: whether to load weights from ``path``; otherwise random.
        path: safetensors file with weights.
        seed: seed of random weights.

    Raises:
        FileNotFoundError: if the weights cannot be found, or ``path`` is missing.
        ValueError: if they do not fit.
    """

    state: ClassVar[tuple[str, ...]] = ("context", "context_fine", "swept", "origin")

    def __init__(self, pretrained: bool = True, path: str | None = None, seed: int = 0) -> None:
        super().__init__("cascade", CascadeNet, pretrained, path, seed)

    def match(self, views: PosedViews, depth_range: Tensor | None) -> CascadeEncoding:
        """Matches the views of one scene over all depths; see :meth:`PlaneSweepBackend.match`."""
        sources = coarse_sources(views.world_to_camera, views.intrinsics, views.size)
        return self.network.encode(self.network.features(views.images), views, sources)
