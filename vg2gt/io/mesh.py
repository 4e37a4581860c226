"""Triangle meshes from depth maps: TSDF fusion, surface extraction, writing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vg2gt.io.files import write_bytes
from vg2gt.io.tsdf import BLOCK, KEY_BITS, Volume, fuse, pack, unpack
from vg2gt.types import Cameras

SUFFIXES = (".ply", ".glb", ".obj", ".stl", ".off")


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the world frame.

    Attributes:
        vertices: ``[N, 3]`` float32.
        faces: ``[F, 3]`` int64 vertex indices, counter-clockwise seen from free space.
        colors: ``[N, 3]`` uint8, or None.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]
    colors: NDArray[np.uint8] | None = None


def fuse_depth(
    depth: Tensor,
    cameras: Cameras,
    colors: Tensor | None = None,
    *,
    voxel_size: float,
    truncation: float | None = None,
    max_voxels: int = 64_000_000,
) -> Mesh:
    """Fuses depth maps of one scene into a mesh.

    Averages a truncated signed distance along the optical axis over the views, at voxels near surfaces. The mesh is its
    zero level set, with one vertex in each cell that the surface crosses (surface nets). Peak memory is about 50 bytes
    per voxel; it grows with the surface, not with the scene's bounding box.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = invalid. Set depth that is too far to 0.
        cameras: cameras of the V views of one scene (B = 1), of the depth maps' size.
        colors: ``[V, 3, H, W]`` in [0, 1], or None.
        voxel_size: edge length of a voxel in scene units; smaller details are lost.
        truncation: distance from a surface at which free space begins, in scene units, at least two voxels; None: four
            voxels. Thinner walls are lost.
        max_voxels: maximum number of voxels, which bounds the memory at about 50 bytes each (3 GB).

    Returns:
        The mesh; empty if there is no valid depth.

    Raises:
        ValueError: if shapes disagree, a value is not finite, a size is out of range, or ``max_voxels`` is exceeded.
    """
    truncation = 4 * voxel_size if truncation is None else truncation
    _check(depth, cameras, colors, voxel_size, truncation)
    cameras = cameras.map(lambda tensor: tensor.detach().cpu().float())
    depth = depth.detach().cpu().float()
    colors = None if colors is None else colors.detach().cpu().float()
    return extract_surface(fuse(depth, cameras, colors, float(voxel_size), float(truncation), max_voxels))


def extract_surface(volume: Volume) -> Mesh:
    """Extracts the zero level set of a volume with surface nets.

    The surface crosses every voxel edge whose ends differ in sign. The vertex of a cell is the mean of the crossings on
    its edges. Each crossed edge makes a quad of the vertices of its four cells.
    """
    # Voxels in free space beyond the truncation do not locate a surface. Next to a depth edge they would close the gap
    # between foreground and background.
    seen = ((volume.weight > 0) & (volume.distance < 1)).reshape(-1)
    inside = torch.stack(torch.meshgrid(*3 * [torch.arange(BLOCK)], indexing="ij"), -1).reshape(-1, 3)
    keys = pack((volume.blocks[:, None] * BLOCK + inside).reshape(-1, 3)[seen])
    keys, order = torch.sort(keys)
    distance = volume.distance.reshape(-1)[seen][order]
    values = distance[:, None]
    if volume.colors is not None:
        values = torch.cat((values, volume.colors.reshape(-1, 3)[seen][order]), -1)
    points, shades, cells, outward = (
        torch.cat(parts) for parts in zip(*(_crossings(keys, values, a) for a in range(3)), strict=True)
    )
    cell_keys, corner = torch.unique(cells, return_inverse=True)  # corner: [E, 4] vertex of each cell around an edge
    count = torch.bincount(corner.reshape(-1), minlength=len(cell_keys)).clamp(min=1)[:, None]

    def cell_mean(per_edge: Tensor) -> Tensor:
        total = torch.zeros(len(cell_keys), per_edge.shape[1], dtype=per_edge.dtype)
        return total.index_add_(0, corner.reshape(-1), per_edge.repeat_interleave(4, 0)) / count

    vertices = ((cell_mean(points) + 0.5) * volume.voxel_size).float().numpy()
    colors = None
    if volume.colors is not None:
        colors = (cell_mean(shades).clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    return Mesh(vertices, _triangles(vertices, corner, outward), colors)


def _crossings(keys: Tensor, values: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Finds the crossed edges along one axis.

    Returns:
        Crossing points ``[E, 3]`` in voxel indices (float64), colours ``[E, 3]`` or ``[E, 0]``, keys of the four cells
        around each edge ``[E, 4]``, counter-clockwise seen from the positive axis, and ``[E]`` bool: whether free space
        lies in the positive direction.
    """
    stride = 1 << ((KEY_BITS + 1) * (2 - axis))
    at = torch.searchsorted(keys, keys + stride).clamp(max=len(keys) - 1) if len(keys) else keys
    near, far = values, values[at]
    crossed = (keys[at] == keys + stride) & ((near[:, 0] < 0) != (far[:, 0] < 0))
    near, far, origin = near[crossed], far[crossed], keys[crossed]
    share = (near[:, :1] / (near[:, :1] - far[:, :1])).double()
    points = unpack(origin).double()
    points[:, axis] += share[:, 0]
    shades = torch.lerp(near[:, 1:], far[:, 1:], share.float())
    u, v = (1 << ((KEY_BITS + 1) * (2 - (axis + step) % 3)) for step in (1, 2))
    cells = torch.stack((origin, origin - u, origin - u - v, origin - v), -1)
    return points, shades, cells, far[:, 0] > 0


def _triangles(vertices: NDArray[np.float32], corner: Tensor, outward: Tensor) -> NDArray[np.int64]:
    """Cuts each quad along its shorter diagonal into two triangles that face free space."""
    quads = torch.where(outward[:, None], corner, corner.flip(-1)).numpy()
    a, b, c, d = (vertices[quads[:, i]] for i in range(4))
    shorter = np.linalg.norm(a - c, axis=-1) <= np.linalg.norm(b - d, axis=-1)
    along_ac, along_bd = quads[:, [0, 1, 2, 0, 2, 3]], quads[:, [0, 1, 3, 1, 2, 3]]
    return np.where(shorter[:, None], along_ac, along_bd).reshape(-1, 3).astype(np.int64)


def write_mesh(path: str | Path, mesh: Mesh) -> Path:
    """Writes a mesh with trimesh, atomically, in our world frame, ``.glb`` with y up; the suffix selects the format.

    Args:
        path: a file ending in ``.ply``, ``.glb``, ``.obj``, ``.stl`` or ``.off``.
        mesh: mesh to write; not changed.

    Raises:
        ValueError: if the suffix is unknown, or the mesh has no triangles.
    """
    import trimesh  # imported here, because it takes a second

    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: a mesh is written as one of {', '.join(SUFFIXES)}")
    if not len(mesh.faces):
        raise ValueError("the mesh is empty: no valid depth, or voxels larger than the surfaces; check both")
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
    if path.suffix.lower() == ".glb":
        body.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))  # glTF: y up
    content = body.export(file_type=path.suffix[1:].lower())
    assert not isinstance(content, dict)  # only formats with several files give a dict
    return write_bytes(path, content.encode() if isinstance(content, str) else content)


def _check(depth: Tensor, cameras: Cameras, colors: Tensor | None, voxel_size: float, truncation: float) -> None:
    views = depth.shape[0] if depth.dim() == 3 else -1
    if cameras.world_to_camera.shape[:2] != (1, views) or tuple(depth.shape[1:]) != tuple(cameras.size):
        raise ValueError(
            f"depth must be [V, {cameras.size[0]}, {cameras.size[1]}] with one camera per map of one scene, got depth "
            f"{list(depth.shape)} and cameras {list(cameras.world_to_camera.shape[:2])}; use Cameras.scene"
        )
    if min(depth.shape[1:]) < 2:
        raise ValueError(f"depth maps must be 2x2 at least, got {list(depth.shape)}")
    if colors is not None and colors.shape != (views, 3, *depth.shape[1:]):
        raise ValueError(f"colors must be {[views, 3, *depth.shape[1:]]} like depth, got {list(colors.shape)}")
    tensors = {"depth": depth, "world_to_camera": cameras.world_to_camera, "intrinsics": cameras.intrinsics}
    for name, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            raise ValueError(f"{name} has values that are not finite; set invalid depth to 0 and drop such views")
    if not (voxel_size > 0 and truncation >= 2 * voxel_size):
        raise ValueError(
            f"voxel_size must be positive and truncation two voxels at least, got {voxel_size} and {truncation}"
        )
