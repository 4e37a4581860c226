"""Analytic ray casting of boxes, cylinders and ellipsoids inside a room, with point lights and shadows.

One numba kernel renders a frame and releases the interpreter's lock, so frames are rendered by threads. The room's z
axis points up; cameras are OpenCV. Parts (primitives) belong to groups with bounding spheres: a part is tested only if
the ray meets its group's sphere, and primary rays only visit the groups that an image tile can see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from vg2gt.data.textures import fractal_noise, pattern_value

BOX, CYLINDER, ELLIPSOID = 0, 1, 2

_FAR = 1e9
_EPSILON = 1e-9
_LIFT = 1e-4  # metres by which a shadow ray starts above its surface
_TILE = 16
_SUBSAMPLES = 2  # per axis and pixel
_SHADOW = 0.2  # share of a light that reaches a point in its shadow, standing in for bounced light
_GAMMA = 1 / 1.8


@dataclass(frozen=True)
class Room:
    """Geometry, materials and lights of one room, as the kernel takes them. Metres, z up.

    Attributes:
        lower: ``[3]`` lower corner of the room's inside.
        upper: ``[3]`` upper corner.
        shell: ``[6]`` materials of the walls x-, x+, y-, y+, floor, ceiling.
        kind: ``[n]`` BOX, CYLINDER (axis z) or ELLIPSOID of every part.
        center: ``[n, 3]`` part centres.
        axes: ``[n, 3, 3]`` rows are a part's own axes in the world.
        half: ``[n, 3]`` half extents (radii) along them.
        material: ``[n]`` material of every part.
        group_start: ``[g + 1]`` parts of group i are ``group_start[i]:group_start[i + 1]``.
        group_center: ``[g, 3]`` bounding spheres.
        group_radius: ``[g]``.
        materials: ``[m, 13]`` pattern, frequency, seed, colour a (3), colour b (3), and strength and frequency of a
            slow and of a fine tonal variation.
        lights: ``[l, 6]`` position and colour.
        ambient: light from everywhere.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    shell: NDArray[np.int64]
    kind: NDArray[np.int64]
    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    half: NDArray[np.float64]
    material: NDArray[np.int64]
    group_start: NDArray[np.int64]
    group_center: NDArray[np.float64]
    group_radius: NDArray[np.float64]
    materials: NDArray[np.float64]
    lights: NDArray[np.float64]
    ambient: float


@dataclass(frozen=True)
class RaycastFrame:
    """One rendered frame.

    Attributes:
        image: ``[H, W, 3]`` uint8.
        depth: ``[H, W]`` float32 z-depth in metres at the exact pixel centres.
        normal: ``[H, W, 3]`` float32 unit camera-frame normals there, facing the camera.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    normal: NDArray[np.float32]


def render_frame(room: Room, world_to_camera: NDArray, intrinsics: NDArray, size: tuple[int, int]) -> RaycastFrame:
    """Renders one camera inside a room.

    Args:
        room: what is seen.
        world_to_camera: ``[4, 4]`` OpenCV; the camera must stand in the room and outside of its parts.
        intrinsics: ``[3, 3]`` in pixels, integer pixel centres, no skew.
        size: image ``(height, width)``.
    """
    image = np.empty((*size, 3), np.uint8)
    depth = np.empty(size, np.float32)
    normal = np.empty((*size, 3), np.float32)
    rotation = np.ascontiguousarray(world_to_camera[:3, :3], np.float64)
    origin = -rotation.T @ np.asarray(world_to_camera[:3, 3], np.float64)
    camera = np.array([intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]], np.float64)
    parts = (room.kind, room.center, room.axes, room.half, room.material)
    groups = (room.group_start, room.group_center, room.group_radius)
    shell = (room.lower, room.upper, room.shell)
    _render(
        origin, rotation, camera, parts, groups, shell, room.materials, room.lights, room.ambient, image, depth, normal
    )
    return RaycastFrame(image, depth, normal)


@numba.njit(cache=True, error_model="numpy")
def _safe_inverse(x):
    return 1.0 / x if abs(x) > 1e-12 else 1e12


@numba.njit(cache=True, error_model="numpy")
def _intersect_part(kind, half, ox, oy, oz, dx, dy, dz):
    """Distance at which a ray, given in the part's frame, enters the part; ``_FAR`` if it does not."""
    hx, hy, hz = half[0], half[1], half[2]
    if kind == BOX:
        ix, iy, iz = _safe_inverse(dx), _safe_inverse(dy), _safe_inverse(dz)
        rx, ry, rz = hx * abs(ix), hy * abs(iy), hz * abs(iz)
        enter = max(-ox * ix - rx, -oy * iy - ry, -oz * iz - rz)
        leave = min(-ox * ix + rx, -oy * iy + ry, -oz * iz + rz)
        return enter if _EPSILON < enter < leave else _FAR
    ox, oy, dx, dy = ox / hx, oy / hy, dx / hx, dy / hy
    if kind == CYLINDER:
        iz = _safe_inverse(dz)
        enter = -oz * iz - hz * abs(iz)
        leave = -oz * iz + hz * abs(iz)
        a = dx * dx + dy * dy
        b = ox * dx + oy * dy
        c = ox * ox + oy * oy - 1.0
        discriminant = b * b - a * c
        if discriminant <= 0.0:
            return _FAR
        if a > 1e-12:
            root = math.sqrt(discriminant)
            enter = max(enter, (-b - root) / a)
            leave = min(leave, (-b + root) / a)
        return enter if _EPSILON < enter < leave else _FAR
    oz, dz = oz / hz, dz / hz
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    discriminant = b * b - a * (ox * ox + oy * oy + oz * oz - 1.0)
    if discriminant <= 0.0:
        return _FAR
    enter = (-b - math.sqrt(discriminant)) / a
    return enter if enter > _EPSILON else _FAR


@numba.njit(cache=True, error_model="numpy")
def _intersect(i, parts, ox, oy, oz, dx, dy, dz):
    kind, center, axes, half, _ = parts
    x, y, z = ox - center[i, 0], oy - center[i, 1], oz - center[i, 2]
    a = axes[i]
    return _intersect_part(
        kind[i],
        half[i],
        a[0, 0] * x + a[0, 1] * y + a[0, 2] * z,
        a[1, 0] * x + a[1, 1] * y + a[1, 2] * z,
        a[2, 0] * x + a[2, 1] * y + a[2, 2] * z,
        a[0, 0] * dx + a[0, 1] * dy + a[0, 2] * dz,
        a[1, 0] * dx + a[1, 1] * dy + a[1, 2] * dz,
        a[2, 0] * dx + a[2, 1] * dy + a[2, 2] * dz,
    )


@numba.njit(cache=True, error_model="numpy")
def _leave_shell(shell, ox, oy, oz, dx, dy, dz):
    """Distance to the room's wall along a unit ray from inside, and which of the six it is."""
    lower, upper, _ = shell
    best, wall = _FAR, 0
    for axis in range(3):
        o = (ox, oy, oz)[axis]
        d = (dx, dy, dz)[axis]
        if abs(d) > 1e-12:
            t = ((upper[axis] if d > 0 else lower[axis]) - o) / d
            if t < best:
                best, wall = t, 2 * axis + (1 if d > 0 else 0)
    return best, wall


@numba.njit(cache=True, error_model="numpy")
def _nearest(visible, count, parts, groups, shell, ox, oy, oz, dx, dy, dz):
    """Nearest hit of a unit ray: distance and part, or ``-1 - wall`` for the shell."""
    start, center, radius = groups
    best, wall = _leave_shell(shell, ox, oy, oz, dx, dy, dz)
    hit = -1 - wall
    for k in range(count):
        g = visible[k]
        x, y, z = center[g, 0] - ox, center[g, 1] - oy, center[g, 2] - oz
        along = x * dx + y * dy + z * dz
        r2 = radius[g] * radius[g]
        if x * x + y * y + z * z - along * along > r2 or along - radius[g] > best:
            continue
        for i in range(start[g], start[g + 1]):
            t = _intersect(i, parts, ox, oy, oz, dx, dy, dz)
            if t < best:
                best, hit = t, i
    return best, hit


@numba.njit(cache=True, error_model="numpy")
def _occluder(parts, groups, ox, oy, oz, dx, dy, dz, distance, guess):
    """A part between a point and a light ``distance`` away, -1 if none; ``guess`` is tried first."""
    start, center, radius = groups
    if guess >= 0 and _intersect(guess, parts, ox, oy, oz, dx, dy, dz) < distance:
        return guess
    for g in range(radius.shape[0]):
        x, y, z = center[g, 0] - ox, center[g, 1] - oy, center[g, 2] - oz
        along = x * dx + y * dy + z * dz
        if along < -radius[g] or along > distance + radius[g]:
            continue
        if x * x + y * y + z * z - along * along > radius[g] * radius[g]:
            continue
        for i in range(start[g], start[g + 1]):
            if _intersect(i, parts, ox, oy, oz, dx, dy, dz) < distance:
                return i
    return -1


@numba.njit(cache=True, error_model="numpy")
def _surface(hit, parts, px, py, pz):
    """Outward world normal and surface coordinates (metres) of a point on a part or on the shell."""
    if hit < 0:
        axis = (-1 - hit) // 2
        sign = 1.0 if (-1 - hit) % 2 == 0 else -1.0  # walls face inward
        if axis == 0:
            return sign, 0.0, 0.0, py, pz
        if axis == 1:
            return 0.0, sign, 0.0, px, pz
        return 0.0, 0.0, sign, px, py
    kind, center, axes, half, _ = parts
    x, y, z = px - center[hit, 0], py - center[hit, 1], pz - center[hit, 2]
    a = axes[hit]
    lx = a[0, 0] * x + a[0, 1] * y + a[0, 2] * z
    ly = a[1, 0] * x + a[1, 1] * y + a[1, 2] * z
    lz = a[2, 0] * x + a[2, 1] * y + a[2, 2] * z
    hx, hy, hz = half[hit, 0], half[hit, 1], half[hit, 2]
    qx, qy, qz = lx / hx, ly / hy, lz / hz
    nx, ny, nz, u, v = 0.0, 0.0, 0.0, 0.0, 0.0
    if kind[hit] == BOX:
        if abs(qx) >= abs(qy) and abs(qx) >= abs(qz):
            nx, u, v = math.copysign(1.0, qx), ly, lz
        elif abs(qy) >= abs(qz):
            ny, u, v = math.copysign(1.0, qy), lx, lz
        else:
            nz, u, v = math.copysign(1.0, qz), lx, ly
    elif kind[hit] == CYLINDER and abs(qz) > math.sqrt(qx * qx + qy * qy):
        nz, u, v = math.copysign(1.0, qz), lx, ly
    else:
        nx, ny = qx / hx, qy / hy
        nz = qz / hz if kind[hit] == ELLIPSOID else 0.0
        norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * norm, ny * norm, nz * norm
        u = math.atan2(qy, qx) * 0.5 * (hx + hy)
        v = lz if kind[hit] == CYLINDER else math.asin(min(max(qz, -1.0), 1.0)) * hz
    return (
        a[0, 0] * nx + a[1, 0] * ny + a[2, 0] * nz,
        a[0, 1] * nx + a[1, 1] * ny + a[2, 1] * nz,
        a[0, 2] * nx + a[1, 2] * ny + a[2, 2] * nz,
        u,
        v,
    )


@numba.njit(cache=True, error_model="numpy")
def _shade(hit, t, o, d, footprint, parts, groups, shell, materials, lights, ambient, guesses, color):
    """Adds the colour (linear light) seen along one ray to ``color``."""
    px, py, pz = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
    nx, ny, nz, u, v = _surface(hit, parts, px, py, pz)
    row = materials[parts[4][hit] if hit >= 0 else shell[2][-1 - hit]]
    cosine = abs(nx * d[0] + ny * d[1] + nz * d[2])
    width = footprint * t / max(cosine, 0.15)
    seed = int(row[2])
    mix = pattern_value(int(row[0]), u, v, row[1], width, seed)
    tone = 1.0 + row[9] * fractal_noise(u, v, row[10], 2, width, seed + 31)
    tone += row[11] * fractal_noise(u, v, row[12], 2, width, seed + 57)
    base = ambient * (0.85 + 0.15 * nz)
    red, green, blue = base, base, base
    for i in range(lights.shape[0]):
        ex, ey, ez = lights[i, 0] - px, lights[i, 1] - py, lights[i, 2] - pz
        squared = ex * ex + ey * ey + ez * ez
        distance = math.sqrt(squared)
        ex, ey, ez = ex / distance, ey / distance, ez / distance
        facing = nx * ex + ny * ey + nz * ez
        if facing <= 0.0:
            continue
        sx, sy, sz = px + _LIFT * nx, py + _LIFT * ny, pz + _LIFT * nz
        occluder = _occluder(parts, groups, sx, sy, sz, ex, ey, ez, distance, guesses[i])
        if occluder >= 0:
            guesses[i] = occluder
        strength = (_SHADOW if occluder >= 0 else 1.0) * facing / (0.5 + 0.25 * squared)
        red += strength * lights[i, 3]
        green += strength * lights[i, 4]
        blue += strength * lights[i, 5]
    color[0] += tone * (row[3] + mix * (row[6] - row[3])) * red
    color[1] += tone * (row[4] + mix * (row[7] - row[4])) * green
    color[2] += tone * (row[5] + mix * (row[8] - row[5])) * blue


@numba.njit(cache=True, error_model="numpy")
def _ray(x, y, rotation, camera, d):
    """Writes the unit world direction through image position (x, y); returns its camera-frame z."""
    cx = (x - camera[2]) / camera[0]
    cy = (y - camera[3]) / camera[1]
    z = 1.0 / math.sqrt(cx * cx + cy * cy + 1.0)
    for axis in range(3):
        d[axis] = (rotation[0, axis] * cx + rotation[1, axis] * cy + rotation[2, axis]) * z
    return z


@numba.njit(cache=True, error_model="numpy")
def _visible_groups(x0, y0, x1, y1, origin, rotation, camera, groups, visible, reach):
    """Fills ``visible`` with the groups whose sphere meets the cone around a tile, nearest first; returns how many."""
    _, center, radius = groups
    axis = np.empty(3)
    corner = np.empty(3)
    _ray(0.5 * (x0 + x1), 0.5 * (y0 + y1), rotation, camera, axis)
    cosine = 1.0
    for x in (x0, x1):
        for y in (y0, y1):
            _ray(x, y, rotation, camera, corner)
            cosine = min(cosine, axis[0] * corner[0] + axis[1] * corner[1] + axis[2] * corner[2])
    spread = math.acos(min(cosine, 1.0)) + 1e-6
    count = 0
    for g in range(radius.shape[0]):
        x, y, z = center[g, 0] - origin[0], center[g, 1] - origin[1], center[g, 2] - origin[2]
        distance = math.sqrt(x * x + y * y + z * z)
        if distance > radius[g]:
            cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / distance
            if math.acos(min(max(cosine, -1.0), 1.0)) > spread + math.asin(radius[g] / distance):
                continue
        near = distance - radius[g]
        k = count
        while k > 0 and reach[k - 1] > near:
            reach[k], visible[k] = reach[k - 1], visible[k - 1]
            k -= 1
        reach[k], visible[k] = near, g
        count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})
def _render(origin, rotation, camera, parts, groups, shell, materials, lights, ambient, image, depth, normal):
    height, width = depth.shape
    visible = np.empty(groups[2].shape[0], np.int64)
    reach = np.empty(groups[2].shape[0])
    guesses = np.full(lights.shape[0], -1)
    d = np.empty(3)
    color = np.empty(3)
    step = 1.0 / _SUBSAMPLES
    footprint = step / camera[0]
    for y0 in range(0, height, _TILE):
        for x0 in range(0, width, _TILE):
            y1, x1 = min(y0 + _TILE, height), min(x0 + _TILE, width)
            count = _visible_groups(
                x0 - 0.5, y0 - 0.5, x1 - 0.5, y1 - 0.5, origin, rotation, camera, groups, visible, reach
            )
            for y in range(y0, y1):
                for x in range(x0, x1):
                    z = _ray(x, y, rotation, camera, d)
                    t, hit = _nearest(
                        visible, count, parts, groups, shell, origin[0], origin[1], origin[2], d[0], d[1], d[2]
                    )
                    depth[y, x] = t * z
                    p = (origin[0] + t * d[0], origin[1] + t * d[1], origin[2] + t * d[2])
                    nx, ny, nz, _, _ = _surface(hit, parts, p[0], p[1], p[2])
                    for axis in range(3):
                        normal[y, x, axis] = rotation[axis, 0] * nx + rotation[axis, 1] * ny + rotation[axis, 2] * nz
                    color[:] = 0.0
                    for sub in range(_SUBSAMPLES * _SUBSAMPLES):
                        dx = (sub % _SUBSAMPLES + 0.5) * step - 0.5
                        dy = (sub // _SUBSAMPLES + 0.5) * step - 0.5
                        _ray(x + dx, y + dy, rotation, camera, d)
                        t, hit = _nearest(
                            visible, count, parts, groups, shell, origin[0], origin[1], origin[2], d[0], d[1], d[2]
                        )
                        _shade(
                            hit,
                            t,
                            origin,
                            d,
                            footprint,
                            parts,
                            groups,
                            shell,
                            materials,
                            lights,
                            ambient,
                            guesses,
                            color,
                        )
                    for channel in range(3):
                        value = min(max(color[channel] * step * step, 0.0), 1.0) ** _GAMMA
                        image[y, x, channel] = int(255.0 * value + 0.5)
