"""More procedural scenes as a plug-in: streets, objects and landmarks besides rooms, with photographic flaws.

``python train.py --config-dir examples/worlds/configs data=worlds data.variant=[room,outdoor]`` trains on them. The
shipped plane sweep was trained on these worlds (``recipes/sweep``).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

from examples.worlds.moving import SyntheticMovingRoom
from examples.worlds.orbits import SyntheticLandmark, SyntheticObject, SyntheticWideRoom
from examples.worlds.outdoor import SyntheticOutdoor
from examples.worlds.photograph import Photograph
from vg2gt.data.synthetic.source import SyntheticScenes
from vg2gt.data.synthetic.synthetic_scene import SyntheticScene


class Worlds(SyntheticScenes):
    """Rooms, outdoor scenes, objects and landmarks with exact depth and poses. The sky has no depth.

    Args:
        num_scenes: number of scenes.
        exposure: standard deviation of the exposure error of scenes in stops, with sensor noise; 0 for none.
        jpeg: range of JPEG qualities for compression, such as ``[30, 95]``; None for no compression.
        shared: see :class:`vg2gt.data.SyntheticScenes`. ``variant`` may also be ``wide`` (rooms with wide baselines),
            ``outdoor``, ``object`` (orbits), ``landmark`` (far backgrounds) or ``moving`` (a chair that moves), or a
            list of variants, which alternate by seed.

    Raises:
        ValueError: if a number is out of range or a variant is unknown.
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
        self._photograph = Photograph(float(exposure), None if jpeg is None else tuple(map(int, jpeg)))
        super().__init__(num_scenes, **shared)

    @property
    def look(self) -> str:
        """Part of file names for all options that affect the pixels, other than scene and size."""
        return super().look + self._photograph.name

    def scene(self, scene: str) -> SyntheticScene:
        """Creates a scene, ready to render."""
        made = super().scene(scene)
        made.develop = partial(self._photograph.develop, int(scene.rpartition("-")[2]))
        return made
