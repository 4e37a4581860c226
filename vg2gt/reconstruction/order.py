"""Order in which a model sees the views, whatever order they were given in."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from vg2gt.data.transforms import to_bytes
from vg2gt.inputs.inputs import Views
from vg2gt.types import Cameras, Geometry, Hints

_THUMBNAIL = 24  # pixels per side


def working_order(images: Tensor) -> list[int]:
    """Returns the indices of views ``[V, 3, H, W]`` in processing order.

    The first view defines the scene's frame: it is the one that looks most like the others, by the correlation of
    thumbnails. The others are sorted by a hash of their contents.
    """
    contents = [hashlib.sha256(to_bytes(image).numpy().tobytes()).hexdigest() for image in images]
    order = sorted(range(len(contents)), key=lambda view: contents[view])
    unit = thumbnails(images)[order]
    reference = int((unit @ unit.mean(0)).argmax())
    return [order[reference], *(view for place, view in enumerate(order) if place != reference)]


def thumbnails(images: Tensor) -> Tensor:
    """Returns small grey images ``[V, 576]`` of zero mean and unit length, float64: their products are correlations."""
    gray = (image[None].mean(1, keepdim=True) for image in images)  # one by one, to bound memory
    small = torch.cat([F.interpolate(image, (_THUMBNAIL, _THUMBNAIL), mode="area").flatten(1) for image in gray])
    return F.normalize(small.double() - small.double().mean(1, keepdim=True), dim=1)


def in_order(views: Views, order: Sequence[int]) -> tuple[Tensor, Hints]:
    """Returns images ``[V, 3, H, W]`` and hints of the views in another order."""
    hints = views.hints
    cameras = None if hints.cameras is None else hints.cameras.select(torch.tensor(order))
    parts = {name: getattr(hints, name) for name in ("depth", "frame_ids", "mask")}
    chosen = {name: None if value is None else value[:, list(order)] for name, value in parts.items()}
    return views.images[list(order)], replace(hints, cameras=cameras, **chosen)


def as_given(geometry: Geometry, order: Sequence[int]) -> Geometry:
    """Reorders geometry from processing order to the order in which the views were given."""
    back = torch.tensor(order).argsort()
    cameras: Cameras = geometry.cameras.select(back.to(geometry.depth.device))
    return replace(geometry, depth=geometry.depth[:, back], depth_conf=geometry.depth_conf[:, back], cameras=cameras)
