"""One stage: matches features on planes with weights for every source and pixel."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from backends.sweep.correlate import GROUPS, SourceWarp, correlate
from backends.sweep.fused import HIDDEN, fused_volume
from backends.sweep.planes import Planes
from backends.sweep.volume import VolumeNet, chunks_of_views, expectation, mean_similarity


class Stage(NamedTuple):
    """Result of one stage.

    Attributes:
        logits: logits of the planes ``[V, D, h, w]``.
        position: positions of the planes, ``[V, D, h, w]`` or broadcastable; 0 is far, 1 is near.
        t: expected position ``[V, 1, h, w]``.
        mass: probability mass around it ``[V, 1, h, w]``.
    """

    logits: Tensor
    position: Tensor
    t: Tensor
    mass: Tensor


class Matching(nn.Module):
    """Weighted mean of the group-wise similarities with the sources, regularised to one logit per plane.

    The weight of a source depends on its similarity at the plane, and on its visibility in the pixel, estimated from
    how distinct its best plane is (at 1/8; the later stages take it over).

    Args:
        channels: channels of the regularisation.
        estimates: whether it estimates the visibility.
    """

    def __init__(self, channels: int, estimates: bool) -> None:
        super().__init__()
        self.weigh = nn.Sequential(nn.Conv2d(GROUPS, HIDDEN, 1), nn.ReLU(inplace=True), nn.Conv2d(HIDDEN, 1, 1))
        self.visible = nn.Linear(3, 1) if estimates else None
        self.volume = VolumeNet(channels)
        if self.visible:
            nn.init.zeros_(self.visible.weight)
            nn.init.zeros_(self.visible.bias)

    def forward(
        self,
        maps: Tensor,
        position: Tensor,
        planes: Planes,
        warp: SourceWarp,
        visible: Tensor | None = None,
        shown: Tensor | None = None,
    ) -> tuple[Stage, Tensor]:
        """Matches all views; without gradients, a few at a time to save memory.

        Args:
            maps: features of all views ``[V, C, h, w]``, of unit length per group.
            position: positions of the planes ``[V, D, h, w]`` or ``[V, D, 1, 1]``.
            planes: their unit.
            warp: correspondences of all views.
            visible: visibility of the pixels in the sources ``[V, n, h, w]``; None estimates it.
            shown: factor on the estimated visibility ``[V, 1, h, w]``.

        Returns:
            The stage, and the visibility ``[V, n, h, w]``.
        """
        views, count = position.shape[:2]
        inverse = planes.inverse(position).flatten(2).expand(-1, -1, maps.shape[-2] * maps.shape[-1])
        logits, seen = [], []
        for part in chunks_of_views(views):
            given = None if visible is None else visible[part]
            volume, weight = self._volume(maps, inverse[part], warp.select(part), given, shown)
            logits.append(self.volume(volume, count))
            seen.append(weight)
        every = torch.cat(logits)
        t, mass = expectation(every, position)
        return Stage(every, position, t, mass), torch.cat(seen)

    def _volume(
        self, maps: Tensor, inverse: Tensor, warp: SourceWarp, visible: Tensor | None, shown: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Mean similarity per group and mean weight ``[V D, GROUPS + 1, h, w]``, and visibility ``[V, n, h, w]``."""
        size, (views, sources) = (maps.shape[-2], maps.shape[-1]), warp.sources.shape
        compiled = maps.device.type == "cpu" and maps.dtype == torch.float32
        if compiled and not torch.is_grad_enabled() and shown is None:
            given = None if visible is None else visible.flatten(2)
            volume, visible = fused_volume(maps, inverse, warp, self.weigh, self.visible, given)
            return volume.view(-1, *size, GROUPS + 1).permute(0, 3, 1, 2), visible.unflatten(2, size)
        similarity, inside = correlate(maps, inverse, warp)  # [V, n, D, h w, G]
        images = similarity.reshape(-1, *size, GROUPS).permute(0, 3, 1, 2)
        score = self.weigh(images).reshape(inside.shape)  # [V, n, D, h w]
        if visible is None:
            assert self.visible is not None
            distinct = torch.stack((score.amax(2), score.mean(2), score.softmax(2).amax(2)), -1)
            visible = torch.sigmoid(self.visible(distinct)).reshape(views, sources, *size)
            if shown is not None:
                visible = visible * shown[warp.first : warp.first + views]
        weight = torch.sigmoid(score) * inside * visible.flatten(2)[:, :, None]
        return mean_similarity(similarity, weight, size), visible
