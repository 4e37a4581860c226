"""Files of a reconstruction in windows: arrays of all views, results of finished steps, and voxels of image sets.

Each command adds or removes one set of images through the voxels that it pooled.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.format import open_memmap
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from vg2gt.io.errors import FormatError
from vg2gt.io.files import by_number, read_json, replacing, write_json
from vg2gt.io.tensors import read_tensors
from vg2gt.method.pooled import PooledVoxels, concatenate, merge
from vg2gt.model import Reconstructor
from vg2gt.reconstruction.monitor import Monitor
from vg2gt.reconstruction.scene import Scene
from vg2gt.types import Cameras

FORMAT = 1
"""Version of the folder's format; increment it when the format changes."""
SET = "set.json"  # marks the folder of a set; says whether it is finished
_ANCHOR = "scene.json"
_KEPT = ("voxels-", "background", SET)  # prefixes of the files that a finished set needs
ROWS = 400_000  # voxels merged at a time
_PLAIN = (bool, int, float, str, tuple, type(None))


class WindowStore:
    """The folder of one image set; its content survives an interruption.

    Args:
        folder: parent folder of all sets; the folder of this set is created in it if missing.
        key: hash of the images, model and sizes of the set.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder / key[:12]
        if not (self.folder / SET).is_file():
            write_json(self.folder / SET, {"finished": False})

    def finish(self) -> None:
        """Marks the set as finished."""
        write_json(self.folder / SET, {"finished": True})

    def array(self, name: str, shape: Sequence[int] | None = None, fill: float = 0) -> Tensor:
        """Returns a memory-mapped float32 array of the folder; writing to the tensor writes to the file.

        Args:
            name: file name without extension.
            shape: shape to create the array with if it does not exist.
            fill: initial value of a new array.
        """
        path = self.folder / f"{name}.npy"
        if shape is not None and not path.is_file():
            with replacing(path) as temporary:
                made = open_memmap(temporary, "w+", np.float32, tuple(shape))
                if fill:
                    made[:] = fill
                del made
        return torch.from_numpy(open_memmap(path, "r+"))

    def has(self, name: str) -> bool:
        """Returns whether an array or a finished step of this name exists."""
        return (self.folder / f"{name}.npy").is_file() or self.step(name).is_file()

    def step(self, name: str) -> Path:
        """Returns the file of a finished step."""
        return self.folder / f"{name}.safetensors"

    def save(self, name: str, tensors: Mapping[str, Tensor]) -> None:
        """Writes the result of a step, completely or not at all."""
        with replacing(self.step(name)) as temporary:
            save_file({key: value.detach().cpu().contiguous() for key, value in tensors.items()}, temporary)

    def load(self, name: str) -> dict[str, Tensor] | None:
        """Reads the result of a step; None if it is not finished."""
        try:
            return read_tensors(self.step(name))
        except (FileNotFoundError, FormatError):
            return None


def key_of(model: Reconstructor, *facts: object) -> str:
    """Returns a hash of a model's weights and options, and of further facts (JSON values)."""
    digest = hashlib.sha256(json.dumps([FORMAT, model.backend.identity(), facts]).encode())
    for name, module in model.named_modules():
        options = {key: value for key, value in vars(module).items() if isinstance(value, _PLAIN) and key[0] != "_"}
        options.pop("training", None)
        digest.update(f"{name} {sorted(options.items())}".encode())
    digest.update(f"{model.visibility} {vars(model.scale)}".encode())
    for name, tensor in sorted(model.trained_state().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def merge_windows(files: Sequence[Path], monitor: Monitor, limit: int = ROWS) -> PooledVoxels:
    """Merges the voxels of all windows of a scene.

    The voxels of each window are sorted by x, so that a slab of space is a range of rows in each file.

    Args:
        files: voxel files of the windows, in the order of summation.
        monitor: shows the progress.
        limit: approximate number of voxels merged at a time.

    Raises:
        ValueError: if there are no voxels.
    """
    columns = [_read_rows(file, slice(None))["grid"][:, 0].contiguous() for file in files]
    slabs = _slabs(columns, limit)
    merged = []
    with monitor.stage("merge voxels", len(slabs)) as advance:
        for slab in slabs:
            parts = []
            for file, column in zip(files, columns, strict=True):
                begin, end = torch.searchsorted(column, torch.tensor(slab)).tolist()
                if end > begin:
                    found = _read_rows(file, slice(begin, end))
                    parts.append(PooledVoxels(**{each.name: found.get(each.name) for each in fields(PooledVoxels)}))  # pyright: ignore
            merged.append(merge(parts))
            advance()
    if not merged:
        raise ValueError("the backbone found no depth in any image, so there is nothing to reconstruct")
    return merged[0] if len(merged) == 1 else concatenate(merged)


def _slabs(columns: Sequence[Tensor], limit: int) -> list[tuple[int, int]]:
    """Returns ranges of x that hold about ``limit`` entries of the sorted columns each."""
    places, counts = torch.cat(list(columns)).unique(return_counts=True)
    slab = (counts.cumsum(0) - counts) // limit
    starts = torch.cat((torch.ones(1, dtype=torch.bool), slab.diff() > 0)).nonzero()[:, 0] if len(places) else []
    bounds = [int(places[start]) for start in starts]
    return list(zip(bounds, [*bounds[1:], int(places[-1]) + 1], strict=True)) if bounds else []


def _read_rows(file: Path, rows: slice) -> dict[str, Tensor]:
    """Reads some rows of all tensors in a finished step's file."""
    with safe_open(file, "pt") as opened:
        return {key: opened.get_slice(key)[rows] for key in opened.keys()}  # noqa: SIM118


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
