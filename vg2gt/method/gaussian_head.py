"""Self-splitting Gaussian head: every voxel becomes K Gaussians (paper, Fine-level Gaussian Scene Decoding)."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.geometry.precision import full_precision
from vg2gt.geometry.rotations import matrix_to_quat, multiply_quats
from vg2gt.geometry.spherical_harmonics import MAX_DEGREE, rgb_to_sh
from vg2gt.memory import Cap, note_sizes
from vg2gt.method.additions.surfel import SurfelStart, surfel_start
from vg2gt.types import Gaussians, Voxels, check_choice

Anchor = Literal["centroid", "center"]
Start = Literal["plain", "surfel"]
MAX_SCALE = 2.0  # voxels; the paper's upper bound
_PLAIN_SCALE = 0.5  # voxels; initial scale of the plain start
MIN_SCALE = 1e-3  # voxels; renderers need a finite inverse
_INITIAL_ALPHA = 0.95  # initial joint opacity of a voxel's K Gaussians (plain start)
_SURFEL_ALPHA = 0.88  # initial opacity of each Gaussian (surfel start)


class GaussianHead(nn.Module):
    """Two-layer MLP from a voxel's feature to K sets of Gaussian parameters.

    With the ``plain`` start (the paper's), the Gaussians of an untrained head are near the voxel's anchor and have a
    standard deviation of half a voxel, the voxel's colour and a joint opacity of 0.95. With the ``surfel`` start, they
    are on the voxel's surface along its colour gradient (:mod:`vg2gt.method.additions.surfel`), and the network
    predicts residuals in that frame.

    Args:
        in_channels: width of the voxel features.
        splits: K, Gaussians per voxel.
        sh_degree: degree L of the spherical harmonics, 0 to 3.
        anchor: means are offsets from the voxel's ``centroid`` or, as in the paper, from its ``center``.
        start: ``plain``, or ``surfel``, which needs voxels with moments.
        max_offset: rho, largest predicted offset along an axis in voxels.
        max_gaussians: largest number of Gaussians per scene; above it the least opaque are dropped, with a warning in
            the log and the metric ``train/gaussians_dropped``. None keeps all.
    """

    def __init__(
        self,
        in_channels: int,
        splits: int = 2,
        sh_degree: int = 0,
        anchor: Anchor = "centroid",
        start: Start = "plain",
        max_offset: float = 1.0,
        max_gaussians: int | None = None,
    ) -> None:
        super().__init__()
        if splits < 1:
            raise ValueError(f"gaussians.splits must be at least 1, got {splits}")
        if not 0 <= sh_degree <= MAX_DEGREE:
            raise ValueError(f"gaussians.sh_degree must be 0 to {MAX_DEGREE}, got {sh_degree}")
        check_choice("gaussians.anchor", anchor, Anchor)
        check_choice("gaussians.start", start, Start)
        self.splits = splits
        self.start: Start = start
        self.sh_degree = sh_degree
        self.anchor = anchor
        self.max_offset = max_offset
        self.cap = Cap("model.gaussians.max_gaussians", max_gaussians, "Gaussians", "least opaque")
        bands = (sh_degree + 1) ** 2
        self.parts = (3, 3, 4, 1, 3 * bands)
        self.hidden = nn.Linear(in_channels, in_channels)
        self.out = nn.Linear(in_channels, splits * sum(self.parts))
        # small random weights: with zeros, the K splits would stay identical
        nn.init.normal_(self.out.weight, std=0.02)
        nn.init.zeros_(self.out.bias)
        plain = 1 - (1 - _INITIAL_ALPHA) ** (1 / splits)
        alpha = plain if start == "plain" else _SURFEL_ALPHA
        self.opacity_bias = math.log(alpha / (1 - alpha))
        self.sh_gain: Tensor
        self.register_buffer("sh_gain", harmonic_gains(sh_degree), persistent=False)

    def forward(self, voxels: Voxels) -> Gaussians:
        """Splits every voxel.

        Args:
            voxels: refined voxels of B scenes.

        Returns:
            ``M * splits`` Gaussians (fewer if ``max_gaussians`` drops some), those of a voxel adjacent, with scales in
            (0, 2 v) and unit quaternions. With the plain start, means are within ``max_offset`` v of the anchor along
            each axis.
        """
        # features [M, C] to K sets of raw parameters: [M, K, ...]
        raw = self.out(F.gelu(self.hidden(voxels.features))).float().unflatten(-1, (self.splits, -1))
        with full_precision(raw):  # geometry
            return self._gaussians(raw, voxels)

    def _gaussians(self, raw: Tensor, voxels: Voxels) -> Gaussians:
        offset, scale, rotation, opacity, color = raw.split(self.parts, -1)
        size = voxels.voxel_size[voxels.batch][:, None, None]
        anchor = voxels.centroid if self.anchor == "centroid" else voxels.centers
        offset = self.max_offset * torch.tanh(offset)
        # created on the device: a copy from the host would synchronise
        identity = torch.eye(4, dtype=rotation.dtype, device=rotation.device)[0]
        quats = F.normalize(rotation + identity, dim=-1)
        start_scale, colors = scale.new_full((), _PLAIN_SCALE), voxels.colors[:, None]
        # ours: the parameters are residuals to the surfel start
        if self.start == "surfel":
            start = self._surfels(voxels)
            offset = start.offsets + torch.einsum("mij,mkj->mki", start.frame, offset)
            quats = multiply_quats(matrix_to_quat(start.frame)[:, None], quats)
            start_scale, colors = start.scales, (colors + start.colors).clamp(0, 1)
        # residual positions and colours, bounded scales and opacities: [M, K, ...]
        means = anchor[:, None] + size * offset
        scale = MAX_SCALE * torch.sigmoid(scale + torch.logit(start_scale / MAX_SCALE))
        scales = size * scale.clamp(min=MIN_SCALE)
        opacities = torch.sigmoid(opacity[..., 0] + self.opacity_bias)
        base = F.pad(rgb_to_sh(colors)[:, :, None], (0, 0, 0, len(self.sh_gain) - 1))
        sh = base + self.sh_gain * color.unflatten(-1, (-1, 3))
        # pack: [M * K]
        batch = voxels.batch.repeat_interleave(self.splits)
        note_sizes({"Gaussians": len(batch)})
        parts = Gaussians(*(part.flatten(0, 1) for part in (means, quats, scales, opacities, sh)), batch=batch)
        keep = self.cap(parts.opacities, batch)
        return parts if keep is None else parts.map(lambda tensor: tensor[keep])

    def _surfels(self, voxels: Voxels) -> SurfelStart:
        if voxels.moments is None:
            raise ValueError("model.gaussians.start=surfel requires model.fine.moments=true")
        start = surfel_start(voxels.moments, self.splits)
        if self.anchor == "centroid":
            return start
        shift = ((voxels.centroid - voxels.centers) / voxels.voxel_size[voxels.batch, None]).detach()
        return replace(start, offsets=start.offsets + shift[:, None])


def harmonic_gains(degree: int) -> Tensor:
    """Returns factors ``[(degree + 1)^2, 1]`` that make predicted SH coefficients of higher degrees start small."""
    degrees = [each for each in range(degree + 1) for _ in range(2 * each + 1)]
    return torch.tensor([0.1 * 0.25**each if each else 1.0 for each in degrees])[:, None]
