"""What a dataset is: scenes of posed frames with depth. Every loader implements ``SceneSource`` and nothing else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from vg2gt.io.errors import DataError
from vg2gt.types import TensorRecord

__all__ = ["DataError", "Frames", "SceneSource", "SourceMaker", "training_frames"]


@dataclass(frozen=True)
class Frames(TensorRecord):
    """Some frames of one scene, all of one size.

    Attributes:
        images: ``[V, 3, H, W]`` float32 in [0, 1].
        depth: ``[V, H, W]`` float32 z-depth in the dataset's unit, 0 = invalid; the same pixels as ``images``.
        world_to_camera: ``[V, 4, 4]`` float32 rigid OpenCV poses.
        intrinsics: ``[V, 3, 3]`` float32 in pixels, integer pixel centres.
        sparse_depth: depth is at single pixels only (laser, triangulated points): resizing moves points instead of
            looking up the nearest pixel.
        mask: ``[V, H, W]`` float32 in [0, 1], how much each pixel counts (alpha, mask images); None: all count.
    """

    images: Tensor
    depth: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    sparse_depth: bool = False
    mask: Tensor | None = None

    @staticmethod
    def concatenate(parts: Sequence[Frames]) -> Frames:
        """Joins frames of one scene and size along the views."""
        names = ("images", "depth", "world_to_camera", "intrinsics")
        mask = None
        if any(part.mask is not None for part in parts):
            mask = torch.cat([torch.ones_like(part.depth) if part.mask is None else part.mask for part in parts])
        joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        return replace(parts[0], **joined, mask=mask)


class SceneSource(ABC):
    """Scenes of a dataset, in the framework's conventions (``docs/concepts/conventions.md``).

    A source says which scenes and frames there are without decoding them, and decodes frames when asked. It neither
    resizes nor caches decoded frames: the data module does that for all sources. It must be picklable, and what it
    returns must depend on its arguments only, so that worker processes agree.

    Attributes:
        is_metric: whether the unit of depth and poses is the metre, in all scenes.
        has_depth: whether frames have depth; without it a source serves reconstruction and novel views, not training.
        dense_depth: whether depth, where there is any, covers images as a depth camera's does.
        has_cameras: whether poses and intrinsics are known; without them they are placeholders, for reconstruction
            only, which makes its own.
    """

    is_metric: bool = True
    has_depth: bool = True
    dense_depth: bool = True
    has_cameras: bool = True

    @property
    @abstractmethod
    def scenes(self) -> Sequence[str]:
        """Names of the scenes, unique and in a fixed order."""

    @abstractmethod
    def frames(self, scene: str) -> Sequence[int]:
        """Ids of the scene's usable frames, in the order in which they were taken."""

    def held_out(self, scene: str) -> Sequence[int]:
        """Ids among ``frames`` that training never sees, kept as evaluation targets; none by default."""
        return ()

    def place(self, scene: str) -> str:
        """Name of what the scene shows: two recordings of one place must not be split between training and evaluation.

        The scene itself, unless the dataset records places several times.
        """
        return scene

    def scene_is_metric(self, scene: str) -> bool:
        """Whether one scene's unit is the metre."""
        return self.is_metric

    def parts(self) -> Mapping[str, float]:
        """Groups of scenes (``part``) with the weights by which training draws from them; one group by default."""
        return {"": 1.0}

    def part(self, scene: str) -> str:
        """The group among ``parts`` to which a scene belongs."""
        return ""

    @abstractmethod
    def load(self, scene: str, frame_ids: Sequence[int]) -> Frames:
        """Decodes frames, in the order of ``frame_ids``.

        Raises:
            DataError: if a file is missing or damaged, naming the file and the scene.
        """


SourceMaker = Callable[..., SceneSource]
"""What makes a source from keyword arguments, such as a Hydra partial."""


def training_frames(source: SceneSource, scene: str) -> list[int]:
    """Frame ids of a scene that training may see: all but the held-out ones."""
    held_out = set(source.held_out(scene))
    return [frame for frame in source.frames(scene) if frame not in held_out]
