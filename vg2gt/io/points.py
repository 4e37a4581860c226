"""Coloured points: PLY, and GLB (binary glTF 2.0) with camera frusta for any 3D viewer.

glTF has y up and cameras looking along -z; our world is OpenCV's (y down, z forward). The GLB's root rotates the scene
by 180 degrees about x, so that it is upright. Colours are written unchanged, as sRGB.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from vg2gt.geometry.cameras import invert_rigid, transform_points
from vg2gt.io.files import write_bytes
from vg2gt.types import Cameras

TO_GLTF = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV world to glTF world
POINTS, FRUSTA = "points", "cameras"  # names of the two objects in a GLB
_FRUSTUM_SHARE = 0.05  # depth of a frustum, relative to the scene's extent
_MIDDLE = 0.9  # share of the points that defines the extent; far outliers would enlarge the frusta
# apex to the four corners, border of the image, and a mark above its upper edge
_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (1, 5), (5, 2))


def checked_points(positions: ArrayLike, colors: ArrayLike | None) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Returns positions ``[N, 3]`` and colours ``[N, 3]`` as arrays; no colours are mid grey.

    Raises:
        ValueError: if shapes or types are wrong, or a position is not finite.
    """
    xyz = np.asarray(positions, np.float64)
    rgb = np.full(xyz.shape, 128, np.uint8) if colors is None else np.asarray(colors)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise ValueError(
            f"positions must be [N, 3] and colors uint8 [N, 3], got {list(xyz.shape)} and {rgb.dtype} {list(rgb.shape)}"
        )
    if not np.isfinite(xyz).all():
        raise ValueError("positions must be finite")
    return xyz, rgb


def write_point_ply(path: str | Path, positions: ArrayLike, colors: ArrayLike | None = None) -> Path:
    """Writes points as binary PLY, float32 ``x y z`` and uchar ``red green blue alpha``, atomically.

    Args:
        path: the file.
        positions: ``[N, 3]``.
        colors: ``[N, 3]`` uint8; None: mid grey.

    Raises:
        ValueError: if shapes or types are wrong, or a position is not finite.
    """
    import trimesh  # imported here, because it takes a second

    content = trimesh.PointCloud(*checked_points(positions, colors)).export(file_type="ply")
    assert isinstance(content, bytes)
    return write_bytes(path, content)


def write_glb(path: str | Path, positions: ArrayLike, colors: ArrayLike | None, cameras: Cameras) -> Path:
    """Writes points and camera frusta, atomically.

    Args:
        path: the file.
        positions: ``[N, 3]`` world positions, stored as float32.
        colors: ``[N, 3]`` uint8; None: mid grey.
        cameras: one scene (B = 1). The frusta's depth is 1/20 of the extent of points and cameras.

    Raises:
        ValueError: if shapes or types are wrong, or a position is not finite.
    """
    import trimesh

    xyz, rgb = checked_points(positions, colors)
    scene = trimesh.Scene()
    if len(xyz):
        scene.add_geometry(trimesh.PointCloud(xyz, rgb), geom_name=POINTS, node_name=POINTS)
    centers = invert_rigid(cameras.world_to_camera.detach().cpu().double())[0, :, :3, 3].numpy()
    corners = frusta(cameras, _FRUSTUM_SHARE * scene_extent(xyz, centers))
    lines = corners[:, np.array(_EDGES)].reshape(-1, 2, 3)
    scene.add_geometry(trimesh.load_path(lines), geom_name=FRUSTA, node_name=FRUSTA)
    scene.apply_transform(TO_GLTF)
    content = scene.export(file_type="glb")
    assert isinstance(content, bytes)
    return write_bytes(path, content)


def frusta(cameras: Cameras, depth: float) -> NDArray[np.float64]:
    """Corners of the cameras' frusta ``[V, 6, 3]`` in the world frame.

    Args:
        cameras: one scene (B = 1).
        depth: z-depth of the drawn image.

    Returns:
        Per view the centre, the outer corners of the image clockwise from the upper left, and a point above its upper
        edge that shows which way is up.
    """
    height, width = cameras.size
    left, top, right, bottom = -0.5, -0.5, width - 0.5, height - 0.5  # the image's edges, not its outer pixel centres
    above = (left + right) / 2, top - 0.25 * height
    pixels = torch.tensor([[left, top], [right, top], [right, bottom], [left, bottom], above], dtype=torch.float64)
    k, poses = (t.detach().cpu().double() for t in (cameras.intrinsics[0], cameras.world_to_camera))
    xy = (pixels - k[:, None, :2, 2]) / k[:, None, [0, 1], [0, 1]]
    local = torch.cat((xy, torch.ones_like(xy[..., :1])), -1) * depth
    local = torch.cat((torch.zeros_like(local[:, :1]), local), 1)
    return transform_points(invert_rigid(poses), local[None])[0].numpy()


def scene_extent(xyz: NDArray[np.float64], centers: NDArray[np.float64]) -> float:
    """Diagonal of the box around camera centres ``[V, 3]`` and the central points of ``[N, 3]``; 1 if it is 0."""
    tail = (1 - _MIDDLE) / 2
    middle = np.quantile(xyz, [tail, 1 - tail], axis=0) if len(xyz) else centers[:1]
    corners = np.concatenate((middle, centers))
    return float(np.linalg.norm(corners.max(0) - corners.min(0))) or 1.0
