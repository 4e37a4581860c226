"""A large scene as tiles for viewers: one file per region of space, and ``index.json`` with their bounds.

``index.json`` has ``format`` (1), ``gaussians`` (total number), ``background`` (colour or null) and ``tiles``. Each
tile has a ``file``, its number of ``gaussians``, and the corners ``low`` and ``high`` of the bounding box of their
means, in scene units.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json, write_json
from vg2gt.io.gaussian_files import read_gaussians, write_gaussians
from vg2gt.types import Gaussians

MOST = 500_000  # Gaussians per tile
INDEX = "index.json"
_FORMAT = 1


def write_tiles(folder: str | Path, gaussians: Gaussians, suffix: str = ".spz", most: int = MOST) -> Path:
    """Writes one scene's Gaussians as tiles; regions are halved along their longest side until they are small enough.

    Args:
        folder: output folder, created if needed.
        gaussians: Gaussians of one scene.
        suffix: suffix of the files: any format of :func:`vg2gt.io.write_gaussians`.
        most: maximum number of Gaussians per tile.
    """
    folder, tiles = Path(folder), []
    for number, rows in enumerate(_parts(gaussians.means.detach().cpu(), most)):
        name, part = f"tile-{number:04d}{suffix}", gaussians.select(rows.to(gaussians.means.device))
        write_gaussians(folder / name, part)
        low, high = torch.aminmax(part.means, dim=0)
        tiles.append({"file": name, "gaussians": len(part), "low": low.tolist(), "high": high.tolist()})
    background = None if gaussians.background is None else gaussians.background[0].tolist()
    index = {"format": _FORMAT, "gaussians": len(gaussians), "background": background, "tiles": tiles}
    write_json(folder / INDEX, index)
    return folder


def read_tiles(folder: str | Path) -> Gaussians:
    """Reads all tiles in a folder of :func:`write_tiles` as one scene.

    Raises:
        FormatError: if a tile's number of Gaussians differs from the index.
    """
    folder, found = Path(folder), []
    index = read_json(folder / INDEX)
    for tile in index["tiles"]:
        found.append(read_gaussians(folder / tile["file"]))
        if len(found[-1]) != tile["gaussians"]:
            raise FormatError(f"{folder / tile['file']} has {len(found[-1])} Gaussians, not {tile['gaussians']}")
    joined = found[0]
    for part in found[1:]:
        joined = joined.joined(part)
    return joined


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
