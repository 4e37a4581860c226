"""Network of IterMVS, with the tensor names of the published weights.

Written from the paper (Wang et al., "IterMVS: Iterative Probability Estimation for Efficient Multi-View Stereo", CVPR
2022) and compared with the published code in ``tests/backends/test_itermvs.py``. All views of a scene are matched in
one batch, so that the features of every image are computed once.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from examples.backends.itermvs.matching import GROUPS, Hypotheses, Projections, similarity

HIDDEN = 32  # channels of the hidden state
STRIDE = 4  # image size over size of the hidden state
_LEVELS = (1, 2, 3)  # feature maps at 1/2, 1/4 and 1/8 of the image
_PLANES = 32  # hypotheses of the first match
_BINS = 256  # of inverse depth, from 1 / far to 1 / near
_WINDOW = 4  # bins on either side of the most likely one to average over
_OFFSETS = {1: (-2, -2 / 3, 2 / 3, 2), 2: (-8, -8 / 3, 8 / 3, 8), 3: (-32, 32)}  # hypotheses of an update, in bins
_VIEWS_AT_A_TIME = 8  # bounds the memory


def named(**modules: nn.Module) -> nn.Sequential:
    """Returns a sequence of modules with names."""
    return nn.Sequential(OrderedDict(modules))


def conv(inputs: int, outputs: int, size: int = 3, stride: int = 1, dilation: int = 1, bias: bool = False) -> nn.Conv2d:
    """Returns a convolution that keeps the size of the image, divided by ``stride``."""
    return nn.Conv2d(inputs, outputs, size, stride, dilation * (size // 2), dilation, bias=bias)


def conv_norm(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Returns a 3x3 convolution with batch normalisation."""
    return named(conv=conv(inputs, outputs, stride=stride), bn=nn.BatchNorm2d(outputs))


def conv_relu(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Returns a 3x3 convolution with rectification."""
    return named(conv=conv(inputs, outputs, stride=stride), relu=nn.ReLU(True))


def enlarge(x: Tensor, factor: float) -> Tensor:
    """Resizes images ``[N, C, h, w]`` bilinearly."""
    return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


def to_depth(t: Tensor, depth_range: Tensor) -> Tensor:
    """Converts positions ``[V, D, h, w]``, 0 is far and 1 is near, to depth; the range is ``[2]`` or ``[V, 2]``."""
    near, far = depth_range.view(-1, 2, 1, 1, 1).reciprocal().unbind(1)
    return 1 / (far + t * (near - far))


class Residual(nn.Module):
    """Two convolutions and a shortcut; halves the size of the image if the widths differ."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        stride = 1 if inputs == outputs else 2
        self.conv1, self.conv2 = conv_norm(inputs, outputs, stride), conv_norm(outputs, outputs)
        self.downsample = nn.Identity() if stride == 1 else conv_norm(inputs, outputs, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Maps ``[N, inputs, h, w]`` to ``[N, outputs, h, w]`` or ``[N, outputs, h / 2, w / 2]``."""
        return F.relu(self.conv2(F.relu(self.conv1(x))) + self.downsample(x))


class FeatureNet(nn.Module):
    """Feature pyramid of an image."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = conv_norm(3, 8)
        self.layer1 = nn.Sequential(Residual(8, 16), Residual(16, 16))
        self.layer2 = nn.Sequential(Residual(16, 32), Residual(32, 32))
        self.layer3 = nn.Sequential(Residual(32, 48), Residual(48, 48))
        self.output1, self.output2, self.output3 = (conv(48, outputs, bias=True) for outputs in (16, 32, 48))
        self.inner1, self.inner2 = conv(16, 48, 1, bias=True), conv(32, 48, 1, bias=True)

    def forward(self, images: Tensor) -> dict[int, Tensor]:
        """Maps images ``[N, 3, H, W]`` in [-1, 1] to features by level: 16, 32 and 48 channels at 1/2, 1/4, 1/8."""
        fine = self.layer1(F.relu(self.conv1(images)))
        middle = self.layer2(fine)
        coarse = self.layer3(middle)
        middle = enlarge(coarse, 2) + self.inner2(middle)
        fine = enlarge(middle, 2) + self.inner1(fine)
        return {1: self.output1(fine), 2: self.output2(middle), 3: self.output3(coarse)}


class Match(NamedTuple):
    """Some views of a scene, to be matched with their sources.

    Attributes:
        features: features of all views of the scene by level.
        own: features of these views by level, all resized to 1/4 of the image.
        coarse: features of these views at level 3.
        projections: projections of these views.
        depth_range: near and far ``[2]``.
    """

    features: dict[int, Tensor]
    own: dict[int, Tensor]
    coarse: Tensor
    projections: Projections
    depth_range: Tensor


class CorrNet(nn.Module):
    """Small U-Net from the similarities on a plane to its logits."""

    def __init__(self) -> None:
        super().__init__()
        self.conv0, self.conv1, self.conv2 = conv_relu(GROUPS, 8), conv_relu(8, 16, 2), conv_relu(16, 32, 2)
        self.conv3 = nn.ConvTranspose2d(32, 16, 3, 2, 1, 1, bias=False)
        self.conv4 = nn.ConvTranspose2d(16, 8, 3, 2, 1, 1, bias=False)
        self.conv5 = conv(8, 1, bias=True)

    def forward(self, similarity: Tensor) -> Tensor:
        """Maps ``[V, GROUPS, D, h, w]`` to ``[V, D, h, w]``; zeros are appended where 4 does not divide the size."""
        planes, height, width = similarity.shape[2:]
        fine = self.conv0(F.pad(similarity.transpose(1, 2).flatten(0, 1), (0, -width % 4, 0, -height % 4)))
        half = self.conv1(fine)
        half = half + self.conv3(self.conv2(half))
        return self.conv5(fine + self.conv4(half))[:, 0, :height, :width].unflatten(0, (-1, planes))


class Evaluation(nn.Module):
    """Matches views with their sources at hypotheses."""

    def __init__(self) -> None:
        super().__init__()
        self.pixel_view_weight = named(conv=nn.Sequential(conv_relu(GROUPS, 16), conv(16, 1, 1, bias=True)))
        self.corr_conv1 = nn.ModuleList(CorrNet() for _ in _LEVELS)

    def first(self, match: Match, t: Tensor) -> tuple[Tensor, Tensor]:
        """Matches planes ``t [V, D, h, w]`` at 1/8, and weighs each pixel's sources by their best plane.

        Returns:
            Logits of the planes ``[V, D, h, w]``, and the weights of the sources ``[V, n, 2 h, 2 w]``.
        """
        points, total, weights = Hypotheses(to_depth(t, match.depth_range), 8, 8), t.new_zeros(()), []
        for source in range(match.projections.sources.shape[1]):
            one = match.projections.select(slice(None), slice(source, source + 1))
            similar = similarity(match.coarse, match.features[3], one, points, torch.ones_like(t[:, :1]))
            logits = self.pixel_view_weight(similar.transpose(1, 2).flatten(0, 1)).view_as(t)
            weights.append(logits.softmax(1).amax(1))
            total = total + similar * weights[-1][:, None, None]
        every = torch.stack(weights, 1)
        return self.corr_conv1[2](_mean(total, every)), enlarge(every, 2)

    def again(self, match: Match, t: Tensor, weights: Tensor) -> Tensor:
        """Matches hypotheses around ``t [V, 1, h, w]`` at 1/4; returns their logits ``[V, ., h, w]``."""
        found = []
        for level, net in zip(_LEVELS, self.corr_conv1, strict=True):
            around = (t + t.new_tensor(_OFFSETS[level]).view(1, -1, 1, 1) / _BINS).clamp(0, 1)
            points = Hypotheses(to_depth(around, match.depth_range), STRIDE, 2**level)
            similar = similarity(match.own[level], match.features[level], match.projections, points, weights)
            found.append(net(_mean(similar, weights)))
        return torch.cat(found, 1)


def _interleave(maps: Tensor) -> Tensor:
    """Brings the channels of features ``[N, C, h, w]``, where groups are consecutive, into the order for matching."""
    return maps.unflatten(1, (GROUPS, -1)).transpose(1, 2).flatten(1, 2).contiguous(memory_format=torch.channels_last)


def _mean(total: Tensor, weights: Tensor) -> Tensor:
    """Divides a weighted sum over sources ``[V, GROUPS, D, h, w]`` by the sum of their weights ``[V, n, h, w]``."""
    return total / (1e-5 + weights.sum(1))[:, None, None]


class Update(nn.Module):
    """Recurrent unit, and the heads that read its hidden state."""

    def __init__(self) -> None:
        super().__init__()
        inputs = HIDDEN + 1 + sum(map(len, _OFFSETS.values()))
        gates = ("convz", "convr", "convq")
        self.gru = nn.ModuleDict({gate: conv(inputs, HIDDEN, dilation=2, bias=True) for gate in gates})
        self.hidden_init_head = nn.Sequential(conv(_PLANES, 64), nn.ReLU(True), conv(64, HIDDEN, 1, bias=True))
        shared = (conv(HIDDEN, 32, dilation=2), nn.ReLU(True), conv(32, 64, 1), nn.ReLU(True))
        self.depth_head = nn.Sequential(*shared, conv(64, _BINS, 1, bias=True))
        self.confidence_head = nn.Sequential(conv(HIDDEN, 32, dilation=2), nn.ReLU(True), conv(32, 1, 1, bias=True))

    def begin(self, logits: Tensor) -> Tensor:
        """Returns the first hidden state ``[V, HIDDEN, 2 h, 2 w]`` from the logits of the planes ``[V, D, h, w]``."""
        return enlarge(self.hidden_init_head(logits), 2).tanh()

    def forward(self, hidden: Tensor, inputs: Tensor) -> Tensor:
        """Returns the next hidden state ``[V, HIDDEN, h, w]``."""
        both = torch.cat((hidden, inputs), 1)
        change, reset = self.gru["convz"](both).sigmoid(), self.gru["convr"](both).sigmoid()
        new = self.gru["convq"](torch.cat((reset * hidden, inputs), 1)).tanh()
        return (1 - change) * hidden + change * new

    def position(self, hidden: Tensor) -> Tensor:
        """Reads positions ``[V, 1, h, w]`` from the hidden state: the mean bin around the most likely one."""
        last = self.depth_head[-1]  # applied to rows, which the softmax is faster for
        assert isinstance(last, nn.Conv2d)
        rows = self.depth_head[:-1](hidden).permute(0, 2, 3, 1)
        probability = F.linear(rows, last.weight[:, :, 0, 0], last.bias).softmax(-1)  # [V, h, w, bins]
        around = torch.arange(-_WINDOW, _WINDOW + 1, device=hidden.device)
        bins = (probability.argmax(-1, keepdim=True) + around).clamp(0, _BINS - 1)
        mass = probability.gather(-1, bins)
        found = (bins * mass).sum(-1) / (mass.sum(-1) + 1e-6)
        if probability.requires_grad:  # the choice of the bin has no gradient; this is that of the mean over all bins
            mean = (probability * torch.arange(_BINS, device=hidden.device)).sum(-1)
            found = found + mean - mean.detach()
        return (found / (_BINS - 1))[:, None]


class Recurrence(nn.Module):
    """The first match, the updates, and the upsampling of depth."""

    def __init__(self) -> None:
        super().__init__()
        self.evaluation, self.update = Evaluation(), Update()
        self.upsample = nn.Sequential(conv(32, 64), nn.ReLU(True), conv(64, 9 * STRIDE**2, 1))

    def forward(self, match: Match, iterations: int) -> Tensor:
        """Returns the hidden state after the last update ``[V, HIDDEN, h, w]``."""
        like = {"dtype": match.coarse.dtype, "device": match.coarse.device}
        planes = torch.linspace(0, 1, _PLANES, **like).view(1, -1, 1, 1)
        planes = planes.expand(len(match.coarse), -1, *match.coarse.shape[2:]).contiguous()
        logits, weights = self.evaluation.first(match, planes)
        hidden = self.update.begin(logits)
        for _ in range(iterations):
            t = self.update.position(hidden)
            hidden = self.update(hidden, torch.cat((t, self.evaluation.again(match, t, weights)), 1))
        return hidden


class IterMVSNet(nn.Module):
    """Images and cameras to hidden states, hidden states to depth."""

    def __init__(self) -> None:
        super().__init__()
        self.feature_net = FeatureNet()
        self.iter_mvs = Recurrence()

    def encode(
        self, features: dict[int, Tensor], projections: Projections, depth_range: Tensor, iterations: int
    ) -> Tensor:
        """Matches every view with its sources.

        Args:
            features: output of :class:`FeatureNet` for V views of a scene.
            projections: projections of the views into their sources.
            depth_range: near and far ``[2]``.
            iterations: number of updates.

        Returns:
            Hidden states ``[V, HIDDEN, h, w]`` at 1/4 of the image size.
        """
        features, parts = {level: _interleave(maps) for level, maps in features.items()}, []
        for first in range(0, len(projections.sources), _VIEWS_AT_A_TIME):
            views = slice(first, first + _VIEWS_AT_A_TIME)
            own = {level: enlarge(maps[views], 2.0 ** (level - 2)) for level, maps in features.items()}
            match = Match(features, own, features[3][views], projections.select(views), depth_range)
            parts.append(self.iter_mvs(match, iterations))
        return torch.cat(parts)

    def decode(self, hidden: Tensor, context: Tensor, depth_range: Tensor) -> tuple[Tensor, Tensor]:
        """Decodes depth and confidence.

        Args:
            hidden: hidden states ``[V, HIDDEN, h, w]``.
            context: features of level 2 ``[V, 32, h, w]``, from which the upsampling weights are computed.
            depth_range: near and far, ``[2]`` or ``[V, 2]``.

        Returns:
            Depth, and the predicted probability that it is accurate, each ``[V, H, W]``.
        """
        t = self.iter_mvs.update.position(hidden)
        weights = self.iter_mvs.upsample(context).unflatten(1, (9, -1)).softmax(1)  # [V, 9, 16, h, w]
        around = F.unfold(F.pad(t, (1, 1, 1, 1), mode="replicate"), 3).view(len(t), 9, 1, *t.shape[2:])
        fine = F.pixel_shuffle((weights * around).sum(1), STRIDE)
        confidence = enlarge(self.iter_mvs.update.confidence_head(hidden).sigmoid(), STRIDE)
        return to_depth(fine, depth_range)[:, 0], confidence[:, 0]
