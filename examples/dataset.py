"""Example of a custom dataset: ``SCENE/rgb/N.png``, ``SCENE/depth/N.npy`` and ``SCENE/cameras.json``."""

import json
from pathlib import Path

import numpy as np

from vg2gt.data import DataError
from vg2gt.data.sources.files import FileSource
from vg2gt.data.sources.index import SceneIndex, make_index
from vg2gt.io.arrays import load_npy


class Mine(FileSource):
    """RGB-D scenes; ``cameras.json`` has ``K`` (3x3, integer pixel centres) and camera-to-world ``poses`` by frame."""

    layout = "SCENE/{rgb,depth,cameras.json}"  # shown in messages
    scene_marks = ("rgb", "cameras.json")  # in the folder of a scene

    def index(self, scene: str, folder: Path) -> SceneIndex:
        """Lists the frames of a scene; does not decode images."""
        try:
            cameras = json.loads((folder / "cameras.json").read_text())
            poses = {int(number): np.array(pose, np.float64) for number, pose in cameras["poses"].items()}
            intrinsics = np.array(cameras["K"], np.float64)
        except (OSError, ValueError, KeyError) as error:
            raise DataError(f"cannot read cameras.json of scene {scene} in {folder}: {error}") from error
        color = {int(path.stem): path for path in (folder / "rgb").glob("*.png")}
        depth = {int(path.stem): path for path in (folder / "depth").glob("*.npy")}
        return make_index(scene, folder, color, depth, poses, intrinsics)

    def read_depth(self, index: SceneIndex, row: int, size: tuple[int, int]) -> np.ndarray:
        """Reads the z-depth ``[height, width]`` of a frame in metres, 0 where unknown."""
        depth = load_npy(index.depth[row], index.name, size)
        return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
