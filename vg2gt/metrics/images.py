"""Image similarity: PSNR, SSIM, and LPIPS on VGG-16 features (Zhang et al. 2018, version 0.1)."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path

import kornia.metrics
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vg2gt.io.tensors import read_tensors

_SSIM_WINDOW = 11  # kornia's Gaussian window has a standard deviation of 1.5 pixels

_WEIGHTS_URL = "https://download.pytorch.org/models/vgg16-397923af.pth"
WEIGHTS_FILE = _WEIGHTS_URL.rpartition("/")[2]
_HOW_TO_GET = "evaluation.lpips=download or evaluation.lpips=PATH"

# Convolutions of each stage up to the activation that is compared; max pooling between the stages.
_STAGES = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
# Mean and standard deviation of ImageNet colours, for images in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
_SMALLEST_IMAGE = 2 ** (len(_STAGES) - 1)
EPSILON = 1e-10


def psnr(predicted: Tensor, reference: Tensor, weights: Tensor | None = None) -> Tensor:
    """Peak signal-to-noise ratio ``[...]`` in dB of images ``[..., 3, H, W]``, colours clamped to [0, 1].

    Infinite for identical images. With pixel weights ``[..., H, W]``, the squared error is their weighted mean; NaN if
    all are 0.
    """
    first, second = (x.to(torch.promote_types(x.dtype, torch.float32)).clamp(0, 1) for x in (predicted, reference))
    errors = (first - second).square().mean(-3).double()
    if weights is None:
        return -10 * errors.mean((-2, -1)).log10()
    return -10 * ((errors * weights).sum((-2, -1)) / weights.double().sum((-2, -1))).log10()


def ssim(predicted: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity ``[...]`` of images ``[..., 3, H, W]``, at least 11 pixels high and wide.

    Gaussian window 11 x 11, sigma 1.5, range 1, no padding; colours are clamped to [0, 1].
    """
    size = predicted.shape[-3:]
    first, second = (image.float().clamp(0, 1).reshape(-1, *size) for image in (predicted, reference))
    values = kornia.metrics.ssim(first, second, _SSIM_WINDOW, padding="valid")
    return values.mean((-3, -2, -1)).reshape(predicted.shape[:-3])


class WeightsNotFoundError(FileNotFoundError):
    """Raised if the LPIPS weights (``vgg16-397923af.pth``, 528 MB) are missing; the message says how to get them."""


class LPIPS(nn.Module):
    """Distance of unit-length VGG-16 features, weighted by channel, averaged over the image, summed over five stages.

    Args:
        state: ``features.N.weight`` and ``features.N.bias`` of VGG-16 (torchvision's names), and the channel weights
            ``linK.model.1.weight``, K = 0 .. 4 (names of the official LPIPS file). Other entries are ignored.

    Raises:
        ValueError: if a tensor is missing or has the wrong shape; the message names the first.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, state: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.stages = nn.ModuleList()
        self.channel_weights = nn.ParameterList()
        channels, position = 3, 0
        for stage, widths in enumerate(_STAGES):
            convolutions = nn.ModuleList()
            for width in widths:
                convolution = nn.Conv2d(channels, width, 3, padding=1, device="meta")
                weight = _tensor(state, f"features.{position}.weight", (width, channels, 3, 3))
                convolution.weight = nn.Parameter(weight)
                convolution.bias = nn.Parameter(_tensor(state, f"features.{position}.bias", (width,)))
                convolutions.append(convolution)
                channels, position = width, position + 2  # an activation follows every convolution
            position += 1  # and a pooling every stage
            self.stages.append(convolutions)
            self.channel_weights.append(nn.Parameter(_tensor(state, f"lin{stage}.model.1.weight", (1, channels, 1, 1))))
        self.register_buffer("shift", torch.tensor(SHIFT)[:, None, None])
        self.register_buffer("scale", torch.tensor(SCALE)[:, None, None])
        self.requires_grad_(False)

    @torch.no_grad()
    def forward(self, predicted: Tensor, reference: Tensor) -> Tensor:
        """Distance ``[...]`` of images ``[..., 3, H, W]``, at least 16 pixels high and wide, clamped to [0, 1].

        Raises:
            ValueError: if the shapes differ or the images are too small.
        """
        if predicted.shape != reference.shape or min(predicted.shape[-2:]) < _SMALLEST_IMAGE:
            raise ValueError(
                f"LPIPS requires two images of the same shape [..., 3, H, W] with H, W >= {_SMALLEST_IMAGE}, got "
                f"{tuple(predicted.shape)} and {tuple(reference.shape)}"
            )
        size = predicted.shape[-3:]
        pairs = zip(predicted.reshape(-1, *size), reference.reshape(-1, *size), strict=True)
        return torch.stack([self._distance(*pair) for pair in pairs]).reshape(predicted.shape[:-3])

    def _distance(self, predicted: Tensor, reference: Tensor) -> Tensor:
        """Compares one pair ``[3, H, W]``; pairs are not batched, as the first stage holds 128 floats per pixel."""
        features = (torch.stack((predicted, reference)).float().clamp(0, 1) * 2 - 1 - self.shift) / self.scale
        distance = features.new_zeros(())
        for stage, (convolutions, weights) in enumerate(zip(self.stages, self.channel_weights, strict=True)):
            features = F.max_pool2d(features, 2) if stage else features
            assert isinstance(convolutions, nn.ModuleList)
            for convolution in convolutions:
                features = F.relu(convolution(features))
            unit = features / (features.square().sum(1, keepdim=True).sqrt() + EPSILON)
            distance = distance + ((unit[0] - unit[1]).square() * weights[0]).sum(0).mean()
        return distance


def load_lpips(source: str = "auto") -> LPIPS:
    """Builds LPIPS from its weights; reads tensors only, never code.

    Args:
        source: ``auto``: VGG-16 from torch hub's cache. ``download``: the same, downloaded into the cache if needed.
            Otherwise the path of a ``.pth`` or ``.safetensors`` file. Channel weights that it does not hold are those
            of the installed torchmetrics, a dependency of Lightning.

    Raises:
        WeightsNotFoundError: if there are no weights; the message says how to get them.
        ValueError: if the files do not contain the expected tensors.
    """
    if source == "download":
        try:
            features = torch.hub.load_state_dict_from_url(
                _WEIGHTS_URL, map_location="cpu", check_hash=True, weights_only=True
            )
        except OSError as error:  # urllib raises subclasses of it
            raise WeightsNotFoundError(f"cannot download LPIPS weights from {_WEIGHTS_URL}: {error}") from error
    else:
        path = Path(torch.hub.get_dir(), "checkpoints", WEIGHTS_FILE) if source == "auto" else Path(source).expanduser()
        if not path.is_file():
            raise WeightsNotFoundError(f"LPIPS weights not found at {path}: {_HOW_TO_GET}")
        features = read_tensors(path)
    package = importlib.util.find_spec("torchmetrics")
    assert package is not None
    assert package.origin is not None
    installed = Path(package.origin).parent / "functional" / "image" / "lpips_models" / "vgg.pth"
    return LPIPS({**read_tensors(installed), **features})


def _tensor(state: Mapping[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    if name not in state or state[name].shape != shape:
        found = tuple(state[name].shape) if name in state else "missing"
        raise ValueError(f"invalid LPIPS weights: {name} must have shape {shape}, got {found}; set {_HOW_TO_GET}")
    return state[name].float()
