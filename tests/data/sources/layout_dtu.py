"""DTU as MVSNet tests on it."""

from pathlib import Path

import numpy as np

from examples.data_sets.dtu import DTU
from vg2gt.data import Frames

from .layouts import Layout, pixels, save


def pfm(depth: np.ndarray) -> bytes:
    """A little-endian portable float map."""
    height, width = depth.shape
    return f"Pf\n{width} {height}\n-1.0\n".encode() + depth[::-1].astype("<f4").tobytes()


def camera(world_to_camera: np.ndarray, intrinsics: np.ndarray) -> str:
    """A camera file; the translation is given in metres and written in millimetres."""
    pose = np.array(world_to_camera, np.float64)
    pose[:3, 3] *= 1000
    rows = [" ".join(repr(float(value)) for value in row) for row in (*pose, *intrinsics)]
    return "extrinsic\n" + "\n".join(rows[:4]) + "\n\nintrinsic\n" + "\n".join(rows[4:]) + "\n\n425.0 2.5\n"


def write_depth(folder: Path, frames: Frames) -> None:
    """``depth_map`` and ``depth_visual``; masked depth is nonsense."""
    folder.mkdir(parents=True)
    for i, depth in enumerate(frames.depth.numpy() * 1000):
        (folder / f"depth_map_{i:04d}.pfm").write_bytes(pfm(np.where(depth > 0, depth, 777)))
        save(folder / f"depth_visual_{i:04d}.png", np.where(depth > 0, 255, 10).astype(np.uint8))


def write_test(root: Path, frames: Frames) -> None:
    """Scan 65 with JPEG images, and depth next to the scans."""
    folder = root / "scans" / "scan65"
    (folder / "cams").mkdir(parents=True)
    for i, image in enumerate(pixels(frames)):
        save(folder / "images" / f"{i:08d}.jpg", image)
        text = camera(frames.world_to_camera[i].double().numpy(), frames.intrinsics[i].double().numpy())
        (folder / "cams" / f"{i:08d}_cam.txt").write_text(text)
    (folder / "pair.txt").write_text("1\n0\n1 1 1.0\n")
    write_depth(root / "depth" / "scan65", frames)


# Depth is stored in float32 millimetres.
LAYOUTS = {
    "dtu": Layout(
        write_test,
        lambda root: DTU(f"{root}/scans", depth_root=f"{root}/depth"),
        image_error=0.012,
        depth_quantum=lambda depth: depth * 1e-6,
    ),
}
