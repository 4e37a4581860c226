"""Infinigen: a video with depth of twice the images' size, and the export with one frame of many rigs."""

from pathlib import Path

import numpy as np

from vg2gt.data import Frames
from vg2gt.data.sources import Infinigen

from .layouts import Layout, camera_to_world, pixels, save

SKY = (1e10, np.inf)


def write(root: Path, frames: Frames, names: list[str], enlarge: int) -> None:
    """One scene; the pixels without depth are sky."""
    folder = root / "frames"
    poses = camera_to_world(frames)
    for kind in ("Image", "Depth", "camview"):
        (folder / kind / "camera_0").mkdir(parents=True)
    for i, name in enumerate(names):
        depth = frames.depth[i].numpy()
        depth = np.where(depth > 0, depth, SKY[i % 2]).astype(np.float32)
        intrinsics = frames.intrinsics[i].double().numpy()
        intrinsics[:2, 2] += 0.5
        save(folder / "Image/camera_0" / f"Image_{name}.png", pixels(frames)[i])
        np.save(folder / "Depth/camera_0" / f"Depth_{name}.npy", depth.repeat(enlarge, 0).repeat(enlarge, 1))
        np.savez(folder / "camview/camera_0" / f"camview_{name}.npz", K=intrinsics, T=poses[i])


def _write_video(root: Path, frames: Frames) -> None:
    write(root / "1a2b3c", frames, [f"0_0_{48 + i:04d}_0" for i in range(len(frames.images))], enlarge=2)


def _write_rigs(root: Path, frames: Frames) -> None:
    write(root / "scene_7" / "part_2", frames, [f"{8 + i}_0_0001_0" for i in range(len(frames.images))], enlarge=1)


LAYOUTS = {
    "infinigen": Layout(_write_video, Infinigen, depth_quantum=0.0, frame_ids=range(48, 54)),
    "infinigen_insscene": Layout(_write_rigs, Infinigen, depth_quantum=0.0, frame_ids=range(8, 14)),
}
