"""Procedural room with a chair that moves while the camera moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.synthetic.builder import Builder
from vg2gt.data.synthetic.furniture import chair
from vg2gt.data.synthetic.renderer import World
from vg2gt.data.synthetic.rooms import SyntheticRoom
from vg2gt.data.synthetic.synthetic_scene import level_poses

_DRAWS = 2000
_LONGEST = 2.0  # length of free floor for the chair in metres


class SyntheticMovingRoom(SyntheticRoom):
    """The room of the same seed with an extra chair that glides across the floor, seen from cameras on an arc.

    Args:
        seed, num_frames, size, highlights: see :class:`~vg2gt.data.synthetic.rooms.SyntheticRoom`; the chair is matt.
        distance: distance between the chair's first and last position in metres, at most 2.
        during: start and end of the motion, from 0 (first frame) to 1 (last frame); if equal, the chair jumps.

    Attributes:
        places: position of the chair in every frame ``[n, 3]``.
    """

    version = 1  # increment whenever the same seed would give different pixels

    def __init__(
        self,
        seed: int,
        num_frames: int,
        size: tuple[int, int],
        highlights: bool | str = False,
        distance: float = 1.5,
        during: tuple[float, float] = (0.5, 0.8),
    ) -> None:
        start, end = during
        passed = (np.linspace(0, 1, num_frames) - start) / max(end - start, 1e-6)
        self._steps = distance * (np.clip(passed, 0, 1) - 0.5)
        super().__init__(seed, num_frames, size, highlights)

    def world_at(self, frame: int) -> World:
        """Returns the room with the chair at its position in a frame."""
        builder = Builder(np.random.default_rng(self._look))
        builder.place(self.places[frame], self._yaw)
        chair(builder)
        builder.end_group()
        more, room = builder.arrays(), self.world
        more["part_materials"] += len(room.materials)
        more["groups"][:, 4:] += len(room.parts)
        joined = {name: np.concatenate((getattr(room, name), more[name])) for name in more}
        shine = room.highlights
        if shine is not None:
            shine = np.concatenate((shine, np.tile((0.0, 1.0), (len(more["materials"]), 1))))
        return replace(room, highlights=shine, **joined)

    def _path(
        self, rng: np.random.Generator, extent: NDArray[np.float64], occupied: NDArray[np.float64], count: int
    ) -> NDArray[np.float64]:
        """Camera-to-world poses ``[count, 4, 4]`` on an arc around the chair's path, chosen for most free space."""
        # random candidates of camera arc and chair path
        half = extent[:2] / 2
        middle = rng.uniform(-0.6, 0.6, (_DRAWS, 1, 2)) * half
        around = rng.uniform(0, 2 * np.pi, (_DRAWS, 1)) + rng.uniform(0.6, 1.4, (_DRAWS, 1)) * np.linspace(-0.5, 0.5, 8)
        reach = rng.uniform(1.6, 2.6, (_DRAWS, 1, 1))
        arc = middle + reach * np.stack((np.cos(around), np.sin(around)), -1)  # [draws, 8, 2]
        turn = rng.uniform(0, np.pi, (_DRAWS, 1))
        along = np.stack((np.cos(turn), np.sin(turn)), -1)
        way = middle + np.linspace(-0.5, 0.5, 5)[:, None] * _LONGEST * along  # [draws, 5, 2]
        # choose the one with the most space around arc, path and lines of sight
        sight = [way[:, None] + part * (arc[:, :, None] - way[:, None]) for part in (0.25, 0.5, 0.75)]
        free = [_free(points.reshape(_DRAWS, -1, 2), occupied) for points in (arc, way, *sight)]
        walls = [(half - np.abs(arc)).min((1, 2)) - 0.3, (half - np.abs(way)).min((1, 2)) - 0.3]
        best = int(np.argmax(np.minimum(np.min([*free, *walls], axis=0), 0.1)))
        self._yaw, self._look = rng.uniform(0, 2 * np.pi), int(rng.integers(1 << 31))
        self.places = np.pad(middle[best] + self._steps[:, None] * along[best], ((0, 0), (0, 1)))
        angle = np.interp(np.linspace(0, 1, count), np.linspace(0, 1, 8), around[best])
        position = middle[best] + reach[best] * np.stack((np.cos(angle), np.sin(angle)), 1)
        height = np.full(count, rng.uniform(1.2, 1.6))
        pan = angle + np.pi + rng.normal(0, 0.05, count)
        return level_poses(np.column_stack((position, height)), pan, np.full(count, -0.35))


def _free(points: NDArray[np.float64], occupied: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smallest gap ``[draws]`` in metres between points ``[draws, n, 2]`` and occupied discs ``[m, 3]`` (x, y, r)."""
    gaps = [np.linalg.norm(points - one[:2], axis=-1).min(1) - one[2] for one in occupied]
    return np.min(gaps, axis=0) if gaps else np.full(len(points), np.inf)
