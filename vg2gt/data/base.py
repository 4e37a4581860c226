"""Dataset interface: scenes of posed frames with depth. Every loader implements ``SceneSource``."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from vg2gt.io.errors import DataError
from vg2gt.types import TensorRecord

__all__ = ["DataError", "Frames", "SceneSource", "SourceMaker", "made", "training_frames"]


@dataclass(frozen=True)
class Frames(TensorRecord):
    """Frames of one scene, all of the same size.

    Attributes:
        images: ``[V, 3, H, W]`` float32 in [0, 1].
        depth: ``[V, H, W]`` float32 z-depth in the dataset's unit, 0 = invalid; pixel-aligned with ``images``.
        world_to_camera: ``[V, 4, 4]`` float32 rigid OpenCV poses.
        intrinsics: ``[V, 3, 3]`` float32 in pixels, integer pixel centres.
        sparse_depth: whether depth is known at single pixels only (LiDAR, triangulated points). Resizing then moves
            each point instead of looking up the nearest pixel.
        mask: ``[V, H, W]`` float32 in [0, 1], weight of each pixel (from alpha or mask images); None: all count fully.
    """

    images: Tensor
    depth: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    sparse_depth: bool = False
    mask: Tensor | None = None

    @staticmethod
    def concatenate(parts: Sequence[Frames]) -> Frames:
        """Concatenates frames of one scene and size along the view axis."""
        names = ("images", "depth", "world_to_camera", "intrinsics")
        mask = None
        if any(part.mask is not None for part in parts):
            mask = torch.cat([torch.ones_like(part.depth) if part.mask is None else part.mask for part in parts])
        joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        return replace(parts[0], **joined, mask=mask)


class SceneSource(ABC):
    """Scenes of a dataset, in the framework's conventions (``docs/concepts/conventions.md``).

    A source lists scenes and frames without decoding them, and decodes frames on request. It does not resize or cache
    decoded frames: the data module does that for all sources. It must be picklable, and its results must depend only
    on its arguments, so that all worker processes agree.

    Attributes:
        is_metric: whether depth and poses are in metres in all scenes.
        has_depth: whether frames have depth. Without it, the loss terms that need ground-truth depth are zero.
        dense_depth: whether depth, if there is any, covers the whole image like that of a depth camera.
        has_cameras: whether poses and intrinsics are known. If not, they are placeholders, and the source serves
            reconstruction only, which estimates the cameras.
    """

    is_metric: bool = True
    has_depth: bool = True
    dense_depth: bool = True
    has_cameras: bool = True

    @property
    @abstractmethod
    def scenes(self) -> Sequence[str]:
        """Unique scene names, in a fixed order."""

    @abstractmethod
    def frames(self, scene: str) -> Sequence[int]:
        """Ids of the scene's usable frames, in capture order."""

    def held_out(self, scene: str) -> Sequence[int]:
        """Ids among ``frames`` that are excluded from training and kept as evaluation targets; none by default."""
        return ()

    def place(self, scene: str) -> str:
        """Name of the place that the scene shows.

        Recordings of the same place must not be split between training and evaluation. The default is the scene's own
        name; datasets that record a place several times override it.
        """
        return scene

    def parts(self) -> Mapping[str, float]:
        """Sampling weight in training of every group of scenes (``part``); a single group by default."""
        return {"": 1.0}

    def part(self, scene: str) -> str:
        """Returns the group among ``parts`` that a scene belongs to."""
        return ""

    @abstractmethod
    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Decodes frames, in the order of ``frame_ids``.

        Raises:
            DataError: if a file is missing or damaged; the message names the file and the scene.
        """


SourceMaker = Callable[..., SceneSource]
"""Factory that creates a source from keyword arguments, such as a Hydra partial."""


def training_frames(source: SceneSource, scene: str) -> list[int]:
    """Returns the frame ids of a scene that training may use: all but the held-out ones."""
    held_out = set(source.held_out(scene))
    return [frame for frame in source.frames(scene) if frame not in held_out]


def made(make: SceneSource | SourceMaker, options: Mapping[str, Any]) -> SceneSource:
    """Returns a source as it is, or makes it with the options ``data.*`` of a configuration.

    Raises:
        DataError: if its class does not take one of the options, or needs another.
    """
    if isinstance(make, SceneSource):
        return make
    try:
        inspect.signature(make).bind(**options)
    except TypeError as error:
        raise DataError(
            f"the dataset's loader does not accept these options (data.*): {error}; remove the option; if a preset "
            "(evaluation=synthetic) sets it, choose another preset or remove it with '~data.NAME'"
        ) from error
    return make(**options)
