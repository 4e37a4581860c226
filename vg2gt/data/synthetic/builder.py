"""Builder of procedural worlds: groups of boxes, cylinders and ellipsoids with materials."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vg2gt.data.synthetic.raycast import AXES, BOX, CYLINDER, ELLIPSOID, GROUP_COLUMNS, HALF, KIND, PART_COLUMNS
from vg2gt.data.synthetic.textures import INDOOR, Pattern

Vector = Sequence[float]  # x, y, z

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)


def _yaw_rotation(angle: float) -> NDArray[np.float64]:
    """Returns the 3x3 rotation by ``angle`` (rad) about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _tilt_rotation(angle: float) -> NDArray[np.float64]:
    """Returns the 3x3 rotation by ``angle`` (rad) about the x axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


class Builder:
    """Collects the parts, groups and materials of a scene.

    Args:
        rng: random generator of all choices.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.materials: list[list[float]] = []
        self.parts: list[NDArray[np.float64]] = []
        self.part_materials: list[int] = []
        self._group_start: list[int] = [0]
        self._origin = np.zeros(3)
        self._rotation = np.eye(3)

    def place(self, position: NDArray[np.float64], yaw: float) -> None:
        """Sets the coordinate frame of the following parts and starts a new group."""
        self.end_group()
        self._origin = position
        self._rotation = _yaw_rotation(yaw)

    def end_group(self) -> None:
        """Closes the current group if it has parts. The parts of a group should be close together."""
        if len(self.parts) > self._group_start[-1]:
            self._group_start.append(len(self.parts))

    def new_material(self, kinds: tuple[Pattern, ...] = INDOOR, frequency: tuple[float, float] = (1, 8)) -> int:
        """Draws a material: one of ``kinds`` with a log-uniform pattern ``frequency`` (periods per metre)."""
        rng = self.rng
        first = rng.uniform(0.15, 0.95, 3)
        if rng.random() < 0.4:
            first = np.clip(first.mean() + rng.normal(0, 0.06, 3), 0.1, 0.95)
        second = np.clip(first + rng.normal(0, 0.28, 3), 0.03, 1.0)
        pitch = np.exp(rng.uniform(*np.log(frequency)))
        slow = (rng.uniform(0.05, 0.25), rng.uniform(0.3, 1.5))
        fine = (rng.uniform(0.0, 0.25), rng.uniform(8, 30))
        kind = kinds[rng.integers(len(kinds))]
        self.materials.append([int(kind), pitch, int(rng.integers(1 << 20)), *first, *second, *slow, *fine])
        return len(self.materials) - 1

    def box(self, center: Vector, size: Vector, material: int, turn: float = 0.0, tilt: float = 0.0) -> None:
        """Adds a box with edge lengths ``size``, turned about the vertical and tilted about its x axis (rad)."""
        self._add(BOX, center, np.array(size) / 2, material, _yaw_rotation(turn) @ _tilt_rotation(tilt))

    def cylinder(self, center: Vector, radius: float, height: float, material: int, lying: bool = False) -> None:
        """Adds a cylinder, upright or with its axis along y."""
        own = _tilt_rotation(np.pi / 2) if lying else np.eye(3)
        self._add(CYLINDER, center, np.array([radius, radius, height / 2]), material, own)

    def ellipsoid(self, center: Vector, radii: Vector, material: int) -> None:
        """Adds an ellipsoid."""
        self._add(ELLIPSOID, center, np.array(radii), material, np.eye(3))

    def _add(self, kind: int, center: Vector, half: NDArray, material: int, own: NDArray) -> None:
        position = self._origin + self._rotation @ np.array(center)
        axes = (self._rotation @ own).T
        radius2 = (1 + 1e-9) * (half.max() if kind == ELLIPSOID else np.linalg.norm(half)) ** 2
        self.parts.append(np.concatenate((position, [radius2], axes.ravel(), half, [kind])))
        self.part_materials.append(material)

    def corners(self, first: int, last: int | None = None) -> NDArray[np.float64]:
        """Returns the corners ``[8 n, 3]`` of the boxes around the parts from ``first`` to ``last`` (exclusive)."""
        rows = self.parts[first:last]
        return np.concatenate([row[:3] + (_CORNERS * row[HALF:KIND]) @ row[AXES:HALF].reshape(3, 3) for row in rows])

    def groups(self) -> NDArray[np.float64]:
        """Returns the groups ``[g, GROUP_COLUMNS]``, with bounding spheres of the boxes around their parts."""
        rows = []
        for first, last in zip(self._group_start[:-1], self._group_start[1:], strict=True):
            corners = self.corners(first, last)
            middle = (corners.min(0) + corners.max(0)) / 2
            radius = np.linalg.norm(corners - middle, axis=1).max() + 1e-6
            rows.append([*middle, radius, first, last])
        return np.array(rows, np.float64).reshape(-1, GROUP_COLUMNS)

    def arrays(self) -> dict[str, NDArray]:
        """Returns parts, groups and materials as arguments of :class:`vg2gt.data.synthetic.renderer.World`."""
        return {
            "parts": np.array(self.parts).reshape(-1, PART_COLUMNS),
            "part_materials": np.array(self.part_materials, np.int64),
            "groups": self.groups(),
            "materials": np.array(self.materials),
        }
