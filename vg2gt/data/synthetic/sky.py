"""Sky of open worlds: a gradient from horizon to zenith, a glow around the sun, and clouds. It has no depth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.synthetic.raycast import part
from vg2gt.data.synthetic.textures import fractal_noise

# Columns of a sky: linear colours at the horizon and the zenith; direction and glow of the sun; cover, frequency and
# seed of the clouds.
HORIZON, ZENITH, SUN, GLOW, CLOUDS, CLOUD_FREQUENCY, CLOUD_SEED, SKY_COLUMNS = 0, 3, 6, 9, 10, 11, 12, 13

GROUND = -5  # hit of a ray that leaves an open world downwards (-1 - floor); all other walls are sky


def draw_sky(rng: np.random.Generator, sun: NDArray[np.float64]) -> NDArray[np.float64]:
    """Draws a sky ``[SKY_COLUMNS]`` with the sun in unit direction ``sun`` ``[3]``."""
    blue = rng.uniform((0.08, 0.2, 0.5), (0.2, 0.36, 0.8))
    haze = rng.uniform((0.5, 0.58, 0.65), (0.75, 0.75, 0.8))
    clouds = (rng.uniform(0.0, 1.2), rng.uniform(0.5, 1.5), rng.integers(1 << 20))
    return np.array([*haze, *blue, *sun, rng.uniform(0.1, 0.5), *clouds])


@part
def add_sky(sky, d, angle, color):
    """Adds the linear colour of the sky in unit direction ``d`` to ``color``; ``angle`` is the pixel width (rad)."""
    height = max(d[2], 0.0)
    blend = math.sqrt(height)
    toward = max(d[0] * sky[SUN] + d[1] * sky[SUN + 1] + d[2] * sky[SUN + 2], 0.0)
    glow = sky[GLOW] * (toward**8 + 4.0 * toward**400)
    cover = 0.0
    if height > 0.02 and sky[CLOUDS] > 0.0:  # clouds lie on a plane overhead and fade towards the horizon
        u, v = d[0] / height, d[1] / height
        noise = fractal_noise(u, v, sky[CLOUD_FREQUENCY], 5, angle / (height * height), int(sky[CLOUD_SEED]))
        cover = min(max(sky[CLOUDS] * (noise + 0.1), 0.0), 1.0) * min(6.0 * height, 1.0)
    for i in range(3):
        clear = sky[HORIZON + i] + blend * (sky[ZENITH + i] - sky[HORIZON + i])
        color[i] += clear + cover * (0.9 - clear) + glow
