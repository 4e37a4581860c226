"""Scenes of Gaussians: reading by file suffix, and writing of large ones as tiles for viewers."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from vg2gt.io.files import write_json
from vg2gt.io.gltf import read_gaussian_gltf
from vg2gt.io.ply import read_gaussian_ply
from vg2gt.io.spz import read_spz, write_spz
from vg2gt.types import Gaussians

READERS = {
    ".ply": read_gaussian_ply,
    ".spz": read_spz,
    ".glb": read_gaussian_gltf,
    ".gltf": read_gaussian_gltf,
}
MOST = 500_000  # Gaussians per tile


def read_gaussians(path: str | Path) -> Gaussians:
    """Reads a scene; the suffix selects one of :data:`READERS`.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if it cannot be read or the suffix is unknown.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: expected a scene of Gaussians, {', '.join(READERS)}")
    return reader(path)


def write_tiles(folder: str | Path, gaussians: Gaussians, most: int = MOST) -> Path:
    """Writes one scene's Gaussians as ``.spz`` files, one per region of space, and an index of their bounds.

    Regions are halved along their longest side until they are small enough. ``index.json`` has ``format`` (1),
    ``gaussians`` (total number), ``background`` (colour or null) and ``tiles``. Each tile has a ``file``, its number of
    ``gaussians``, and the corners ``low`` and ``high`` of the bounding box of their means, in scene units.

    Args:
        folder: output folder, created if needed.
        gaussians: Gaussians of one scene.
        most: maximum number of Gaussians per tile.
    """
    folder, tiles = Path(folder), []
    for number, rows in enumerate(_parts(gaussians.means.detach().cpu(), most)):
        name, part = f"tile-{number:04d}.spz", gaussians.select(rows.to(gaussians.means.device))
        write_spz(folder / name, part)
        low, high = torch.aminmax(part.means, dim=0)
        tiles.append({"file": name, "gaussians": len(part), "low": low.tolist(), "high": high.tolist()})
    background = None if gaussians.background is None else gaussians.background[0].tolist()
    index = {"format": 1, "gaussians": len(gaussians), "background": background, "tiles": tiles}
    write_json(folder / "index.json", index)
    return folder


def _parts(means: Tensor, most: int) -> list[Tensor]:
    """Row indices of each tile, sorted."""
    waiting, done = [torch.arange(len(means))], []
    while waiting:
        rows = waiting.pop()
        if len(rows) <= most:
            done.append(rows)
            continue
        low, high = torch.aminmax(means[rows], dim=0)
        order = means[rows, int((high - low).argmax())].argsort(stable=True)
        middle = len(rows) // 2
        waiting += [rows[order[middle:]].sort().values, rows[order[:middle]].sort().values]
    return done
