"""Triangle meshes from depth maps: TSDF fusion on blocks of voxels near surfaces, surface nets, writing.

A view measures the difference in z between a surface and a voxel. At grazing angles this overestimates the distance and
would bias the mean outwards. Observations are therefore weighted by the squared cosine between ray and normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vg2gt.geometry.cameras import ray_directions, unproject
from vg2gt.geometry.normals import normals_from_depth
from vg2gt.io.files import write_bytes
from vg2gt.types import Cameras

_SUFFIXES = (".ply", ".glb")
MAX_VOXELS = 64_000_000  # bounds the memory at about 3 GB
_TRUNCATION = 4  # distance from a surface at which free space begins, in voxels
_BLOCK = 8  # voxels along a block's edge
_KEY_BITS = 20  # voxel indices lie in [-2^20, 2^20)
_BLOCKS_PER_CHUNK = 2048
_EDGE_WEIGHT = 0.05  # of pixels without a normal (at edges, in sparse depth): better than no observation
_MIN_WEIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the world frame.

    Attributes:
        vertices: ``[N, 3]`` float32.
        faces: ``[F, 3]`` int64 vertex indices, counter-clockwise seen from free space.
        colors: ``[N, 3]`` uint8.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]
    colors: NDArray[np.uint8]


def fuse_depth(depth: Tensor, cameras: Cameras, colors: Tensor, *, voxel_size: float) -> Mesh:
    """Fuses depth maps of one scene into a mesh.

    Averages a truncated signed distance along the optical axis over the views, at voxels near surfaces. The mesh is its
    zero level set, with one vertex in each cell that the surface crosses (surface nets). Walls thinner than four voxels
    are lost. Peak memory is about 50 bytes per voxel; it grows with the surface, not with the scene's bounding box.

    Args:
        depth: ``[V, H, W]`` z-depth, 0 = invalid. Set depth that is too far to 0.
        cameras: cameras of the V views of one scene (B = 1), of the depth maps' size.
        colors: ``[V, 3, H, W]`` in [0, 1].
        voxel_size: edge length of a voxel in scene units; smaller details are lost.

    Returns:
        The mesh; empty if there is no valid depth.

    Raises:
        ValueError: if shapes disagree, a value is not finite, or :data:`MAX_VOXELS` is exceeded.
    """
    _check(depth, cameras, colors, voxel_size)
    cameras = cameras.map(lambda tensor: tensor.detach().cpu().float())
    depth, colors = depth.detach().cpu().float(), colors.detach().cpu().float()
    blocks = _surface_blocks(depth, cameras, voxel_size)
    inside = torch.stack(torch.meshgrid(*3 * [torch.arange(_BLOCK)], indexing="ij"), -1).reshape(-1, 3)
    # weighted sums at the voxels of each block: signed distance over the truncation, colour; and the weights
    sums, weight = torch.zeros(len(blocks), _BLOCK**3, 4), torch.zeros(len(blocks), _BLOCK**3)
    weights = [_weights(view, k) for view, k in zip(depth, cameras.intrinsics[0], strict=True)]
    for start in range(0, len(blocks), _BLOCKS_PER_CHUNK):
        rows = slice(start, start + _BLOCKS_PER_CHUNK)
        centers = ((blocks[rows, None] * _BLOCK + inside) + 0.5) * voxel_size
        for view in range(len(depth)):
            camera = cameras.world_to_camera[0, view], cameras.intrinsics[0, view]
            _integrate(centers, depth[view], weights[view], colors[view], camera, voxel_size, sums[rows], weight[rows])
    values = sums / weight.clamp(min=_MIN_WEIGHT)[..., None]
    # Voxels in free space beyond the truncation do not locate a surface. Next to a depth edge they would close the gap
    # between foreground and background.
    seen = ((weight > 0) & (values[..., 0] < 1)).reshape(-1)
    keys, order = torch.sort(_pack((blocks[:, None] * _BLOCK + inside).reshape(-1, 3)[seen]))
    return _surface(keys, values.reshape(-1, 4)[seen][order], voxel_size)


def surface_of(index: Tensor, values: Tensor, voxel_size: float) -> Mesh:
    """Returns the zero level set of voxels, as :func:`fuse_depth` does.

    Args:
        index: ``[N, 3]`` int64 voxels in lexicographic order; the centre of voxel i is at ``(i + 1/2) * voxel_size``.
        values: ``[N, 4]`` float32 signed distance, negative inside, and colour in [0, 1].
        voxel_size: edge length of a voxel in scene units.
    """
    return _surface(_pack(index), values, voxel_size)


def write_mesh(path: str | Path, mesh: Mesh) -> Path:
    """Writes a mesh with trimesh, atomically, in our world frame, ``.glb`` with y up; the suffix selects the format.

    Args:
        path: a file ending in ``.ply`` or ``.glb``.
        mesh: mesh to write; not changed.

    Raises:
        ValueError: if the suffix is unknown, or the mesh has no triangles.
    """
    import trimesh  # imported here, because it takes a second

    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"{path}: a mesh is written as one of {', '.join(_SUFFIXES)}")
    if not len(mesh.faces):
        raise ValueError("the mesh is empty: no valid depth, or voxels larger than the surfaces; check both")
    in_gltf = path.suffix.lower() == ".glb"
    colors = linear_colors(mesh.colors) if in_gltf else mesh.colors
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
    if in_gltf:
        body.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))  # glTF has y up, our world has y down
    content = body.export(file_type=path.suffix[1:].lower())
    assert isinstance(content, bytes)
    return write_bytes(path, content)


def linear_colors(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Converts sRGB to linear colours, which glTF's vertices have."""
    share = colors / 255
    return (255 * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4) + 0.5).astype(np.uint8)


def _check(depth: Tensor, cameras: Cameras, colors: Tensor, voxel_size: float) -> None:
    views, (height, width) = cameras.world_to_camera.shape[1], cameras.size
    wanted, found = [(views, height, width), (views, 3, height, width)], [depth.shape, colors.shape]
    if len(cameras.world_to_camera) != 1 or found != wanted or min(height, width) < 2:
        raise ValueError(
            f"depth and colors must be {wanted}, at least 2x2, of one scene, got {list(map(tuple, found))}"
        )
    tensors = {"depth": depth, "world_to_camera": cameras.world_to_camera, "intrinsics": cameras.intrinsics}
    for name, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            raise ValueError(f"{name} has values that are not finite; set invalid depth to 0 and drop such views")
    if not voxel_size > 0:
        raise ValueError(f"voxel_size must be positive, got {voxel_size}")


def _surface_blocks(depth: Tensor, cameras: Cameras, voxel_size: float) -> Tensor:
    """Blocks ``[N, 3]`` with a point within the truncation before or behind a depth sample, sorted, unique.

    A block starts at voxel ``_BLOCK * index``; the centre of voxel i is at ``(i + 1/2) * voxel_size``.
    """
    truncation = _TRUNCATION * voxel_size
    steps = int(np.ceil(2 * truncation / (_BLOCK * voxel_size / 2))) + 1
    offsets = torch.linspace(-truncation, truncation, steps, dtype=torch.float64).tolist()
    # includes neighbouring voxels: the surface may pass between two blocks
    around = torch.stack(torch.meshgrid(*3 * [torch.tensor([-1, 1])], indexing="ij"), -1).reshape(-1, 3)
    limit = (1 << _KEY_BITS) - _BLOCK
    blocks = torch.zeros(0, dtype=torch.int64)
    for view in range(len(depth)):
        valid = depth[view] > 0
        for offset in offsets:
            shifted = (depth[view] + offset) * valid
            points = unproject(shifted[None, None], cameras.select(slice(view, view + 1)))[0, 0][shifted > 0]
            index = torch.floor(points / voxel_size)
            if len(index) and index.abs().max() >= limit:
                reach = f"the scene reaches more than {limit} voxels of {voxel_size:g} from the origin"
                raise ValueError(f"{reach}; set far depth to 0 or take larger voxels")
            voxels = _unpack(torch.unique(_pack(index.long())))
            touched = torch.div(voxels[:, None] + around, _BLOCK, rounding_mode="floor")
            blocks = torch.unique(torch.cat((blocks, _pack(touched.reshape(-1, 3)))))
        if len(blocks) * _BLOCK**3 > MAX_VOXELS:
            need = f"the surfaces need more than {MAX_VOXELS} voxels of {voxel_size:g}"
            raise ValueError(f"{need}; take larger voxels, or set far depth to 0")
    return _unpack(blocks)


def _weights(depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Weights ``[H, W]`` of a view's depth samples."""
    rays = ray_directions(intrinsics, (depth.shape[0], depth.shape[1]))
    normals, valid = normals_from_depth(depth, intrinsics)
    cosine = (normals.permute(1, 2, 0) * rays).sum(-1) / rays.norm(dim=-1)
    return torch.where(valid, cosine.square().clamp(min=_MIN_WEIGHT), _EDGE_WEIGHT)


def _integrate(
    centers: Tensor,
    depth: Tensor,
    weights: Tensor,
    color: Tensor,
    camera: tuple[Tensor, Tensor],
    voxel_size: float,
    sums: Tensor,
    weight: Tensor,
) -> None:
    """Adds one view to the sums ``[N, 512, 4]`` and weights ``[N, 512]`` of voxels with the given centres, in place."""
    (pose, k), truncation = camera, _TRUNCATION * voxel_size
    local = centers.float() @ pose[:3, :3].T + pose[:3, 3]
    z = local[..., 2]
    x, y = (local[..., axis] / z.clamp(min=1e-6) * k[axis, axis] + k[axis, 2] for axis in (0, 1))
    height, width = depth.shape
    visible = (z > 1e-6) & (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    pick = torch.nonzero(visible.reshape(-1))[:, 0]
    x, y, z = (values.reshape(-1)[pick] for values in (x, y, z))
    surface = _sample_depth(depth, x, y, truncation)
    keep = (surface > 0) & (surface - z > -truncation)
    pick, column, row = pick[keep], x[keep].round().long(), y[keep].round().long()
    signed = (surface - z)[keep] / truncation
    share = weights[row, column]
    values = torch.cat((signed.clamp(max=1)[:, None], color[:, row, column].T), -1)
    sums.view(-1, 4)[pick] += share[:, None] * values
    weight.view(-1)[pick] += share


def _sample_depth(depth: Tensor, x: Tensor, y: Tensor, truncation: float) -> Tensor:
    """Samples depth bilinearly if the four neighbours are on one surface, else nearest, so that edges stay sharp."""
    height, width = depth.shape
    left, top = x.floor().long().clamp(0, width - 2), y.floor().long().clamp(0, height - 2)
    fx, fy = (x - left).clamp(0, 1), (y - top).clamp(0, 1)
    corners = torch.stack([depth[top + j, left + i] for j in (0, 1) for i in (0, 1)])
    weights = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    smooth = (corners.amin(0) > 0) & (corners.amax(0) - corners.amin(0) < truncation)
    nearest = depth[y.round().long().clamp(0, height - 1), x.round().long().clamp(0, width - 1)]
    return torch.where(smooth, (corners * weights).sum(0), nearest)


def _surface(keys: Tensor, values: Tensor, voxel_size: float) -> Mesh:
    """Extracts the zero level set of voxels with sorted keys ``[N]`` and distance and colour ``[N, 4]`` (surface nets).

    The surface crosses every voxel edge whose ends differ in sign. The vertex of a cell is the mean of the crossings on
    its edges. Each crossed edge makes a quad of the vertices of its four cells.
    """
    parts = zip(*(_crossings(keys, values, axis) for axis in range(3)), strict=True)
    crossings, cells, outward = (torch.cat(part) for part in parts)
    cell_keys, corner = torch.unique(cells, return_inverse=True)  # corner: [E, 4] vertex of each cell around an edge
    count = torch.bincount(corner.reshape(-1), minlength=len(cell_keys)).clamp(min=1)[:, None]
    total = torch.zeros(len(cell_keys), 6, dtype=torch.float64)
    total = total.index_add_(0, corner.reshape(-1), crossings.repeat_interleave(4, 0)) / count
    vertices = ((total[:, :3] + 0.5) * voxel_size).float().numpy()
    colors = (total[:, 3:].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    # each quad is cut along its shorter diagonal into two triangles that face free space
    quads = torch.where(outward[:, None], corner, corner.flip(-1)).numpy()
    a, b, c, d = (vertices[quads[:, i]] for i in range(4))
    shorter = np.linalg.norm(a - c, axis=-1) <= np.linalg.norm(b - d, axis=-1)
    along_ac, along_bd = quads[:, [0, 1, 2, 0, 2, 3]], quads[:, [0, 1, 3, 1, 2, 3]]
    return Mesh(vertices, np.where(shorter[:, None], along_ac, along_bd).reshape(-1, 3).astype(np.int64), colors)


def _crossings(keys: Tensor, values: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor]:
    """Finds the crossed edges along one axis.

    Returns:
        Crossing points in voxel indices and their colours ``[E, 6]`` (float64), keys of the four cells around each edge
        ``[E, 4]``, counter-clockwise seen from the positive axis, and ``[E]`` bool: whether free space lies in the
        positive direction.
    """
    stride = 1 << ((_KEY_BITS + 1) * (2 - axis))
    at = torch.searchsorted(keys, keys + stride).clamp(max=len(keys) - 1) if len(keys) else keys
    near, far = values, values[at]
    crossed = (keys[at] == keys + stride) & ((near[:, 0] < 0) != (far[:, 0] < 0))
    near, far, origin = near[crossed], far[crossed], keys[crossed]
    share = (near[:, :1] / (near[:, :1] - far[:, :1])).double()
    points = _unpack(origin).double()
    points[:, axis] += share[:, 0]
    shades = torch.lerp(near[:, 1:], far[:, 1:], share.float()).double()
    u, v = (1 << ((_KEY_BITS + 1) * (2 - (axis + step) % 3)) for step in (1, 2))
    cells = torch.stack((origin, origin - u, origin - u - v, origin - v), -1)
    return torch.cat((points, shades), -1), cells, far[:, 0] > 0


def _pack(index: Tensor) -> Tensor:
    """Packs indices ``[..., 3]`` into int64 keys ``[...]`` that sort lexicographically."""
    shifted = index + (1 << _KEY_BITS)
    x, y, z = shifted.unbind(-1)
    return (x << (2 * _KEY_BITS + 2)) | (y << (_KEY_BITS + 1)) | z


def _unpack(keys: Tensor) -> Tensor:
    """Inverse of :func:`_pack`."""
    mask = (1 << (_KEY_BITS + 1)) - 1
    parts = (keys >> (2 * _KEY_BITS + 2), (keys >> (_KEY_BITS + 1)) & mask, keys & mask)
    return torch.stack(parts, -1) - (1 << _KEY_BITS)
