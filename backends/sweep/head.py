"""Depth head of the plane sweep: refines the swept depth with the tokens; differentiable in the tokens."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.features import CONTEXT_COARSE, CONTEXT_FINE
from backends.sweep.refine import PlainBlock, activate, convex_upsample
from backends.sweep.tokens import DIM, TAPS

RESPONSE = 0.02  # change of log-depth per unit of the tokens' correction channels
CELLS = 2  # the correction channels hold CELLS x CELLS values per patch
_SPREAD = 48  # channels per cell after the tokens are spread over the cells
_UNSURE = -2.5  # log-scale of the relative error before training


class DepthHead(nn.Module):
    """Predicts log-depth as that of the sweep plus two corrections.

    The first correction is linear: the first four channels of the last tap, one per 2x2 cell of the patch, times
    ``RESPONSE``. It makes depth change smoothly with the tokens. The second is predicted from all taps by convolutions.
    """

    def __init__(self) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(DIM) for _ in range(TAPS))
        self.spread = nn.Linear(TAPS * DIM, CELLS**2 * _SPREAD)
        self.coarse = nn.Sequential(nn.Conv2d(_SPREAD + CONTEXT_COARSE, 64, 3, 1, 1), PlainBlock(64), PlainBlock(64))
        self.lift = nn.Conv2d(64, 48, 1)
        self.fine = nn.Sequential(nn.Conv2d(48 + CONTEXT_FINE + 2, 48, 3, 1, 1), PlainBlock(48))
        self.out = nn.Conv2d(48, 2, 3, 1, 1)
        self.mask = nn.Sequential(nn.Conv2d(48, 64, 1), nn.ReLU(), nn.Conv2d(64, 9 * 4, 1))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)  # type: ignore[arg-type]

    def forward(
        self, taps: tuple[Tensor, ...], grid: tuple[int, int], context: Tensor, context_fine: Tensor, swept: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Decodes log-depth and the log-scale of its error, each ``[V, 4 h, 4 w]``.

        Args:
            taps: tokens ``[V, P, DIM]`` of each tap.
            grid: patches per axis.
            context: ``[V, CONTEXT_COARSE, h, w]``, at 1/4 of the image.
            context_fine: ``[V, CONTEXT_FINE, 2 h, 2 w]``.
            swept: log-depth of the sweep and its probability, ``[V, 2, 2 h, 2 w]``.
        """
        # tokens to cells of half a patch: [V, P, DIM] to [V, C, h, w]
        said = torch.cat([norm(tap) for norm, tap in zip(self.norms, taps, strict=True)], -1)
        said = F.pixel_shuffle(self.spread(said).mT.unflatten(-1, grid), CELLS)  # [V, C, h, w]
        correction = F.pixel_shuffle(taps[-1][..., : CELLS**2].mT.unflatten(-1, grid), CELLS)
        x = self.lift(activate(self.coarse(torch.cat((said, context), 1))))
        # to the sweep's resolution: [V, ., 2 h, 2 w]
        size = swept.shape[-2:]
        x, correction = (
            F.interpolate(each, size=size, mode="bilinear", align_corners=False) for each in (x, correction)
        )
        center = swept[:, :1].mean((-1, -2), keepdim=True)
        x = activate(self.fine(torch.cat((x, context_fine, swept[:, :1] - center, swept[:, 1:]), 1)))
        log_depth, log_scale = self.out(x).float().chunk(2, 1)
        log_depth = swept[:, :1] + RESPONSE * correction.float() + 0.25 * log_depth
        both = torch.cat((log_depth, log_scale + _UNSURE), 1)
        full = convex_upsample(both, self.mask(x).float())
        return full[:, 0], full[:, 1]
