"""Depth Anything 3's metric depth network, alone and as the yardstick of the relative one (nested)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.base import Backend, full_precision, half_precision_on_gpu
from backends.da3.backbone import Backbone, PretrainedBackbone
from backends.da3.backend import NESTED_PARTS, DA3Backend
from backends.dpt import DPT, in_chunks
from backends.normalization import normalize_images
from backends.weights import Weights
from vg2gt.types import Geometry, Hints, Tokens

CANONICAL_FOCAL = 300.0  # pixels at network resolution
SKY_THRESHOLD = 0.3
FAR_QUANTILE = 0.99
MIN_PIXELS = 10
MAX_SAMPLES = 100_000  # for quantiles


class DA3MetricNetwork(nn.Module):
    """Single-view backbone and a head for depth and sky; names and shapes as published."""

    def __init__(self, backbone: Backbone, head: DPT) -> None:
        super().__init__()
        self.backbone = PretrainedBackbone(backbone)
        self.head = head


class DepthAndSky(nn.Module):
    """The two outputs of one DPT as channels: depth (raw) and sky (raw)."""

    def __init__(self, head: DPT) -> None:
        super().__init__()
        self.head = head

    def forward(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> Tensor:
        """Maps four ``[N, P, D]`` token maps to ``[N, 2, H, W]`` without activation."""
        fused = self.head.fuse(tokens, grid)
        layers = self.head.scratch
        outputs = [layers.get_submodule(name)(fused) for name in ("output_conv2", "sky_output_conv2")]
        return torch.cat(outputs, 1)


class DA3MetricBackend(Backend):
    """DA3's metric network: depth in metres from the data's cameras, which it needs; confidence 1.

    Depth is the network's output times the mean focal length (pixels) / 300; sky gets the far end of the scene.

    Args:
        name: stands in checkpoints and messages.
        licence: of the weights.
        dim: channels C of the tokens.
        depth: blocks.
        num_heads: attention heads.
        taps: four blocks whose tokens feed the head.
        features: DPT width.
        out_channels: DPT channels of the four taps.
        image_size: native image edge.
        patch_size: in pixels.
        pretrained: whether to load weights; random ones (by ``seed``) otherwise.
        repo: Hugging Face repository of the weights.
        revision: its branch, tag or commit.
        path: local weight file or folder instead.
        prefix: of the names in the file.
        seed: of random weights.
        head_chunk: views decoded at a time; None decodes all at once.
    """

    def __init__(
        self,
        name: str,
        licence: str,
        dim: int,
        depth: int,
        num_heads: int,
        taps: Sequence[int],
        features: int,
        out_channels: Sequence[int],
        image_size: int = 518,
        patch_size: int = 14,
        pretrained: bool = True,
        repo: str | None = None,
        revision: str | None = None,
        path: str | None = None,
        prefix: str = "model.",
        seed: int = 0,
        head_chunk: int | None = 8,
    ) -> None:
        super().__init__(name, patch_size, (dim,) * len(taps), licence, is_metric=True, needs_hints=True)
        self.taps = tuple(taps)
        self.head_chunk = head_chunk

        def make() -> DA3MetricNetwork:
            backbone = Backbone(dim, depth, num_heads, "mlp", None, image_size, patch_size)
            head = DPT(dim, features, out_channels, 1, patch_size, normalize=False, position_weight=0, sky=True)
            return DA3MetricNetwork(backbone, head)

        ignorable = tuple(part for part in NESTED_PARTS if part != prefix)
        self.weights = Weights(name, licence, pretrained, repo, revision, path, seed, prefix, ignorable)
        self.network = self.weights.build(make)
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """See :meth:`Backend.encode`; needs ``hints.cameras``, whose translations must be in metres."""
        self.check_images(images)
        cameras = self.require_hints(images, hints, "cameras").cameras
        size = (images.shape[-2], images.shape[-1])
        with half_precision_on_gpu(images):
            patch, camera = self.network.backbone.pretrained(normalize_images(images), self.taps)
        grid = (size[0] // self.patch_size, size[1] // self.patch_size)
        return Tokens(tuple(tap.float() for tap in patch), camera.float(), grid, size, {"cameras": cameras})

    def decode_raw(self, tokens: Tokens) -> tuple[Tensor, Tensor]:
        """Returns depth for a focal length of 300 pixels and the sky score, both ``[B, V, H, W]``."""
        with full_precision(tokens.camera):
            out = in_chunks(DepthAndSky(self.network.head), tokens.patch, tokens.grid, self.head_chunk)
        return out[:, :, 0].exp(), F.relu(out[:, :, 1])

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`; the cameras are those of the data."""
        depth, sky = self.decode_raw(tokens)
        cameras = tokens.state["cameras"]
        focal = cameras.intrinsics[..., [0, 1], [0, 1]].mean(-1)
        depth = fill_sky(depth, sky) * (focal / CANONICAL_FOCAL)[..., None, None]
        return Geometry(depth, torch.ones_like(depth), cameras, torch.ones_like(depth[:, 0, 0, 0]))


def fill_sky(depth: Tensor, sky: Tensor) -> Tensor:
    """Gives sky pixels the far end of their scene: the 0.99 quantile of the other pixels' depth ``[B, V, H, W]``."""
    is_sky = sky >= SKY_THRESHOLD
    filled = []
    for scene, mask in zip(depth, is_sky, strict=True):
        ground = scene[~mask]
        if ground.numel() > MIN_PIXELS and mask.sum() > MIN_PIXELS:
            scene = torch.where(mask, quantile(ground, FAR_QUANTILE), scene)
        filled.append(scene)
    return torch.stack(filled)


def quantile(values: Tensor, q: float) -> Tensor:
    """Quantile of a flat tensor, from an even sample of at most 100k values."""
    return values[:: -(-values.numel() // MAX_SAMPLES)].quantile(q)


class DA3NestedBackend(Backend):
    """DA3's relative network with a metric scale: one factor a scene, fitted to the metric network's depth.

    Geometry stays the relative network's; ``Geometry.scale`` turns it into metres.

    Args:
        relative: predicts geometry.
        metric: predicts metric depth.
        name: stands in checkpoints and messages.
    """

    def __init__(self, relative: DA3Backend, metric: DA3MetricBackend, name: str = "da3_nested") -> None:
        licence = f"{relative.licence}; {metric.licence}"
        super().__init__(name, relative.patch_size, relative.token_dims, licence, is_metric=True)
        self.relative = relative
        self.metric = metric
        self.needs_hints = relative.needs_hints
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """See :meth:`Backend.encode`; fits the scale once, so that token changes do not move the unit."""
        tokens = self.relative.encode(images, hints)
        geometry = self.relative.decode(tokens)
        metric_tokens = self.metric.encode(images, Hints(cameras=geometry.cameras))
        depth, sky = self.metric.decode_raw(metric_tokens)
        focal = geometry.cameras.intrinsics[..., [0, 1], [0, 1]].mean(-1)
        scale = fit_scale(depth * (focal / CANONICAL_FOCAL)[..., None, None], sky, geometry)
        return replace(tokens, state={**tokens.state, "scale": scale})

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`."""
        return replace(self.relative.decode(tokens), scale=tokens.state["scale"])


def fit_scale(metric_depth: Tensor, sky: Tensor, geometry: Geometry) -> Tensor:
    """Least-squares factor ``[B]`` from relative to metric depth over confident pixels that are not sky.

    Confident means at least the median confidence of the scene's pixels that are not sky. A scene with no more than ten
    such pixels gets 1.
    """
    factors = []
    ground = sky < SKY_THRESHOLD
    for target, depth, confidence, usable in zip(
        metric_depth, geometry.depth, geometry.depth_conf, ground, strict=True
    ):
        if usable.sum() <= MIN_PIXELS:
            factors.append(torch.ones_like(depth[0, 0, 0]))
            continue
        sure = usable & (confidence >= quantile(confidence[usable], 0.5))
        factors.append((target[sure] * depth[sure]).sum() / depth[sure].square().sum())
    return torch.stack(factors)
