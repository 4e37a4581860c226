"""Analytic ray casting of boxes, cylinders and ellipsoids inside a box-shaped room.

Parts (primitives) belong to groups. The bounding spheres of groups and parts are tested before the parts themselves,
and only parts that a bundle of rays can hit are considered (``parts_in_cone``). Rays have unit directions.
"""

from __future__ import annotations

import math
from typing import Any

from llvmlite.ir import Constant
from numba import types
from numba.extending import intrinsic

from vg2gt.kernels.compiled import kernel, kernel_part

BOX, CYLINDER, ELLIPSOID = 0, 1, 2

# Columns of a part: centre, squared bounding radius, 3x3 axes (rows, row-major), half extents along them, kind.
_CENTER, _RADIUS2, AXES, HALF, KIND, PART_COLUMNS = 0, 3, 4, 13, 16, 17
# Columns of a group: centre and radius of its bounding sphere (_CENTER, RADIUS), parts FIRST to LAST (exclusive).
RADIUS, FIRST, LAST, GROUP_COLUMNS = 3, 4, 5, 6

FAR = 1e9
_EPSILON = 1e-9
_FLAGS = {"reassoc", "contract", "arcp", "nsz"}  # without the flags that exclude infinities

jit = kernel(nogil=True, error_model="numpy", fastmath=_FLAGS)
part = kernel_part(error_model="numpy", fastmath=_FLAGS)


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = Constant(array.meminfo.type, None)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        members = enumerate(kind)  # pyright: ignore[reportArgumentType]
        items = [_without_owner(context, builder, part, builder.extract_value(value, i)) for i, part in members]
        return context.make_tuple(builder, kind, items)
    return value


def _unowned(context: Any, value: Any) -> Any:
    """Returns an array, or a tuple with arrays, without owner references. The owners must outlive it.

    Compiled code counts references to an array's owner with atomic operations whenever it passes the array on. In the
    inner loops this took as long as the ray casting itself.
    """
    return value(value), lambda context, builder, signature, arguments: _without_owner(
        context, builder, signature.args[0], arguments[0]
    )


unowned: Any = intrinsic(_unowned)


@part
def _inverse(x):
    return 1.0 / x if abs(x) > 1e-12 else 1e12


@part
def intersect_part(i, parts, ox, oy, oz, dx, dy, dz):
    """Returns the distance at which a ray from outside enters part ``i``; ``FAR`` if it misses."""
    x, y, z = parts[i, 0] - ox, parts[i, 1] - oy, parts[i, 2] - oz
    along = x * dx + y * dy + z * dz
    squared = x * x + y * y + z * z
    radius2 = parts[i, _RADIUS2]
    if squared - along * along > radius2 or (along < 0.0 and squared > radius2):
        return FAR
    kind = parts[i, KIND]
    hx, hy, hz = parts[i, HALF], parts[i, HALF + 1], parts[i, HALF + 2]
    # Transform the ray to the part's frame.
    px = -(parts[i, AXES] * x + parts[i, AXES + 1] * y + parts[i, AXES + 2] * z)
    py = -(parts[i, AXES + 3] * x + parts[i, AXES + 4] * y + parts[i, AXES + 5] * z)
    pz = -(parts[i, AXES + 6] * x + parts[i, AXES + 7] * y + parts[i, AXES + 8] * z)
    qx = parts[i, AXES] * dx + parts[i, AXES + 1] * dy + parts[i, AXES + 2] * dz
    qy = parts[i, AXES + 3] * dx + parts[i, AXES + 4] * dy + parts[i, AXES + 5] * dz
    qz = parts[i, AXES + 6] * dx + parts[i, AXES + 7] * dy + parts[i, AXES + 8] * dz
    if kind == BOX:
        ix, iy, iz = _inverse(qx), _inverse(qy), _inverse(qz)
        rx, ry, rz = hx * abs(ix), hy * abs(iy), hz * abs(iz)
        enter = max(-px * ix - rx, -py * iy - ry, -pz * iz - rz)
        leave = min(-px * ix + rx, -py * iy + ry, -pz * iz + rz)
        return enter if _EPSILON < enter < leave else FAR
    px, py, qx, qy = px / hx, py / hy, qx / hx, qy / hy
    a = qx * qx + qy * qy
    b = px * qx + py * qy
    c = px * px + py * py - 1.0
    if kind == CYLINDER:
        iz = _inverse(qz)
        enter = -pz * iz - hz * abs(iz)
        leave = -pz * iz + hz * abs(iz)
        discriminant = b * b - a * c
        if discriminant <= 0.0:
            return FAR
        if a > 1e-12:
            root = math.sqrt(discriminant)
            enter = max(enter, (-b - root) / a)
            leave = min(leave, (-b + root) / a)
        return enter if _EPSILON < enter < leave else FAR
    pz, qz = pz / hz, qz / hz
    a += qz * qz
    b += pz * qz
    discriminant = b * b - a * (c + pz * pz)
    if discriminant <= 0.0:
        return FAR
    enter = (-b - math.sqrt(discriminant)) / a
    return enter if enter > _EPSILON else FAR


@part
def leave_walls(walls, ox, oy, oz, dx, dy, dz):
    """Returns the distance along a ray from inside the room to a wall, and the wall.

    Walls are 0..5 for x-, x+, y-, y+, floor, ceiling. ``walls`` ``[2, 3]`` holds the room's lower and upper corner.
    """
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    sx, sy, sz = (1 if dx > 0 else 0), (1 if dy > 0 else 0), (1 if dz > 0 else 0)
    tx = abs((walls[sx, 0] - ox) * ix)
    ty = abs((walls[sy, 1] - oy) * iy)
    tz = abs((walls[sz, 2] - oz) * iz)
    if tx <= ty and tx <= tz:
        return tx, sx
    if ty <= tz:
        return ty, 2 + sy
    return tz, 4 + sz


@part
def nearest_hit(visible, near, count, parts, walls, ox, oy, oz, dx, dy, dz):
    """Returns the nearest hit of a ray from inside the room ``walls [2, 3]``: distance, and the part or ``-1 - wall``.

    Tests the first ``count`` of the ``visible`` parts; ``near`` holds their minimum distances, in increasing order.
    """
    best, wall = leave_walls(walls, ox, oy, oz, dx, dy, dz)
    hit = -1 - wall
    for k in range(count):
        if near[k] > best:
            break
        t = intersect_part(visible[k], parts, ox, oy, oz, dx, dy, dz)
        if t < best:
            best, hit = t, visible[k]
    return best, hit


@part
def find_occluder(visible, count, parts, ox, oy, oz, dx, dy, dz, distance, guess):
    """Returns a part that a ray hits within ``distance``, or -1; tests part ``guess`` (unless -1) first."""
    if guess >= 0 and intersect_part(guess, parts, ox, oy, oz, dx, dy, dz) < distance:
        return guess
    for k in range(count):
        if intersect_part(visible[k], parts, ox, oy, oz, dx, dy, dz) < distance:
            return visible[k]
    return -1


@part
def _enters_cone(x, y, z, radius, axis, spread, reach):
    """Returns the distance from a cone's tip to a sphere at (x, y, z) relative to the tip; FAR if they are disjoint."""
    distance = math.sqrt(x * x + y * y + z * z)
    if distance - radius > reach:
        return FAR
    if distance > radius:
        cosine = (x * axis[0] + y * axis[1] + z * axis[2]) / distance
        if math.acos(min(max(cosine, -1.0), 1.0)) > spread + math.asin(radius / distance):
            return FAR
    return distance - radius


@part
def parts_in_cone(apex, axis, spread, reach, parts, groups, visible, near):
    """Writes the parts whose bounding sphere meets a cone to ``visible [n]``, nearest group first; returns the count.

    ``near [n]`` receives the minimum distance of each part's group. The cone has tip ``apex``, unit ``axis``, half
    opening angle ``spread`` (rad) and length ``reach``, less than ``FAR``.
    """
    count = 0
    for g in range(groups.shape[0]):
        x, y, z = groups[g, 0] - apex[0], groups[g, 1] - apex[1], groups[g, 2] - apex[2]
        least = _enters_cone(x, y, z, groups[g, RADIUS], axis, spread, reach)
        if least == FAR:
            continue
        for i in range(int(groups[g, FIRST]), int(groups[g, LAST])):
            x, y, z = parts[i, 0] - apex[0], parts[i, 1] - apex[1], parts[i, 2] - apex[2]
            if _enters_cone(x, y, z, math.sqrt(parts[i, _RADIUS2]), axis, spread, reach) == FAR:
                continue
            k = count
            while k > 0 and near[k - 1] > least:
                near[k], visible[k] = near[k - 1], visible[k - 1]
                k -= 1
            near[k], visible[k] = least, i
            count += 1
    return count


@part
def surface(hit, parts, px, py, pz):
    """Returns the outward world normal (3) and surface coordinates in metres (2) of a point on a part or wall."""
    if hit < 0:
        axis = (-1 - hit) // 2
        sign = 1.0 if (-1 - hit) % 2 == 0 else -1.0  # walls face inward
        if axis == 0:
            return sign, 0.0, 0.0, py, pz
        if axis == 1:
            return 0.0, sign, 0.0, px, pz
        return 0.0, 0.0, sign, px, py
    x, y, z = px - parts[hit, 0], py - parts[hit, 1], pz - parts[hit, 2]
    lx = parts[hit, AXES] * x + parts[hit, AXES + 1] * y + parts[hit, AXES + 2] * z
    ly = parts[hit, AXES + 3] * x + parts[hit, AXES + 4] * y + parts[hit, AXES + 5] * z
    lz = parts[hit, AXES + 6] * x + parts[hit, AXES + 7] * y + parts[hit, AXES + 8] * z
    kind, hx, hy, hz = parts[hit, KIND], parts[hit, HALF], parts[hit, HALF + 1], parts[hit, HALF + 2]
    qx, qy, qz = lx / hx, ly / hy, lz / hz
    nx, ny, nz, u, v = 0.0, 0.0, 0.0, 0.0, 0.0
    if kind == BOX:
        if abs(qx) >= abs(qy) and abs(qx) >= abs(qz):
            nx, u, v = math.copysign(1.0, qx), ly, lz
        elif abs(qy) >= abs(qz):
            ny, u, v = math.copysign(1.0, qy), lx, lz
        else:
            nz, u, v = math.copysign(1.0, qz), lx, ly
    elif kind == CYLINDER and abs(qz) > math.sqrt(qx * qx + qy * qy):
        nz, u, v = math.copysign(1.0, qz), lx, ly
    else:
        nx, ny = qx / hx, qy / hy
        nz = qz / hz if kind == ELLIPSOID else 0.0
        norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * norm, ny * norm, nz * norm
        u = math.atan2(qy, qx) * 0.5 * (hx + hy)
        v = math.asin(min(max(qz, -1.0), 1.0)) * hz if kind == ELLIPSOID else lz
    return (
        parts[hit, AXES] * nx + parts[hit, AXES + 3] * ny + parts[hit, AXES + 6] * nz,
        parts[hit, AXES + 1] * nx + parts[hit, AXES + 4] * ny + parts[hit, AXES + 7] * nz,
        parts[hit, AXES + 2] * nx + parts[hit, AXES + 5] * ny + parts[hit, AXES + 8] * nz,
        u,
        v,
    )
