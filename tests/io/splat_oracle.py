"""A reader and renderer of 3DGS files of its own, float64, from the published conventions of 3DGS and gsplat only.

Pixel centres at half integers; footprint covariance J W S W' J' + 0.3 I with x/z and y/z clamped to 1.3 half fields of
view in J; alpha = min(0.999, o exp(-d' Q d / 2)), below 1/255 it is no hit; front to back by z, ending before the hit
that would bring transmittance to 1e-4; colour max(0, SH + 1/2). Tile culling is left out: it only skips what is no hit.
"""

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a binary file of floats."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    names = re.findall(rb"property float (\w+)", head)
    values = np.frombuffer(body, "<f4").reshape(-1, len(names)).astype(np.float64)
    return {name.decode(): values[:, i] for i, name in enumerate(names)}


def sh_basis(d: np.ndarray) -> np.ndarray:
    """``[n, 16]`` of unit directions ``[n, 3]``."""
    x, y, z = d.T
    one = np.full_like(x, 0.28209479177387814)
    return np.stack(
        [
            one,
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ],
        -1,
    )


def render_ply(
    path: Path, world_to_camera: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], alpha_max: float
) -> np.ndarray:
    """Image ``[H, W, 3]`` on black; ``intrinsics`` with pixel centres at half integers."""
    table = read_table(path)

    def stack(*names: str) -> np.ndarray:
        return np.stack([table[name] for name in names], -1)

    means, opacity = stack("x", "y", "z"), 1 / (1 + np.exp(-table["opacity"]))
    axes = Rotation.from_quat(stack("rot_1", "rot_2", "rot_3", "rot_0")).as_matrix()  # scalar last
    sigma = np.exp(stack("scale_0", "scale_1", "scale_2"))
    rest = sum(name.startswith("f_rest_") for name in table) // 3
    channels = [stack(f"f_dc_{c}", *(f"f_rest_{c * rest + k}" for k in range(rest))) for c in range(3)]
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    direction = means + rotation.T @ translation
    basis = sh_basis(direction / np.linalg.norm(direction, axis=-1, keepdims=True))[:, : rest + 1]
    color = np.stack([(basis * channel).sum(-1) for channel in channels], -1)
    color = np.maximum(color + 0.5, 0)
    camera = means @ rotation.T + translation
    order = np.argsort(camera[:, 2], kind="stable")
    order = order[camera[order, 2] > 0.01]
    camera, axes, sigma, opacity, color = (v[order] for v in (camera, axes, sigma, opacity, color))
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    height, width = size
    z = camera[:, 2]
    u = np.clip(camera[:, 0] / z, -0.65 * width / fx, 0.65 * width / fx)
    v = np.clip(camera[:, 1] / z, -0.65 * height / fy, 0.65 * height / fy)
    zero = np.zeros_like(z)
    jacobian = np.stack([np.stack([fx / z, zero, -fx * u / z], -1), np.stack([zero, fy / z, -fy * v / z], -1)], 1)
    half = jacobian @ rotation @ (axes * sigma[:, None, :])
    conic = np.linalg.inv(half @ half.swapaxes(1, 2) + 0.3 * np.eye(2))
    center = np.stack([camera[:, 0] / z * fx + cx, camera[:, 1] / z * fy + cy], -1)
    image = np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            d = np.array([column + 0.5, row + 0.5]) - center
            alpha = opacity * np.exp(-0.5 * np.einsum("ni,nij,nj->n", d, conic, d))
            alpha = np.where(alpha < 1 / 255, 0, np.minimum(alpha, alpha_max))
            after = np.cumprod(1 - alpha)
            before = np.concatenate(([1.0], after[:-1]))
            image[row, column] = (np.where(after > 1e-4, alpha * before, 0)[:, None] * color).sum(0)
    return image
