"""The data set of all procedural worlds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

from examples.worlds.moving import SyntheticMovingRoom
from examples.worlds.orbits import SyntheticLandmark, SyntheticObject
from examples.worlds.outdoor import SyntheticOutdoor
from examples.worlds.photograph import Photograph
from examples.worlds.wide import SyntheticWideRoom
from vg2gt.data.synthetic.source import SyntheticScenes
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene


class Worlds(SyntheticScenes):
    """Rooms, outdoor scenes, objects and landmarks with exact depth and poses. The sky has no depth.

    Args:
        num_scenes: scenes in this source.
        exposure: scenes are too dark or too bright by this many stops (standard deviation), with noise; 0: none is.
        jpeg: range of qualities, such as ``[30, 95]``, at which images are compressed; None: they are not.
        shared: see :class:`vg2gt.data.SyntheticScenes`; ``variant`` may also be ``wide`` (rooms from all around),
            ``outdoor``, ``object`` (orbits), ``landmark`` (far backgrounds) or ``moving`` (a chair that moves), or a
            list of them: seeds take turns.

    Raises:
        ValueError: if a number is out of range or a variant unknown.
    """

    variants: ClassVar[dict[str, Any]] = {
        **SyntheticScenes.variants,
        "wide": SyntheticWideRoom,
        "outdoor": SyntheticOutdoor,
        "object": SyntheticObject,
        "landmark": SyntheticLandmark,
        "moving": SyntheticMovingRoom,
    }

    def __init__(
        self, num_scenes: int = 64, exposure: float = 0.0, jpeg: Sequence[int] | None = None, **shared: Any
    ) -> None:
        self._photograph = Photograph.of(exposure, jpeg)
        super().__init__(num_scenes, **shared)

    @property
    def look(self) -> str:
        """What decides the pixels apart from scene and size, as part of file names."""
        return super().look + (self._photograph.name if self._photograph else "")

    def scene(self, scene: str) -> SyntheticScene:
        """Makes a scene, ready to be rendered."""
        made = super().scene(scene)
        made.develop = partial(self._photograph.develop, int(scene.rpartition("-")[2])) if self._photograph else None
        return made
