"""Writes the scenes of any data set as RGB-D recordings, which ``data=rgbd data.root=OUT`` reads.

``python examples/write_recordings.py OUT data=synthetic data.train.num_scenes=100 data.image_size=[224,448]``. A
recording has ``images/``, ``depth/`` (16-bit millimetres, 0 = none, so nothing beyond 65 m), ``poses.txt``
(camera-to-world, 16 numbers a line) and ``K.txt``. Run it again to continue; to use more cores, run it several times
with other ``data.train.first_seed``.
"""

import shutil
import sys
from pathlib import Path

import numpy as np
from hydra.utils import instantiate
from PIL import Image
from rich.progress import track

from vg2gt.config import compose
from vg2gt.data import Frames


def write_recording(folder: Path, frames: Frames) -> None:
    """Writes frames of one size and camera; the folder appears whole."""
    staged = folder.parent / ".unfinished" / folder.name / "scene"  # too deep for readers to find
    shutil.rmtree(staged, ignore_errors=True)
    for kind in ("images", "depth"):
        (staged / kind).mkdir(parents=True)
    pixels = (frames.images.permute(0, 2, 3, 1).numpy() * 255 + 0.5).astype(np.uint8)
    for i, (image, depth) in enumerate(zip(pixels, stored_depth(frames.depth.numpy()), strict=True)):
        Image.fromarray(image).save(staged / "images" / f"{i:05d}.png")
        Image.fromarray(depth).save(staged / "depth" / f"{i:05d}.png")
    np.savetxt(staged / "poses.txt", np.linalg.inv(frames.world_to_camera.double().numpy()).reshape(-1, 16))
    np.savetxt(staged / "K.txt", frames.intrinsics[0].double().numpy())
    staged.rename(folder)
    shutil.rmtree(folder.parent / ".unfinished")


def stored_depth(depth: np.ndarray) -> np.ndarray:
    """Depth in metres as 16-bit millimetres, 0 where there is none or too much of it."""
    millimetres = np.rint(depth.astype(np.float64) * 1000)
    return np.where(millimetres < 65535, millimetres, 0).astype(np.uint16)  # 65535 often means none


def main() -> None:
    """Writes what the command line asks for."""
    out, overrides = Path(sys.argv[1]).expanduser(), sys.argv[2:]
    source = instantiate(compose("train", *overrides).data).train_source()
    for scene in track(source.scenes, "scenes"):
        folder = out / scene.replace("/", "-")
        if not folder.exists():
            write_recording(folder, source.load(scene, source.frames(scene)))


if __name__ == "__main__":
    main()
