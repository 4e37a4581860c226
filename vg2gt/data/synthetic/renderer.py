"""Renders a world of textured parts with point lights and shadows: colour and exact z-depth.

A numba kernel renders a frame and releases the GIL, so frames can be rendered in parallel threads. The image is
processed in tiles: all rays of a tile are cast first, then shaded with the parts that can cast a shadow on the tile's
hits. Highlights and the sky are compiled in only if a world has them (``None`` is a type to numba).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.synthetic.raycast import FAR, find_occluder, jit, nearest_hit, part, parts_in_cone, surface, unowned
from vg2gt.data.synthetic.textures import fractal_noise, pattern_value

_TILE = 8
SAMPLES = 2  # colour samples per axis and pixel
_LIFT = 1e-4  # metres by which a shadow ray starts above its surface
_SHADOW = 0.2  # fraction of a light that reaches points in its shadow; approximates indirect light
GAMMA = 1 / 1.8

# Columns of a sky: linear colours at the horizon and the zenith; direction and glow of the sun; cover, frequency and
# seed of the clouds.
_HORIZON, _ZENITH, _SUN, _GLOW, CLOUDS, _CLOUD_FREQUENCY, _CLOUD_SEED, SKY_COLUMNS = 0, 3, 6, 9, 10, 11, 12, 13

_GROUND = -5  # hit of a ray that leaves an open world downwards (-1 - floor); all other walls are sky


@dataclass(frozen=True)
class World:
    """Geometry, materials and lights of a scene, in metres, z up.

    Attributes:
        walls: ``[2, 3]`` lower and upper corner of the room that contains everything; in an open world, of the visible
            part of the ground.
        wall_materials: ``[6]`` materials of the walls x-, x+, y-, y+, floor, ceiling.
        parts: ``[n, PART_COLUMNS]`` boxes, cylinders and ellipsoids (columns: ``raycast.py``).
        part_materials: ``[n]`` material of every part.
        groups: ``[g, GROUP_COLUMNS]`` bounding spheres of consecutive parts.
        materials: ``[m, 13]`` pattern, frequency, seed, colour a (3), colour b (3), and strength and frequency of a
            slow and of a fine tonal variation.
        lights: ``[l, 6]`` position and colour.
        ambient: intensity of the ambient light.
        highlights: ``[m, 2]`` strength and Blinn-Phong exponent of the materials; None: no highlights.
        sky: ``[SKY_COLUMNS]`` (columns above), replaces the ceiling and the four walls; None: a closed world.
    """

    walls: NDArray[np.float64]
    wall_materials: NDArray[np.int64]
    parts: NDArray[np.float64]
    part_materials: NDArray[np.int64]
    groups: NDArray[np.float64]
    materials: NDArray[np.float64]
    lights: NDArray[np.float64]
    ambient: float
    highlights: NDArray[np.float64] | None = None
    sky: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class RenderedFrame:
    """One rendered frame.

    Attributes:
        image: ``[H, W, 3]`` uint8.
        depth: ``[H, W]`` float32 z-depth in metres at the exact pixel centres, 0 in the sky.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]


def render_frame(
    world: World,
    world_to_camera: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    size: tuple[int, int],
    samples: int = SAMPLES,
) -> RenderedFrame:
    """Renders one camera.

    Args:
        world: the world to render.
        world_to_camera: ``[4, 4]`` OpenCV pose; the camera must be inside the walls and outside all parts.
        intrinsics: ``[3, 3]`` in pixels, integer pixel centres, no skew.
        size: image ``(height, width)``.
        samples: colour samples per axis and pixel; 1 takes a third of the time of 2, but leaves jagged edges.
    """
    frame = RenderedFrame(np.empty((*size, 3), np.uint8), np.empty(size, np.float32))
    rotation = np.ascontiguousarray(world_to_camera[:3, :3])
    origin = -rotation.T @ world_to_camera[:3, 3]
    camera = (intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2])
    geometry = (world.parts, world.groups, world.walls)
    look = (world.part_materials, world.wall_materials, world.materials, world.lights, world.ambient)
    extras = (world.highlights, world.sky)
    out = (frame.image, frame.depth)
    _render((origin, rotation), camera, geometry, look, extras, samples, _workspace(world, samples), out)
    return frame


def _workspace(world: World, samples: int) -> tuple[tuple[NDArray, ...], ...]:
    """Allocates the kernel's buffers. Python must own them, because the kernel uses ``unowned`` arrays."""
    rays, lights, parts = _TILE * _TILE * samples**2, len(world.lights), len(world.parts)
    hits = (np.empty((rays, 3)), np.empty((rays, 3)), np.empty(rays), np.empty(rays, np.int64))
    seen = (np.empty(parts, np.int64), np.empty(parts))
    shadows = (np.empty((lights, parts), np.int64), np.zeros(lights, np.int64), np.full(lights, -1))
    return hits, seen, shadows, (np.empty(3), np.empty(3), np.empty(3))


@part
def _add_sky(sky, d, angle, color):
    """Adds the linear colour of the sky in unit direction ``d`` to ``color``; ``angle`` is the pixel width (rad)."""
    height = max(d[2], 0.0)
    blend = math.sqrt(height)
    toward = max(d[0] * sky[_SUN] + d[1] * sky[_SUN + 1] + d[2] * sky[_SUN + 2], 0.0)
    glow = sky[_GLOW] * (toward**8 + 4.0 * toward**400)
    cover = 0.0
    if height > 0.02 and sky[CLOUDS] > 0.0:  # clouds lie on a plane overhead and fade towards the horizon
        u, v = d[0] / height, d[1] / height
        noise = fractal_noise(u, v, sky[_CLOUD_FREQUENCY], 5, angle / (height * height), int(sky[_CLOUD_SEED]))
        cover = min(max(sky[CLOUDS] * (noise + 0.1), 0.0), 1.0) * min(6.0 * height, 1.0)
    for i in range(3):
        clear = sky[_HORIZON + i] + blend * (sky[_ZENITH + i] - sky[_HORIZON + i])
        color[i] += clear + cover * (0.9 - clear) + glow


@part
def _ray(x, y, rotation, camera, d):
    """Writes the unit world direction through image position (x, y) to ``d``; returns its camera-frame z."""
    cx = (x - camera[2]) / camera[0]
    cy = (y - camera[3]) / camera[1]
    z = 1.0 / math.sqrt(cx * cx + cy * cy + 1.0)
    for axis in range(3):
        d[axis] = (rotation[0, axis] * cx + rotation[1, axis] * cy + rotation[2, axis]) * z
    return z


@part
def _tile_cone(y0, x0, y1, x1, rotation, camera, corner, axis):
    """Writes the axis of a cone around a tile's rays; returns its half opening angle. Overwrites ``corner``."""
    _ray(0.5 * (x0 + x1 - 1), 0.5 * (y0 + y1 - 1), rotation, camera, axis)
    cosine = 1.0
    for x in (x0 - 0.5, x1 - 0.5):
        for y in (y0 - 0.5, y1 - 0.5):
            _ray(x, y, rotation, camera, corner)
            cosine = min(cosine, axis[0] * corner[0] + axis[1] * corner[1] + axis[2] * corner[2])
    return math.acos(min(cosine, 1.0)) + 1e-6


@part
def _light_cone(light, points, count, axis):
    """Writes the axis of a cone from a light around points; returns its half opening angle and length."""
    distance = squared = 0.0
    for i in range(3):
        low = high = points[0, i]
        for k in range(count):
            low, high = min(low, points[k, i]), max(high, points[k, i])
        squared += (high - low) * (high - low)
        axis[i] = 0.5 * (low + high) - light[i]
        distance += axis[i] * axis[i]
    radius = 1e-3 + 0.5 * math.sqrt(squared)
    distance = math.sqrt(distance)
    for i in range(3):
        axis[i] /= max(distance, 1e-9)
    return (math.asin(radius / distance) if radius < distance else math.pi), distance + radius


@part
def _leave_out_sky(hits, points, count, origin):
    """Moves points in the sky, which receive no shadows, to another point of the tile or the camera."""
    x, y, z = origin[0], origin[1], origin[2]
    for k in range(count):
        if hits[k] < 0 and hits[k] != _GROUND:
            points[k, 0], points[k, 1], points[k, 2] = x, y, z
        else:
            x, y, z = points[k, 0], points[k, 1], points[k, 2]


@part
def _shade(hit, t, p, d, footprint, parts, look, highlights, sky, shadowing, counts, guesses, color):
    """Adds the linear colour of one ray's hit to ``color``; ``shadowing`` lists possible occluders for every light."""
    part_materials, wall_materials, materials, lights, ambient = look
    shallow = 0.15
    if sky is not None:
        if hit < 0 and hit != _GROUND:
            _add_sky(sky, d, footprint, color)
            return
        shallow = 0.03  # otherwise the far ground would flicker
    nx, ny, nz, u, v = surface(hit, parts, p[0], p[1], p[2])
    m = part_materials[hit] if hit >= 0 else wall_materials[-1 - hit]
    cosine = abs(nx * d[0] + ny * d[1] + nz * d[2])
    width = footprint * t / max(cosine, shallow)
    seed = int(materials[m, 2])
    mix = pattern_value(int(materials[m, 0]), u, v, materials[m, 1], width, seed)
    tone = 1.0 + materials[m, 9] * fractal_noise(u, v, materials[m, 10], 2, width, seed + 31)
    tone += materials[m, 11] * fractal_noise(u, v, materials[m, 12], 2, width, seed + 57)
    red = green = blue = ambient * (0.85 + 0.15 * nz)
    for i in range(lights.shape[0]):
        ex, ey, ez = lights[i, 0] - p[0], lights[i, 1] - p[1], lights[i, 2] - p[2]
        squared = ex * ex + ey * ey + ez * ez
        distance = math.sqrt(squared)
        ex, ey, ez = ex / distance, ey / distance, ez / distance
        facing = nx * ex + ny * ey + nz * ez
        if facing <= 0.0:
            continue
        sx, sy, sz = p[0] + _LIFT * nx, p[1] + _LIFT * ny, p[2] + _LIFT * nz
        guess = find_occluder(shadowing[i], counts[i], parts, sx, sy, sz, ex, ey, ez, distance, guesses[i])
        guesses[i] = guess
        strength = (_SHADOW if guess >= 0 else 1.0) * facing / (0.5 + 0.25 * squared)
        red += strength * lights[i, 3]
        green += strength * lights[i, 4]
        blue += strength * lights[i, 5]
        if highlights is not None and guess < 0:
            away = nx * d[0] + ny * d[1] + nz * d[2]
            length = math.sqrt((ex - d[0]) ** 2 + (ey - d[1]) ** 2 + (ez - d[2]) ** 2)
            glint = highlights[m, 0] * max((facing - away) / length, 0.0) ** highlights[m, 1]
            glint /= 0.5 + 0.25 * squared
            for channel in range(3):
                color[channel] += glint * lights[i, 3 + channel]
    color[0] += tone * (materials[m, 3] + mix * (materials[m, 6] - materials[m, 3])) * red
    color[1] += tone * (materials[m, 4] + mix * (materials[m, 7] - materials[m, 4])) * green
    color[2] += tone * (materials[m, 5] + mix * (materials[m, 8] - materials[m, 5])) * blue


@part
def _cast_centers(tile, origin, rotation, camera, geometry, sky, seen, d, depth):
    """Writes the depth of a tile at the pixel centres; overwrites ``d``."""
    parts, _, walls = geometry
    visible, near, count = seen
    y0, x0, y1, x1 = tile
    ox, oy, oz = origin[0], origin[1], origin[2]
    for y in range(y0, y1):
        for x in range(x0, x1):
            z = _ray(float(x), float(y), rotation, camera, d)
            t, hit = nearest_hit(visible, near, count, parts, walls, ox, oy, oz, d[0], d[1], d[2])
            in_sky = sky is not None and hit < 0 and hit != _GROUND
            depth[y, x] = 0.0 if in_sky else t * z


@part
def _cast_samples(tile, samples, origin, rotation, camera, geometry, seen, rays):
    """Writes the hits of a tile's colour samples, pixel by pixel; returns the number of samples."""
    parts, _, walls = geometry
    visible, near, count = seen
    points, directions, distances, hits = rays
    y0, x0, y1, x1 = tile
    ox, oy, oz = origin[0], origin[1], origin[2]
    step = 1.0 / samples
    k = 0
    for y in range(y0, y1):
        for x in range(x0, x1):
            for sample in range(samples * samples):
                d = directions[k]
                sx = x + (sample % samples + 0.5) * step - 0.5
                sy = y + (sample // samples + 0.5) * step - 0.5
                _ray(sx, sy, rotation, camera, d)
                t, hits[k] = nearest_hit(visible, near, count, parts, walls, ox, oy, oz, d[0], d[1], d[2])
                distances[k] = t
                points[k, 0], points[k, 1], points[k, 2] = ox + t * d[0], oy + t * d[1], oz + t * d[2]
                k += 1
    return k


@jit
def _render(pose, camera, geometry, look, extras, samples, workspace, out):
    origin, rotation = unowned(pose)
    geometry, look = unowned(geometry), unowned(look)
    parts, groups, _ = geometry
    lights = look[3]
    highlights, sky = unowned(extras)
    rays, (visible, near), (shadowing, counts, guesses), (axis, color, ray) = unowned(workspace)
    points, directions, distances, hits = rays
    image, depth = unowned(out)
    height, width = image.shape[:2]
    per_pixel = samples * samples
    for y0 in range(0, height, _TILE):
        for x0 in range(0, width, _TILE):
            y1, x1 = min(y0 + _TILE, height), min(x0 + _TILE, width)
            spread = _tile_cone(y0, x0, y1, x1, rotation, camera, ray, axis)
            count = parts_in_cone(origin, axis, spread, FAR / 2, parts, groups, visible, near)
            seen = (visible, near, count)
            tile = (y0, x0, y1, x1)
            _cast_centers(tile, origin, rotation, camera, geometry, sky, seen, ray, depth)
            k = _cast_samples(tile, samples, origin, rotation, camera, geometry, seen, rays)
            if sky is not None:
                _leave_out_sky(hits, points, k, origin)
            for i in range(len(lights)):
                spread, reach = _light_cone(lights[i], points, k, axis)
                counts[i] = parts_in_cone(lights[i, :3], axis, spread, reach, parts, groups, shadowing[i], near)
            k = 0
            for y in range(y0, y1):
                for x in range(x0, x1):
                    color[0] = color[1] = color[2] = 0.0
                    for _ in range(per_pixel):
                        _shade(
                            hits[k], distances[k], points[k], directions[k], 1.0 / samples / camera[0],
                            parts, look, highlights, sky, shadowing, counts, guesses, color,
                        )  # fmt: skip
                        k += 1
                    for i in range(3):
                        value = min(max(color[i] / per_pixel, 0.0), 1.0) ** GAMMA
                        image[y, x, i] = int(255.0 * value + 0.5)
