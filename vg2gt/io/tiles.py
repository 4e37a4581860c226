"""A large scene as tiles for viewers: a file a region of space, and ``index.json``, which says where each is.

``index.json`` has ``format`` (1), ``gaussians`` (number of all), ``background`` (colour or null) and ``tiles``: of each
its ``file``, number of ``gaussians`` and the corners ``low`` and ``high`` of the box around their means, scene units.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from vg2gt.io.errors import FormatError
from vg2gt.io.files import read_json, write_json
from vg2gt.io.gaussian_files import read_gaussians, write_gaussians
from vg2gt.types import Gaussians

MOST = 500_000  # Gaussians of a tile
INDEX = "index.json"
_FORMAT = 1


def write_tiles(folder: str | Path, gaussians: Gaussians, suffix: str = ".spz", most: int = MOST) -> Path:
    """Writes one scene's Gaussians as tiles; space is halved along its longest side until no part has too many.

    Args:
        folder: made if it is not there.
        gaussians: of one scene.
        suffix: of the files: any format of :func:`vg2gt.io.write_gaussians`.
        most: Gaussians of a tile, at most.
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
    """All tiles of a folder that :func:`write_tiles` wrote, as one scene.

    Raises:
        FormatError: if a tile does not hold what the index says.
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
    """Sorted rows of every tile."""
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
