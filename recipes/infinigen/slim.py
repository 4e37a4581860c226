"""Slim copies of rooms, small enough for the repository: ``python -m recipes.infinigen.slim FOLDER OUT``.

Writes one file of at most 48 views for every room in ``FOLDER`` that has none in ``OUT``, with the room's seed, kind
and figures. :func:`read_slim` reads such a file.
"""

from __future__ import annotations

import io
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vg2gt.io.files import write_bytes
from vg2gt.io.images import encode_image, open_image

VIEWS = 48
QUALITY = 90  # of the JPEG
LEAST, STEP = 0.02, math.log(5000) / 4000  # depth in metres of value 1, and log-depth between values (0.2 %); 0 is sky
_SHARES = {"walk": 12, "orbit_near": 12, "orbit_far": 12, "near": 6, "far": 6}  # views of each kind of path, in order


def choose(paths: list[str]) -> list[int]:
    """Chooses views: consecutive ones of every kind of path, without turns on the spot, which have no parallax."""
    rows: dict[str, list[int]] = {}
    for row, path in enumerate(paths):
        rows.setdefault(path.rsplit("_", 1)[0], []).append(row)
    chosen = [row for kind, count in _SHARES.items() for row in rows.get(kind, [])[:count]]
    others = [row for kind in _SHARES for row in rows.get(kind, []) if row not in chosen]
    return sorted(chosen + others[: VIEWS - len(chosen)])


def encode_depth(depth: NDArray[Any]) -> NDArray[np.uint16]:
    """Encodes depth in metres as steps of log-depth; infinity is 0."""
    steps = np.round(np.log(np.maximum(depth, LEAST).astype(np.float64) / LEAST) / STEP) + 1
    return np.where(np.isfinite(depth), np.minimum(steps, 4095), 0).astype(np.uint16)


def decode_depth(steps: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Decodes :func:`encode_depth`."""
    return np.where(steps > 0, LEAST * np.exp(STEP * (steps.astype(np.float64) - 1)), np.inf).astype(np.float32)


def read_slim(path: Path) -> dict[str, NDArray[Any]]:
    """Reads a slim room.

    Returns:
        ``images [N, H, W, 3]`` (uint8), ``depth [N, H, W]`` in metres (infinite: sky), ``world_to_camera [N, 4, 4]``
        and ``intrinsics [N, 3, 3]`` with integer pixel centres.
    """
    with np.load(path, allow_pickle=False) as file:
        poses, intrinsics = file["world_to_camera"], file["intrinsics"]
        images, steps = (np.array(open_image(io.BytesIO(file[name].tobytes()))) for name in ("images", "depth"))
    images = images.reshape(len(poses), -1, *images.shape[1:])
    depth = decode_depth(steps.astype(np.uint16)).reshape(len(poses), -1, steps.shape[1])
    return {"images": images, "depth": depth, "world_to_camera": poses, "intrinsics": intrinsics}


def write_slim(room: Path, path: Path) -> None:
    """Writes the slim copy of a room made by ``make.py``; all views are stacked into one JPEG and one 16-bit PNG."""
    rows = choose([view["path"] for view in json.loads((room / "views.json").read_text())])
    images, depths, poses, intrinsics = [], [], [], []
    for row in rows:
        stem = f"0_0_{row:04d}_0"
        (picture,) = (room / "frames/Image/camera_0").glob(f"Image_{stem}.*")
        images.append(np.asarray(open_image(picture).convert("RGB")))
        depths.append(np.load(room / f"frames/Depth/camera_0/Depth_{stem}.npy", allow_pickle=False))
        with np.load(room / f"frames/camview/camera_0/camview_{stem}.npz", allow_pickle=False) as camera:
            poses.append(np.linalg.inv(camera["T"]))
            corner = np.array(camera["K"], np.float64)
        corner[:2, 2] -= 0.5  # pixel corners at integers in the rooms
        intrinsics.append(corner)
    pictures = encode_image(np.concatenate(images), "JPEG", quality=QUALITY, subsampling=0)
    steps = encode_image(encode_depth(np.concatenate(depths)), "PNG", compress_level=9)
    buffer = io.BytesIO()
    np.savez(
        buffer,
        images=np.frombuffer(pictures, np.uint8),
        depth=np.frombuffer(steps, np.uint8),
        world_to_camera=np.stack(poses).astype(np.float32),
        intrinsics=np.stack(intrinsics).astype(np.float32),
        made_of=np.frombuffer((room / "check.json").read_bytes(), np.uint8),
    )
    write_bytes(path, buffer.getvalue())


def main() -> None:
    """Command line."""
    folder, out = map(Path, sys.argv[1:])
    out.mkdir(parents=True, exist_ok=True)
    for room in sorted(folder.glob("room_*")):
        if not (out / f"{room.name}.npz").exists():
            write_slim(room, out / f"{room.name}.npz")


if __name__ == "__main__":
    main()
