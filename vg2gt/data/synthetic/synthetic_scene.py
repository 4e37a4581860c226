"""Base class of procedural scenes: a world, a camera path through it, and rendering."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.synthetic.renderer import SAMPLES, RenderedFrame, World, render_frame

_HIGHLIGHTS = 1  # separates the random stream of the highlights from that of the scene
_MATT_SHARE = 0.3
LOBES = "lobes"
"""Value of ``highlights`` that selects strong highlights."""


class SyntheticScene:
    """A world and a camera path through it, in metres, z up.

    Args:
        world: the rendered world.
        camera_to_world: ``[n, 4, 4]`` OpenCV poses.
        field_of_view: angle along the longer side of the image (rad).
        size: image ``(height, width)``.
        stream: seed of the scene's random stream.
        highlights: see :func:`draw_highlights`; changes only colours.

    Attributes:
        world_to_camera: ``[n, 4, 4]`` float64.
        intrinsics: ``[3, 3]`` float64 in pixels, integer pixel centres.
        develop: post-processing of rendered images, called with the image and the frame number; None: none.
    """

    def __init__(
        self,
        world: World,
        camera_to_world: NDArray[np.float64],
        field_of_view: float,
        size: tuple[int, int],
        stream: tuple[int, ...] = (),
        highlights: bool | str = False,
    ) -> None:
        if highlights:
            world = replace(world, highlights=draw_highlights(stream, len(world.materials), highlights))
        self.world = world
        self.size = size
        self.develop: Callable[[NDArray[np.uint8], int], NDArray[np.uint8]] | None = None
        self.world_to_camera = np.linalg.inv(camera_to_world)
        focal = 0.5 * max(size) / np.tan(field_of_view / 2)
        self.intrinsics = np.array([[focal, 0, (size[1] - 1) / 2], [0, focal, (size[0] - 1) / 2], [0, 0, 1]])

    def world_at(self, frame: int) -> World:
        """Returns the world of a frame; by default the same for all frames. Override it for moving objects."""
        return self.world

    def render(self, frames: Sequence[int], threads: int, samples: int = SAMPLES) -> list[RenderedFrame]:
        """Renders frames of the path, ``threads`` at a time, with ``samples ** 2`` colour samples per pixel."""

        def render(frame: int) -> RenderedFrame:
            made = render_frame(self.world_at(frame), self.world_to_camera[frame], self.intrinsics, self.size, samples)
            return replace(made, image=self.develop(made.image, frame)) if self.develop else made

        if threads == 1:
            return [render(frame) for frame in frames]
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(render, frames))


def level_poses(
    position: NDArray[np.float64], pan: NDArray[np.float64], nod: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns camera-to-world poses ``[n, 4, 4]`` of cameras without roll.

    Args:
        position: ``[n, 3]`` camera centres.
        pan: ``[n]`` angle about the vertical (rad); 0 looks along x.
        nod: ``[n]`` upward angle (rad).
    """
    forward = np.stack((np.cos(pan) * np.cos(nod), np.sin(pan) * np.cos(nod), np.sin(nod)), 1)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(position), 1, 1))
    poses[:, :3, 0] = right
    poses[:, :3, 1] = np.cross(forward, right)
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = position
    return poses


def draw_highlights(seed: tuple[int, ...], materials: int, kind: bool | str = True) -> NDArray[np.float64]:
    """Draws the strength and Blinn-Phong exponent ``[m, 2]`` of every material; 30 % of the materials stay matt.

    Uses a separate random stream, so that nothing else in the scene changes. The exponent is ``2 / roughness^2 - 2``,
    where ``roughness`` is the standard deviation of microfacet slopes.

    Args:
        seed: seed of the scene's random stream.
        materials: number of materials.
        kind: True, or ``lobes`` for highlights up to three times stronger and from sharp to broad, like those of
            lacquer, metal and windows reflected in a floor.
    """
    rng = np.random.default_rng((*seed, _HIGHLIGHTS))
    strong = kind == LOBES
    strength = rng.uniform(*((0.3, 2.7) if strong else (0.15, 0.9)), materials) * (rng.random(materials) >= _MATT_SHARE)
    roughness = np.exp(rng.uniform(np.log(0.04 if strong else 0.1), np.log(0.8 if strong else 0.6), materials))
    return np.stack((strength, 2 / roughness**2 - 2), 1)
