"""Networks that refine depth: a U-Net after the first stage, and the depth head, differentiable in the tokens."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.sweep.features import CONTEXT_COARSE, CONTEXT_FINE, upsample
from backends.sweep.tokens import DIM, TAPS

RESPONSE = 0.02  # change of log-depth per unit of the tokens' correction channels
_SWEPT = 4  # channels of the last stage that the head reads
CELLS = 2  # the correction channels hold CELLS x CELLS values per patch
_SPREAD = 48  # channels per cell after the tokens are spread over the cells
UPSAMPLING = 9 * 4  # logits of convex_upsample: 9 neighbours of each of 4 new pixels
_UNSURE = -2.5  # log-scale of the relative error before training
_LOG_DEPTH = 20.0  # maximum absolute log-depth: keeps depth finite for any tokens


def activate(x: Tensor) -> Tensor:
    """Leaky ReLU; residual sums without normalisation drift, and a plain ReLU would die below zero."""
    return F.leaky_relu(x, 0.1)


class PlainBlock(nn.Module):
    """Residual block of two 3x3 convolutions, without normalisation, as absolute values matter here."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, 1, 1)
        self.second = nn.Conv2d(channels, channels, 3, 1, 1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[N, C, h, w]`` to the same shape."""
        return x + self.second(activate(self.first(activate(x))))


class RefineNet(nn.Module):
    """U-Net at 1/8, 1/16 and 1/32 of the image that fills in depth where matching fails (bare walls, occlusions).

    Its outputs are zero before training.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        fine, middle, coarse = 64, 96, 128
        self.begin = nn.Sequential(nn.Conv2d(inputs, fine, 3, 1, 1), PlainBlock(fine))
        self.down = nn.Sequential(nn.Conv2d(fine, middle, 3, 2, 1), PlainBlock(middle))
        self.bottom = nn.Sequential(nn.Conv2d(middle, coarse, 3, 2, 1), PlainBlock(coarse), PlainBlock(coarse))
        self.up = nn.Conv2d(coarse, middle, 1)
        self.merge = PlainBlock(middle)
        self.up_fine = nn.Conv2d(middle, fine, 1)
        self.merge_fine = PlainBlock(fine)
        self.end = nn.Conv2d(fine, outputs, 3, 1, 1)
        nn.init.zeros_(self.end.weight)
        nn.init.zeros_(self.end.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[N, inputs, h, w]`` to ``[N, outputs, h, w]``."""
        fine = self.begin(x)
        middle = self.down(activate(fine))
        middle = self.merge(middle + upsample(self.up(self.bottom(activate(middle))), middle))
        fine = self.merge_fine(fine + upsample(self.up_fine(middle), fine))
        return self.end(activate(fine))


def convex_upsample(x: Tensor, mask: Tensor) -> Tensor:
    """Upsamples ``[V, C, h, w]`` by two, each new pixel a convex combination of 3x3 neighbours (RAFT).

    ``mask`` holds the logits of the weights ``[V, UPSAMPLING, h, w]``.
    """
    views, channels, height, width = x.shape
    weights = mask.unflatten(1, (9, 4)).softmax(1)  # [V, 9, 4, h, w]
    around = F.unfold(F.pad(x, (1, 1, 1, 1), mode="replicate"), 3).view(views, channels, 9, 1, height, width)
    return F.pixel_shuffle((around * weights[:, None]).sum(2).flatten(1, 2), 2)


def slices(probability: Tensor, bins: int) -> Tensor:
    """Sums the probability of the planes ``[V, D, h, w]`` into ``bins`` channels, for any D."""
    flat = probability.flatten(2).transpose(1, 2)  # [V, h w, D]
    pooled = F.adaptive_avg_pool1d(flat, bins) * (probability.shape[1] / bins)
    return torch.unflatten(pooled.transpose(1, 2), 2, probability.shape[-2:])


class DepthHead(nn.Module):
    """Predicts depth: log-depth is that of the last stage plus two corrections.

    The first correction is linear: how far the first four channels of the last tap, one per 2x2 cell of the patch, have
    moved, times ``RESPONSE``. It makes depth change smoothly with the tokens. The second is predicted from all taps by
    convolutions.
    """

    def __init__(self) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(DIM) for _ in range(TAPS))
        self.spread = nn.Linear(TAPS * DIM, CELLS**2 * _SPREAD)
        self.coarse = nn.Sequential(nn.Conv2d(_SPREAD + CONTEXT_COARSE, 64, 3, 1, 1), PlainBlock(64), PlainBlock(64))
        self.lift = nn.Conv2d(64, 48, 1)
        self.fine = nn.Sequential(nn.Conv2d(48 + CONTEXT_FINE + _SWEPT, 48, 3, 1, 1), PlainBlock(48))
        self.out = nn.Conv2d(48, 2, 3, 1, 1)
        self.mask = nn.Sequential(nn.Conv2d(48, 64, 1), nn.ReLU(), nn.Conv2d(64, UPSAMPLING, 1))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)  # type: ignore[arg-type]

    def forward(
        self,
        taps: tuple[Tensor, ...],
        context: Tensor,
        context_fine: Tensor,
        swept: Tensor,
        origin: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Decodes depth and the log-scale of its relative error, each ``[V, 4 h, 4 w]``.

        Args:
            taps: tokens ``[V, P, DIM]`` of each tap.
            context: ``[V, CONTEXT_COARSE, h, w]``, at 1/4 of the image.
            context_fine: ``[V, CONTEXT_FINE, 2 h, 2 w]``.
            swept: log-depth of the last stage and three channels on its reliability, ``[V, 4, 2 h, 2 w]``.
            origin: the first four channels of the last tap for which the first correction is zero ``[V, P, 4]``.
        """
        grid = (context.shape[-2] // CELLS, context.shape[-1] // CELLS)
        # tokens to cells of half a patch: [V, P, DIM] to [V, C, h, w]
        said = torch.cat([norm(tap) for norm, tap in zip(self.norms, taps, strict=True)], -1)
        said = F.pixel_shuffle(self.spread(said).mT.unflatten(-1, grid), CELLS)  # [V, C, h, w]
        correction = taps[-1][..., : CELLS**2] - origin
        correction = F.pixel_shuffle(correction.mT.unflatten(-1, grid), CELLS)
        x = self.lift(activate(self.coarse(torch.cat((said, context), 1))))
        # to the last stage's resolution: [V, ., 2 h, 2 w]
        x, correction = (upsample(each, swept) for each in (x, correction))
        center = swept[:, :1].mean((-1, -2), keepdim=True)
        x = activate(self.fine(torch.cat((x, context_fine, swept[:, :1] - center, swept[:, 1:]), 1)))
        log_depth, log_scale = self.out(x).chunk(2, 1)
        log_depth = swept[:, :1] + RESPONSE * correction + 0.25 * log_depth
        both = torch.cat((log_depth, log_scale + _UNSURE), 1)
        full = convex_upsample(both, self.mask(x))
        return full[:, 0].clamp(-_LOG_DEPTH, _LOG_DEPTH).exp(), full[:, 1]
