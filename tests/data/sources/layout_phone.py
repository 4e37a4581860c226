"""Exports of capture apps: Record3D, Polycam, Stray Scanner."""

import csv
import importlib.util
import json
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vg2gt.data import Frames, RGBDFolder
from vg2gt.io import write_video

from .layouts import SIZE, Layout, camera_of, camera_to_world, encoded, millimetres, pixels, save

OPENGL = np.diag([1.0, -1, -1, 1])
CORNER = np.array([0, 0, 0.5, 0.5])  # from the middle of the first pixel to its corner


def record3d_metadata(frames: Frames) -> dict[str, Any]:
    fx, fy, cx, cy = camera_of(frames) + CORNER
    poses = [[*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]] for pose in camera_to_world(frames) @ OPENGL]
    return {"w": SIZE[1], "h": SIZE[0], "poses": poses, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "fps": 60}


def write_r3d(root: Path, frames: Frames, packed: bool = True) -> None:
    """Record3D's own: a ZIP of JSON without an ending, and depth and confidence in LZFSE."""
    import lzfse  # pyright: ignore[reportMissingImports]: optional

    own = [(camera_of(frames) + CORNER).tolist()] * len(frames.images)
    content = record3d_metadata(frames)
    content |= {"K": [1.0, 0, 0, 0, 1, 0, 0, 0, 1], "perFrameIntrinsicCoeffs": own} if not packed else {}
    content |= {"dw": SIZE[1], "dh": SIZE[0], "initPose": [0, 0, 0, 1, 0, 0, 0]}
    files = {"metadata": json.dumps(content).encode(), "icon": b"a picture", "sound.m4a": b"a sound"}
    for i in range(len(frames.images)):
        files[f"rgbd/{i}.jpg"] = encoded(pixels(frames)[i])
        files[f"rgbd/{i}.depth"] = lzfse.compress(frames.depth[i].numpy().astype("<f4").tobytes())
        files[f"rgbd/{i}.conf"] = lzfse.compress(np.full(SIZE, 2, np.uint8).tobytes())
    root.mkdir(parents=True, exist_ok=True)
    if packed:
        with zipfile.ZipFile(root / "sofa.r3d", "w") as archive:
            for name, part in files.items():
                archive.writestr(name, part)
        return
    for name, part in files.items():
        (root / "sofa" / name).parent.mkdir(parents=True, exist_ok=True)
        (root / "sofa" / name).write_bytes(part)


def write_polycam(root: Path, frames: Frames, corrected: bool = True) -> None:
    """Raw data; what is there before the app's own optimisation is another camera."""
    folder = root / "kitchen" / "keyframes"
    for i, pose in enumerate(camera_to_world(frames) @ OPENGL):
        name = str(1667263848031 + 33 * i)
        fx, fy, cx, cy = camera_of(frames) + CORNER
        camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": SIZE[1], "height": SIZE[0]}
        camera = {name: 2 * value for name, value in camera.items()} | {"blur_score": 80.5}  # of larger images
        camera |= {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        before = "corrected_" if corrected else ""
        save(folder / f"{before}images" / f"{name}.jpg", pixels(frames)[i])
        save(folder / "depth" / f"{name}.png", millimetres(frames)[i])
        for kind in {"cameras", f"{before}cameras"}:
            (folder / kind).mkdir(exist_ok=True)
            other = {"t_03": 0.0} if corrected and kind == "cameras" else {}
            (folder / kind / f"{name}.json").write_text(json.dumps(camera | other))


def write_stray(root: Path, frames: Frames) -> None:
    """A video, and depth next to it."""
    folder = root / "71de12f9"
    folder.mkdir(parents=True)
    write_video(folder / "rgb.mp4", list(pixels(frames)), fps=30)
    rows = [["timestamp", " frame", " x", " y", " z", " qx", " qy", " qz", " qw"]]
    for i, pose in enumerate(camera_to_world(frames)):
        save(folder / "depth" / f"{i:06d}.png", millimetres(frames)[i])
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append([f"{i / 30:.4f}", f" {i:06d}", *map(repr, [*pose[:3, 3].tolist(), *quaternion.tolist()])])
    with open(folder / "odometry.csv", "w", newline="") as file:
        csv.writer(file).writerows(rows)
    fx, fy, cx, cy = camera_of(frames) + CORNER
    np.savetxt(folder / "camera_matrix.csv", [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], delimiter=",", fmt="%.17g")


READ = partial(RGBDFolder, holdout=None)
POLYCAM_IDS = range(1667263848031, 1667263848031 + 6 * 33, 33)
LAYOUTS = {
    "polycam": Layout(write_polycam, READ, image_error=0.012, frame_ids=POLYCAM_IDS),
    "stray_scanner": Layout(write_stray, READ, image_error=0.03),
}
if importlib.util.find_spec("lzfse"):
    unpacked = partial(write_r3d, packed=False)
    LAYOUTS["r3d"] = Layout(write_r3d, READ, image_error=0.012, depth_quantum=1e-6)
    LAYOUTS["r3d_unpacked"] = Layout(unpacked, READ, image_error=0.012, depth_quantum=1e-6)
