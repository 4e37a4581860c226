"""Image features of the cascade: those of the plane sweep, and matching features at 1/8."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.features import MATCH_COARSE, FeaturePyramid, unit_groups


class CascadeFeatures(NamedTuple):
    """Features of N images; ``h, w`` is 1/8 of the image size.

    Attributes:
        match: matching features at 1/8, 1/4 and 1/2, each group of channels of unit length.
        context: ``[N, CONTEXT_COARSE, 2 h, 2 w]``.
        context_fine: ``[N, CONTEXT_FINE, 4 h, 4 w]``.
    """

    match: tuple[Tensor, Tensor, Tensor]
    context: Tensor
    context_fine: Tensor


class CascadePyramid(FeaturePyramid):
    """Feature pyramid network from 1/2 to 1/16 of the image, with matching features at three resolutions."""

    def __init__(self) -> None:
        super().__init__()
        self.eighth = nn.Conv2d(64, MATCH_COARSE, 3, 1, 1)
        nn.init.zeros_(self.eighth.weight)
        nn.init.zeros_(self.eighth.bias)  # type: ignore[arg-type]

    def forward(self, images: Tensor) -> CascadeFeatures:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Extracts features of images ``[N, 3, H, W]`` in [0, 1]; H and W multiples of 8."""
        half, quarter, eighth = self.pyramid(images)
        coarse = unit_groups(self.coarse(quarter))
        pooled = F.avg_pool2d(coarse, 2) + self.eighth(eighth)
        match = (unit_groups(pooled), coarse, unit_groups(self.fine(half)))
        return CascadeFeatures(match, self.context(quarter), self.context_fine(half))
