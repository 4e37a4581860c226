"""Scenes of several image sets: each command adds or removes one set through the voxels that it pooled."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vg2gt.io.files import by_number, read_json, write_json
from vg2gt.reconstruction.scene import Scene
from vg2gt.reconstruction.windows.store import SET
from vg2gt.types import Cameras

_ANCHOR = "scene.json"
_KEPT = ("voxels-", "background", SET)  # prefixes of the files that a finished set needs


@dataclass(frozen=True)
class Anchor:
    """Data shared by all sets of a scene; created with the first set.

    Attributes:
        reference: ``[4, 4]`` float64 given pose of the camera that is the frame of the voxels.
        unit: scene units per unit of the given cameras.
        voxel_size: edge of the fine voxels in scene units.
        size: ``(height, width)`` of the images.
        model: key of the model.
    """

    reference: NDArray[np.float64]
    unit: float
    voxel_size: float
    size: tuple[int, int]
    model: str

    @property
    def to_source(self) -> NDArray[np.float64]:
        """``[4, 4]`` similarity from the frame and unit of the voxels to those of the given cameras."""
        matrix = np.linalg.inv(self.reference) @ np.diag([1 / self.unit, 1 / self.unit, 1 / self.unit, 1.0])
        return matrix.astype(np.float64)

    def plain(self) -> dict[str, Any]:
        """Returns the attributes as JSON values."""
        return vars(self) | {"reference": self.reference.tolist()}

    def write(self, folder: Path) -> None:
        """Writes the anchor into the folder of the sets."""
        write_json(folder / _ANCHOR, self.plain())


def read_anchor(folder: Path) -> Anchor:
    """Reads the anchor of a scene.

    Raises:
        FileNotFoundError: if there is none; the message names the remedy.
    """
    if not (folder / _ANCHOR).is_file():
        raise FileNotFoundError(
            f"{folder} contains no voxels of a scene: reconstruct it with --window N --keep-windows and given cameras"
        )
    found: dict[str, Any] = read_json(folder / _ANCHOR)
    return Anchor(**found | {"reference": np.array(found["reference"]), "size": tuple(found["size"])})


def finished_sets(folder: Path) -> list[Path]:
    """Returns the folders of the complete sets, sorted by key, which is the order of summation."""
    return sorted(path.parent for path in folder.glob(f"*/{SET}") if read_json(path).get("finished"))


def tidy(folder: Path) -> None:
    """Removes unfinished sets and all files that are not needed to add or remove sets."""
    done = finished_sets(folder)
    for place in (file.parent for file in folder.glob(f"*/{SET}")):
        if place not in done:
            shutil.rmtree(place)
    for file in (file for place in done for file in place.iterdir()):
        if not file.name.startswith(_KEPT):
            file.unlink()


def joined(old: Scene, new: Scene) -> Scene:
    """Joins the views of two scenes in one frame, sorted by name, with the Gaussians of the second."""
    names = (*old.names, *new.names)
    order = torch.tensor(sorted(range(len(names)), key=lambda view: by_number(names[view])))
    masks = [torch.ones_like(each.depth) if each.mask is None else each.mask for each in (old, new)]

    def both(one: Tensor, other: Tensor) -> Tensor:
        return torch.cat((one.cpu(), other.cpu()))[order]

    poses, intrinsics = (
        both(getattr(old.cameras, name)[0], getattr(new.cameras, name)[0])[None]
        for name in ("world_to_camera", "intrinsics")
    )
    return replace(
        new,
        cameras=Cameras(poses, intrinsics, new.cameras.size).to(new.cameras.world_to_camera.device),
        images=both(old.images, new.images),
        depth=both(old.depth, new.depth),
        depth_conf=both(old.depth_conf, new.depth_conf),
        mask=None if old.mask is None and new.mask is None else both(*masks),
        names=tuple(names[view] for view in order.tolist()),
        pictures=(),
        poses=None if old.poses is None or new.poses is None else both(old.poses, new.poses),
    )


def without(scene: Scene, names: set[str]) -> Scene:
    """Returns the scene without the named views; its Gaussians stay.

    Raises:
        ValueError: if no view is left.
    """
    rows = torch.tensor([view for view, name in enumerate(scene.names) if name not in names])
    if not len(rows):
        raise ValueError("no image would be left in the scene")
    return replace(
        scene,
        cameras=scene.cameras.select(rows.to(scene.cameras.world_to_camera.device)),
        images=scene.images[rows],
        depth=scene.depth[rows],
        depth_conf=scene.depth_conf[rows],
        mask=None if scene.mask is None else scene.mask[rows],
        names=tuple(scene.names[view] for view in rows.tolist()),
        pictures=(),
        poses=None if scene.poses is None else scene.poses[rows],
    )
