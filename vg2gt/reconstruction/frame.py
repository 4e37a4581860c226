"""The frame and unit of a scene: those of given cameras, those of its first camera, or upright."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vg2gt.geometry.alignment import Similarity, align_cameras
from vg2gt.geometry.geodesy import Place
from vg2gt.types import Cameras

if TYPE_CHECKING:
    from vg2gt.reconstruction.scene import Scene

log = logging.getLogger(__name__)

FAR = 1e4  # distance from the origin, in depths, at which float32 resolves about a thousandth of a depth
_SAME = 1e-4  # of the extent: cameras that differ less from the given ones are replaced by them
_LEVEL = 0.2  # minimum length of the cameras' mean down vector for it to define gravity


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """Placement of a scene's world in the world of its source cameras.

    Attributes:
        name: ``reference`` (camera of the view that the model processed first, median depth about 1), ``upright``
            (reference rotated until y points along gravity) or ``given``.
        to_source: ``[4, 4]`` float64 similarity from the scene's world to that of the cameras as given, found or
            predicted; its scale is source units per scene unit.
        poses: ``[V, 4, 4]`` float64 ``world_to_camera`` as given or found; None if the backbone predicted them.
        target: frame to write the scene in: ``given`` if cameras were given, else ``upright``.
        place: where the source cameras are on the Earth; None if unknown.
    """

    name: str
    to_source: NDArray[np.float64]
    poses: NDArray[np.float64] | None = None
    target: str = "upright"
    place: Place | None = None

    @property
    def scale(self) -> float:
        """Source units per scene unit."""
        return float(np.cbrt(np.linalg.det(self.to_source[:3, :3])))

    @property
    def world_place(self) -> Place | None:
        """Where the scene's world is on the Earth; None if unknown."""
        return None if self.place is None else replace(self.place, to_enu=self.place.to_enu @ self.to_source)


def first_frame(cameras: Cameras, unit: float, poses: NDArray[np.float64] | None, target: str) -> SceneFrame:
    """Returns the frame of a new scene, whose world is the camera of one of its views.

    Args:
        cameras: cameras of the scene (B = 1).
        unit: scene units per source unit; used if ``poses`` is None or the cameras do not move.
        poses: ``[V, 4, 4]`` poses of the cameras as given or found; None if predicted.
        target: see :class:`SceneFrame`.
    """
    scaled = np.diag([1 / unit, 1 / unit, 1 / unit, 1.0])
    if poses is None:
        return SceneFrame("reference", scaled, None, target)
    own = replace(cameras, world_to_camera=cameras.world_to_camera.detach().cpu().double())
    given = replace(own, world_to_camera=torch.from_numpy(poses)[None])
    move = align_cameras(own, given, lambda: torch.tensor([1 / unit]))
    matrix = np.eye(4)
    matrix[:3, :3] = float(move.scale[0]) * move.rotation[0].double().numpy()
    matrix[:3, 3] = move.translation[0].double().numpy()
    return SceneFrame("reference", matrix, poses, target)


def move_to_target(frame: SceneFrame, cameras: Cameras, depth: float) -> tuple[SceneFrame, Similarity]:
    """Returns the frame to write a scene in, and the similarity that moves the scene there (float64, B = 1).

    Args:
        frame: current frame of the scene.
        cameras: cameras of its views (B = 1).
        depth: its median depth in scene units.
    """
    move = np.eye(4)
    if frame.target == "given":
        move = frame.to_source.copy()
        far = float(np.linalg.norm(move[:3, 3])) / (frame.scale * depth)
        if far > FAR:  # float32 cannot hold such a shift, such as map coordinates
            offset = move[:3, 3].round()
            log.warning(
                "the given cameras are %.3g scene depths from their origin, too far for single precision: the scene is "
                "written shifted by %s; cameras.json contains the similarity transform to the given frame",
                far, (-offset).tolist(),
            )  # fmt: skip
            move[:3, 3] -= offset
    else:
        if (place := frame.world_place) is not None and place.is_level:
            move[:3, :3] = _turned_down(-place.up)
        else:
            move[:3, :3] = upright_rotation(cameras.world_to_camera[0].detach().cpu().double().numpy())
    return replace(frame, name=frame.target, to_source=frame.to_source @ np.linalg.inv(move)), _similarity_of(move)


def upright_rotation(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the smallest rotation ``[3, 3]`` that brings gravity, estimated from poses ``[V, 4, 4]``, to +y.

    People hold cameras level: gravity is perpendicular to the cameras' x axes if these span different directions, else
    it is the mean down vector. If the cameras have no common down direction, the rotation is the identity.
    """
    down = poses[:, 1, :3].mean(0)
    if np.linalg.norm(down) < _LEVEL:
        return np.eye(3)
    down /= np.linalg.norm(down)
    sideways = poses[:, 0, :3]
    values, vectors = np.linalg.eigh(sideways.T @ sideways / len(poses))
    normal = vectors[:, 0] * np.sign(vectors[:, 0] @ down)
    if values[1] > 0.05 and values[0] < 0.3 * values[1] and normal @ down > 0.5:
        down = normal
    return _turned_down(down)


def _turned_down(down: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the smallest rotation ``[3, 3]`` that brings a direction of length 1 to +y."""
    axis, cosine = np.cross(down, [0, 1, 0]), down[1]
    if cosine < -0.999999:
        return np.diag([1.0, -1, -1])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def moved_cameras(cameras: Cameras, move: Similarity, frame: SceneFrame) -> tuple[Cameras, Tensor]:
    """Moves cameras by a similarity (B = 1); also returns their poses ``[V, 4, 4]`` in float64.

    Poses that match the given ones are replaced by them, so that in the given frame they are exact.
    """
    own = replace(cameras, world_to_camera=cameras.world_to_camera.detach().cpu().double())
    poses = move.to("cpu").apply_cameras(own).world_to_camera[0]
    if frame.poses is not None and len(frame.poses) == len(poses):
        given = torch.from_numpy(frame.poses @ frame.to_source)  # from the frame's world, not yet rigid
        given[:, :3] /= frame.scale
        extent = max(float(given[:, :3, 3].abs().max()), 1e-12)
        if (given - poses).abs().max() < _SAME * max(extent, 1.0):
            poses = given
    moved = poses.to(cameras.world_to_camera.device, cameras.world_to_camera.dtype)
    return replace(cameras, world_to_camera=moved[None]), poses


def _similarity_of(matrix: NDArray[np.float64]) -> Similarity:
    """Returns the similarity (B = 1) of a matrix ``[4, 4]``."""
    linear, shift = torch.from_numpy(matrix[:3, :3].copy()), torch.from_numpy(matrix[:3, 3].copy())
    scale = torch.linalg.det(linear) ** (1 / 3)
    return Similarity(scale[None], (linear / scale)[None], shift[None])


def place_figures(frame: SceneFrame | None) -> dict[str, Any]:
    """Returns the report entry ``gps`` of a scene, if its place on the Earth is known (:func:`read_place`).

    ``origin``: latitude, longitude, altitude; ``to_enu``: from the scene's world to metres east, north and up of it;
    ``up`` in the scene's world, null if the cameras are on one line; ``positions``: number; ``error`` in metres;
    ``scale_error``: relative.
    """
    place = None if frame is None else frame.world_place
    if place is None:
        return {}
    figures = {"positions": place.used, "error": place.error, "scale_error": place.scale_error}
    up = place.up.tolist() if place.is_level else None
    return {"gps": {"origin": list(place.origin), "to_enu": place.to_enu.tolist(), "up": up, **figures}}


def read_place(figures: dict[str, Any], to_source: NDArray[np.float64]) -> Place | None:
    """Returns the place that a report states (:func:`place_figures`), in the world of the source cameras."""
    gps = figures.get("gps")
    if gps is None:
        return None
    latitude, longitude, altitude = gps["origin"]
    to_enu = np.asarray(np.array(gps["to_enu"]) @ np.linalg.inv(to_source), np.float64)
    known = (gps["error"], gps["scale_error"], gps["positions"], gps["up"] is not None)
    return Place(to_enu, (latitude, longitude, altitude), *known)


def place_lines(scene: Scene) -> list[str]:
    """Describes in a line what GPS tells of a scene; nothing if it is unknown."""
    place = None if scene.frame is None else scene.frame.place
    if place is None:
        return []
    up = "up and the origin" if place.is_level else "the origin (not up: the cameras are on one line)"
    return [
        f"GPS of {place.used} photographs, off by {place.error:.1f} m: a unit is {scene.metres_per_unit:.4g} m, give "
        f"or take {100 * place.scale_error:.1g} %; {up} are in report.json"
    ]
