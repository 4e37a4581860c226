"""Rooms with wide baselines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.synthetic.rooms import TRIES, SyntheticRoom
from vg2gt.data.synthetic.synthetic_scene import level_poses


class SyntheticWideRoom(SyntheticRoom):
    """The room of the same seed, viewed across from free positions all around (wide baselines)."""

    def _path(
        self, rng: np.random.Generator, extent: NDArray[np.float64], occupied: NDArray[np.float64], count: int
    ) -> NDArray[np.float64]:
        """Camera-to-world poses ``[count, 4, 4]``, ordered by angle around the room's centre."""
        draws = rng.uniform(-0.5, 0.5, (max(TRIES, 20 * count), 2)) * (extent[:2] - 0.7)
        gaps = np.linalg.norm(draws[:, None] - occupied[None, :, :2], axis=-1) - occupied[None, :, 2]
        free = np.argsort(-np.minimum(gaps.min(1, initial=np.inf), 0.2), kind="stable")
        places = draws[free[: 3 * count]]
        chosen = [0]  # farthest-point sampling
        while len(chosen) < count:
            apart = np.linalg.norm(places[:, None] - places[None, chosen], axis=-1).min(1)
            chosen.append(int(np.argmax(apart)))
        places = places[chosen]
        places = places[np.argsort(np.arctan2(places[:, 1], places[:, 0]))]
        ahead = rng.normal(0, 0.1, (count, 2)) * extent[:2] - places
        height = np.minimum(rng.uniform(0.9, 1.8, count), extent[2] - 0.4)
        pan = np.arctan2(ahead[:, 1], ahead[:, 0]) + rng.normal(0, 0.25, count)
        return level_poses(np.column_stack((places, height)), pan, rng.uniform(-0.4, 0.05, count))
