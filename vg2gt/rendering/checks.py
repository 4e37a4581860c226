"""Input checks of the renderer; each error names the argument, what was expected and the remedy."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from vg2gt.geometry.spherical_harmonics import MAX_DEGREE
from vg2gt.types import Cameras, Gaussians

MIN_SCALE = 1e-10  # smaller ones overflow the inverse covariance in float32


class UnrenderableError(ValueError):
    """Raised for values that are NaN, infinite or out of range; mismatched shapes raise a plain ValueError."""


def check_shapes(gaussians: Gaussians, cameras: Cameras) -> None:
    """Raises ValueError, naming the argument, if shapes or devices do not match or the image size is empty."""
    poses, intrinsics = cameras.world_to_camera, cameras.intrinsics
    if poses.dim() != 4 or poses.shape[-2:] != (4, 4):
        raise ValueError(f"world_to_camera must be [B, V, 4, 4], got {list(poses.shape)}")
    if intrinsics.shape != (*poses.shape[:2], 3, 3):
        raise ValueError(
            f"intrinsics must be {[*poses.shape[:2], 3, 3]} like world_to_camera, got {list(intrinsics.shape)}"
        )
    if min(cameras.size) < 1:
        raise ValueError(f"the cameras' size must be at least 1 x 1 pixels, got {cameras.size}")
    count = gaussians.means.shape[0]
    coefficients = gaussians.sh.shape[1] if gaussians.sh.dim() == 3 else 0
    if coefficients not in {(degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)}:
        raise ValueError(f"sh must be [G, (L + 1)^2, 3] with L from 0 to {MAX_DEGREE}, got {tuple(gaussians.sh.shape)}")
    expected = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "sh": (count, coefficients, 3),
        "batch": (count,),
    }
    for name, shape in expected.items():
        tensor: Tensor = getattr(gaussians, name)
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must be {list(shape)} for {count} Gaussians, got {list(tensor.shape)}")
    if poses.device != gaussians.means.device:
        raise ValueError(
            f"cameras are on {poses.device} but Gaussians are on {gaussians.means.device}; move them to the same device"
        )


def check_values(gaussians: Gaussians, cameras: Cameras) -> None:
    """Raises ValueError unless all values are finite and in range and the Gaussians are sorted by scene."""
    check_finite("world_to_camera", cameras.world_to_camera)
    check_finite("intrinsics", cameras.intrinsics)
    focal = cameras.intrinsics[..., [0, 1], [0, 1]]
    _require("intrinsics", focal > 0, "be pinhole matrices with positive focal lengths")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        check_finite(name, getattr(gaussians, name))
    if len(gaussians) == 0:
        return
    _require("scales", gaussians.scales >= MIN_SCALE, f"be at least {MIN_SCALE} (standard deviations in scene units)")
    _require("opacities", (gaussians.opacities >= 0) & (gaussians.opacities <= 1), "be in [0, 1]")
    _require("quats", gaussians.quats.detach().abs().sum(-1) > 0, "have nonzero norm")
    batch, scenes = gaussians.batch, len(cameras.world_to_camera)
    if batch[0] < 0 or batch[-1] >= scenes or (batch[1:] < batch[:-1]).any():
        raise ValueError(
            f"batch must be sorted scene indices from 0 to {scenes - 1} (the cameras hold {scenes} scenes); "
            "sort the Gaussians by scene"
        )


def check_finite(name: str, tensor: Tensor) -> None:
    """Raises UnrenderableError if a tensor holds NaN or infinity, naming it and the first bad position."""
    if torch.isfinite(tensor.detach().sum()):  # the common case in one fast pass
        return
    where = torch.nonzero(~torch.isfinite(tensor))
    if len(where):
        raise UnrenderableError(
            f"{name} holds {len(where)} NaN or infinite values, the first at {where[0].tolist()}; "
            "look for a diverging loss or an invalid input upstream"
        )


def background_colors(
    background: Tensor | Sequence[float] | None, gaussians: Gaussians, scenes: int, dtype: torch.dtype
) -> Tensor:
    """Returns every scene's background ``[B, 3]``: the given colour ``[3]``, else the Gaussians' own, else black."""
    device = gaussians.means.device
    if background is not None:
        color = torch.as_tensor(background, dtype=dtype, device=device)
        if color.shape != (3,):
            raise ValueError(f"background must be one colour [3], got {list(color.shape)}")
        return color.expand(scenes, 3)
    if gaussians.background is None:
        return gaussians.means.new_zeros(scenes, 3, dtype=dtype)
    if gaussians.background.shape != (scenes, 3):
        raise ValueError(
            f"the Gaussians' background must be one colour per scene [{scenes}, 3], "
            f"got {list(gaussians.background.shape)}"
        )
    return gaussians.background.to(dtype)


def _require(name: str, good: Tensor, expectation: str) -> None:
    if not good.all():
        where = torch.nonzero(~good)
        raise UnrenderableError(f"{name} must {expectation}; {len(where)} do not, the first at {where[0].tolist()}")
