"""Writes the scenes of any dataset as RGB-D recordings, for ``data=rgbd data.root=OUT``.

``python examples/write_recordings.py OUT data=synthetic data.train.num_scenes=100 data.image_size=[224,448]``. A
recording has ``images/``, ``depth/`` (16-bit millimetres, 0 = none, so at most 65 m), ``poses.txt`` (camera-to-world,
16 numbers per line) and ``K.txt``. To resume, run the same command again. To use more cores, run several processes with
different ``data.train.first_seed``.
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
    """Writes frames that share size and intrinsics; the folder appears only when complete."""
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
    """Converts depth in metres to 16-bit millimetres; 0 where unknown or too large."""
    millimetres = np.rint(depth.astype(np.float64) * 1000)
    return np.where(millimetres < 65535, millimetres, 0).astype(np.uint16)  # 65535 often means unknown


def main() -> None:
    """Runs the command line."""
    out, overrides = Path(sys.argv[1]).expanduser(), sys.argv[2:]
    source = instantiate(compose("train", *overrides).data).train_source()
    for scene in track(source.scenes, "scenes"):
        folder = out / scene.replace("/", "-")
        if not folder.exists():
            write_recording(folder, source.load(scene, source.frames(scene)))


if __name__ == "__main__":
    main()
