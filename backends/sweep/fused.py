"""Cost volume of a stage without gradients, in one pass over the pixels: the torch version stores far more."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from backends.sweep.correlate import GROUPS, SourceWarp, sample_at, similarity_at
from vg2gt.kernels.compiled import kernel

HIDDEN = 16  # channels between the two convolutions that weigh a similarity


def fused_volume(
    maps: Tensor,
    inverse: Tensor,
    warp: SourceWarp,
    weigh: nn.Sequential,
    visible: nn.Linear | None,
    given: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Computes what :class:`Matching` computes from similarities, for float32 on a CPU.

    Args:
        maps: features of all views ``[N, C, h, w]``.
        inverse: inverse depths ``[V, D, h w]`` of the views of ``warp``.
        warp: correspondences of all or some of the views.
        weigh: the weights of a similarity: 1x1 convolutions, GROUPS to HIDDEN to 1 channels.
        visible: visibility from the greatest score, the mean score and the greatest probability of a plane.
        given: visibility ``[V, n, h w]``; None computes it with ``visible``.

    Returns:
        Mean similarity per group and mean weight ``[V, D, h w, GROUPS + 1]``, and visibility ``[V, n, h w]``.
    """
    channels_last = maps.permute(0, 2, 3, 1).contiguous()
    views, sources = warp.sources.shape
    planes, pixels = inverse.shape[1:]
    volume = torch.empty(views, planes, pixels, GROUPS + 1)
    seen = torch.empty(views, sources, pixels) if given is None else given.contiguous()
    tensors = (channels_last, warp.sources, warp.at_infinity, warp.parallax, inverse)
    assert given is not None or visible is not None
    weight, bias, weight_out, bias_out = weigh.parameters()
    last = (visible.weight[0], visible.bias) if visible else (torch.zeros(3), torch.zeros(1))
    layers = (weight.flatten(1).T, bias, weight_out.flatten(), bias_out, *last)
    geometry = tuple(tensor.detach().contiguous().numpy() for tensor in tensors)
    network = tuple(tensor.detach().contiguous().numpy() for tensor in layers)
    _fused(geometry, network, warp.first, given is None, volume.numpy(), seen.numpy())
    return volume, seen


@kernel(fastmath=True, error_model="numpy", nogil=True)
def _fused(geometry, network, first, estimate, volume, seen):
    maps, sources, at_infinity, parallax, inverse = geometry
    weight1, bias1, weight2, bias2, weight3, bias3 = network
    height, width = maps.shape[1:3]
    count, planes = sources.shape[1], inverse.shape[1]
    one = np.float32(1.0)
    similarity = np.empty((count, planes, GROUPS), np.float32)
    score = np.empty((count, planes), np.float32)  # of the source at the plane
    within = np.empty((count, planes), np.float32)
    hidden = np.empty(HIDDEN, np.float32)
    for view in range(sources.shape[0]):
        for p in range(height * width):
            here = maps[first + view, p // width, p % width]
            for n in range(count):
                other = sources[view, n]
                for d in range(planes):
                    rows, columns, weights, inside = sample_at(
                        at_infinity[view, n], parallax[view, n], p, inverse[view, d, p], height, width
                    )
                    out = similarity[n, d]
                    out[:] = 0.0
                    within[n, d] = one if inside else np.float32(0.0)
                    if inside:
                        similarity_at(here, maps[other], (rows, columns), weights, out)
                    for k in range(HIDDEN):
                        hidden[k] = bias1[k]
                    for g in range(GROUPS):
                        for k in range(HIDDEN):
                            hidden[k] += out[g] * weight1[g, k]
                    total = bias2[0]
                    for k in range(HIDDEN):
                        total += max(hidden[k], np.float32(0.0)) * weight2[k]
                    score[n, d] = total
                if estimate:
                    most, mean, exponentials = score[n, 0], np.float32(0.0), np.float32(0.0)
                    for d in range(planes):
                        most = max(most, score[n, d])
                        mean += score[n, d]
                    for d in range(planes):
                        exponentials += np.exp(score[n, d] - most)
                    total = most * weight3[0] + mean / np.float32(planes) * weight3[1] + weight3[2] / exponentials
                    seen[view, n, p] = one / (one + np.exp(-total - bias3[0]))
            for d in range(planes):
                out = volume[view, d, p]
                out[:] = 0.0
                for n in range(count):
                    weight = within[n, d] * seen[view, n, p] / (one + np.exp(-score[n, d]))
                    out[GROUPS] += weight
                    for g in range(GROUPS):
                        out[g] += weight * similarity[n, d, g]
                inverse_sum = one / (out[GROUPS] + np.float32(1e-3))
                for g in range(GROUPS):
                    out[g] *= inverse_sum
                out[GROUPS] /= np.float32(count)
