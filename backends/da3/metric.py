"""Metric network of Depth Anything 3, alone and as the scale of the relative network (nested)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from backends.base import Backend
from backends.da3.backbone import Backbone
from backends.da3.backend import NESTED_PARTS, DA3Backend
from backends.dpt import DPT, in_chunks
from backends.network import NetworkBackend, normalize_images
from backends.published import network_named
from backends.weights import Weights
from vg2gt.geometry.precision import full_precision, half_precision_on_gpu
from vg2gt.types import Cameras, Geometry, Hints, Tokens

CANONICAL_FOCAL = 300.0  # pixels at network resolution
_SKY_THRESHOLD = 0.3
_FAR_QUANTILE = 0.99
MIN_PIXELS = 10
NEAREST, _NEAREST_METRIC = 1e-3, 1e-2  # minimum depth and metric depth for fitting the scale
_MAX_SAMPLES = 100_000  # for quantiles
_FARTHEST_SKY = 200.0  # metres
_SKY_CONFIDENCE = 1.0  # lower bound of DA3's confidence, 1 + exp


class DA3MetricBackend(NetworkBackend):
    """DA3's metric network: predicts metric depth of single views; cameras are those of the data, confidence is 1.

    Depth is the network's output times the mean focal length (pixels at network resolution) / 300, in metres. It
    matches the cameras only if their translations are in metres. Sky pixels get the depth of the scene's far end. For
    the arguments see :class:`NetworkBackend`.
    """

    network: nn.ModuleDict

    def __init__(
        self,
        name: str,
        pretrained: bool = True,
        revision: str | None = None,
        path: str | None = None,
        seed: int = 0,
        head_chunk: int | None = 8,
        **shape: Any,
    ) -> None:
        net = network_named(name, shape)

        def make() -> nn.ModuleDict:
            backbone = Backbone(net.dim, net.depth, net.num_heads, "mlp", None, net.image_size, net.patch_size)
            options = {"normalize": False, "position_weight": 0, "sky": True}
            head = DPT(net.dim, net.features, net.out_channels, 1, net.patch_size, **options)
            return nn.ModuleDict({"backbone": nn.ModuleDict({"pretrained": backbone}), "head": head})

        ignorable = tuple(part for part in NESTED_PARTS if part != net.prefix)
        weights = Weights(name, net.licence, pretrained, net.repo, revision, path, seed, net.prefix, ignorable)
        properties = {"is_metric": True, "needs_hints": True, "predicts_cameras": False}
        super().__init__(make, weights, net.patch_size, net.dim, net.taps, head_chunk, **properties)

    def encode_checked(self, images: Tensor, hints: Hints | None) -> Tokens:
        """See :meth:`NetworkBackend.encode_checked`; token changes do not affect the scale factors of here."""
        assert hints is not None
        assert hints.cameras is not None
        with half_precision_on_gpu(images):
            patch, camera = self.network.get_submodule("backbone.pretrained")(normalize_images(images), self.taps)
        tokens = self.as_tokens(images, patch, camera)
        return replace(tokens, state={"cameras": hints.cameras, "factor": metres(hints.cameras)})

    def decode_raw(self, tokens: Tokens) -> tuple[Tensor, Tensor]:
        """Returns the network's depth, before filling the sky, and its sky score, both ``[B, V, H, W]``."""
        with full_precision(tokens.camera):
            out = in_chunks(self.network["head"], tokens.patch, tokens.grid, self.head_chunk)
        return out[:, :, 0].exp(), F.relu(out[:, :, 1])

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`; the cameras are those of the data."""
        depth = fill_sky(*self.decode_raw(tokens)) * tokens.state["factor"][..., None, None]
        return Geometry(depth, torch.ones_like(depth), tokens.state["cameras"], torch.ones_like(depth[:, 0, 0, 0]))

    def decode_cameras(self, tokens: Tokens) -> Cameras:
        """See :meth:`Backend.decode_cameras`."""
        return tokens.state["cameras"]


def metres(cameras: Cameras) -> Tensor:
    """Returns metres per unit of the metric network's output, ``[B, V]``."""
    return cameras.intrinsics[..., [0, 1], [0, 1]].mean(-1) / CANONICAL_FOCAL


def fill_sky(depth: Tensor, sky: Tensor) -> Tensor:
    """Sets the depth of sky pixels to the far end of their scene.

    Scenes with at most ten sky pixels, or at most ten others, are left unchanged. The published code takes the quantile
    over the whole batch, which is the same for one scene at a time.

    Args:
        depth: ``[B, V, H, W]``.
        sky: sky score ``[B, V, H, W]``; sky from 0.3 on.
    """
    far, is_sky = _far_ends(depth, sky)[:, None, None, None], sky >= _SKY_THRESHOLD
    enough = is_sky.sum((1, 2, 3), keepdim=True) > MIN_PIXELS
    return torch.where(is_sky & enough & far.isfinite(), far, depth)


def quantile(values: Tensor, q: float) -> Tensor:
    """Returns the quantile of a flat tensor, estimated from every n-th value so that at most 100k are used."""
    return values[:: -(-values.numel() // _MAX_SAMPLES)].quantile(q)


class DA3NestedBackend(Backend):
    """DA3's relative network with a metric scale: one factor per scene, fitted to the metric network's depth.

    ``Geometry.scale`` turns the relative network's geometry into metres. As in the published code, sky pixels get the
    depth of the scene's far end, at most 200 m, and confidence 1. Both are fixed when images are encoded.

    Args:
        relative: predicts geometry.
        metric: predicts metric depth.
        name: name in checkpoints and messages.
    """

    def __init__(self, relative: DA3Backend, metric: DA3MetricBackend, name: str = "da3_nested") -> None:
        if not relative.frozen:
            raise ValueError("backend.relative.freeze=false: this backend cannot be trained, use backend=da3_giant")
        licence = f"{relative.licence}; {metric.licence}"
        super().__init__(name, relative.patch_size, relative.token_dims, licence, is_metric=True)
        self.relative = relative
        self.metric = metric
        self.needs_hints = relative.needs_hints
        self.freeze()

    @torch.no_grad()
    def encode(self, images: Tensor, hints: Hints | None = None) -> Tokens:
        """See :meth:`Backend.encode`; fits the scale here, so that token changes do not affect it."""
        tokens = self.relative.encode(images, hints)
        geometry = self.relative.decode(tokens)
        metric_tokens = self.metric.encode(images, Hints(cameras=geometry.cameras))
        depth, sky = self.metric.decode_raw(metric_tokens)
        scale = fit_scale(depth * metres(geometry.cameras)[..., None, None], sky, geometry)
        far = torch.minimum(_far_ends(geometry.depth, sky), _FARTHEST_SKY / scale)
        return replace(tokens, state={**tokens.state, "scale": scale, "sky": sky >= _SKY_THRESHOLD, "far": far})

    def decode(self, tokens: Tokens) -> Geometry:
        """See :meth:`Backend.decode`."""
        geometry = self.relative.decode(tokens)
        far = tokens.state["far"][:, None, None, None]
        filled = tokens.state["sky"] & far.isfinite()
        return replace(
            geometry,
            depth=torch.where(filled, far, geometry.depth),
            depth_conf=torch.where(filled, _SKY_CONFIDENCE, geometry.depth_conf),
            scale=tokens.state["scale"],
        )

    def decode_cameras(self, tokens: Tokens) -> Cameras:
        """See :meth:`Backend.decode_cameras`."""
        return self.relative.decode_cameras(tokens)

    @torch.no_grad()
    def predict_cameras(self, images: Tensor, hints: Hints | None = None) -> Cameras:
        """See :meth:`Backend.predict_cameras`; does not run the metric network."""
        return self.relative.predict_cameras(images, hints)


def _far_ends(depth: Tensor, sky: Tensor) -> Tensor:
    """Returns the far end of each scene, ``[B]``: the 0.99 quantile of the pixels that are not sky.

    It is NaN for a scene with at most ten such pixels. Arguments as of :func:`fill_sky`.
    """
    ground = [scene[score < _SKY_THRESHOLD] for scene, score in zip(depth, sky, strict=True)]
    unknown = depth.new_tensor(torch.nan)
    return torch.stack([quantile(g, _FAR_QUANTILE) if len(g) > MIN_PIXELS else unknown for g in ground])


def fit_scale(metric_depth: Tensor, sky: Tensor, geometry: Geometry) -> Tensor:
    """Fits the factor from relative to metric depth, by least squares over confident pixels that are not sky.

    As in the published code, confident means at least the scene's median confidence, and near pixels are left out
    (depth up to 1e-3 or metric depth up to 1e-2).

    Args:
        metric_depth: ``[B, V, H, W]``.
        sky: sky score ``[B, V, H, W]``.
        geometry: geometry of the relative network.

    Returns:
        ``[B]``; 1 for a scene with at most ten pixels that are not sky, or without pixels to fit.
    """
    factors = []
    for target, depth, confidence, score in zip(metric_depth, geometry.depth, geometry.depth_conf, sky, strict=True):
        sure = score < _SKY_THRESHOLD
        if sure.sum() > MIN_PIXELS:
            sure = sure & (confidence >= quantile(confidence[sure], 0.5))
            sure &= (depth > NEAREST) & (target > _NEAREST_METRIC)
            factor = (target[sure] * depth[sure]).sum() / depth[sure].square().sum()
            factors.append(factor if sure.any() else torch.ones_like(factor))
        else:
            factors.append(torch.ones_like(depth[0, 0, 0]))
    return torch.stack(factors)
