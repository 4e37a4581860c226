"""Levels of detail of a large scene, in tiles that the page loads when it needs them.

The Gaussians that cover most are always shown. The others are sorted along a Hilbert curve, and each level merges every
four neighbours of the level before, until one tile holds the whole scene. Tile j of a level shows the same as tiles 4 j
to 4 j + 3 of the level before.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vg2gt.geometry.rotations import matrix_to_quat, quat_to_matrix
from vg2gt.io.files import whole_folder
from vg2gt.kernels.curve_codes import hilbert_codes
from vg2gt.types import Gaussians
from vg2gt.viewer.packing import pack

TILE = 2**15  # most Gaussians of a tile: whole rows of the page's textures
ALWAYS = TILE // 4  # Gaussians that are always shown: merging the largest ones would hide what is behind them
_GROUP = 4  # Gaussians that become one
_REACH = 3  # standard deviations from the mean within which a Gaussian is seen
_BITS = 21  # of the curve, per axis


def write_levels(folder: Path, gaussians: Gaussians) -> tuple[Gaussians, dict[str, Any]]:
    """Writes the tiles of one scene of more than ``TILE`` Gaussians as scripts, which a page from disk may load.

    Args:
        folder: folder of the tiles; replaced if it has nothing else in it.
        gaussians: the scene.

    Returns:
        The Gaussians to show before any tile: those that are always shown, then the coarsest level; and a description
        of the tiles for the page.

    Raises:
        ValueError: if the folder has other files.
    """
    if folder.exists() and not all(re.fullmatch(r"\d+-\d+\.js", file.name) for file in folder.iterdir()):
        raise ValueError(f"{folder} has files that are no tiles; move it away, or name another page with --html")
    always, levels = levels_of(gaussians)
    digest, places = hashlib.sha256(), []
    with whole_folder(folder) as staged:
        for number, level in enumerate(levels):
            tiles = [level.select(slice(start, start + TILE)) for start in range(0, len(level), TILE)]
            places.append([place_of(tile) for tile in tiles])
            for index, tile in enumerate(tiles if level is not levels[-1] else ()):
                header, packed = pack(tile)
                digest.update(packed)
                text = f'vg2gtTile({number}, {index}, {json.dumps(header)}, "{base64.b64encode(packed).decode()}");\n'
                (staged / f"{number}-{index}.js").write_text(text)
    description = {"tile": TILE, "always": ALWAYS, "total": len(gaussians), "places": places}
    return always.joined(levels[-1]), {**description, "folder": folder.name, "version": digest.hexdigest()[:12]}


def levels_of(gaussians: Gaussians) -> tuple[Gaussians, list[Gaussians]]:
    """Returns the Gaussians of a scene that are always shown, and the levels of detail of the others, finest first."""
    kept = torch.zeros(len(gaussians), dtype=torch.bool)
    kept[(gaussians.opacities * _area(gaussians.scales)).topk(ALWAYS).indices] = True
    rest = gaussians.select(~kept)
    low, high = rest.means.aminmax(dim=0)
    grid = (rest.means - low).double() / (high - low).max().clamp(min=1e-12) * (2**_BITS - 1)
    levels = [rest.select(hilbert_codes(grid.long(), _BITS).argsort())]
    while len(levels[-1]) > TILE - ALWAYS:
        starts = range(0, len(levels[-1]), _GROUP * TILE)  # in parts, for memory
        parts = (merged(levels[-1].select(slice(start, start + _GROUP * TILE))) for start in starts)
        levels.append(functools.reduce(Gaussians.joined, parts))
    return gaussians.select(kept), levels


def merged(gaussians: Gaussians) -> Gaussians:
    """Returns one Gaussian for every four successive ones: mean, covariance and colour of their mixture.

    They are weighted by opacity times area, and the opacity keeps the sum of these weights up to the largest opacity of
    the four, after Kerbl et al., A Hierarchical 3D Gaussian Representation (2024).
    """
    groups = -(-len(gaussians) // _GROUP)
    places = torch.arange(groups * _GROUP)
    rows = places.clamp(max=len(gaussians) - 1)
    part, shape = gaussians.select(rows), (groups, _GROUP)
    weights = torch.where(places == rows, part.opacities.clamp(min=1e-6) * _area(part.scales), 0).view(shape)
    shares = weights / weights.sum(1, keepdim=True)
    means = part.means.unflatten(0, shape)
    mean = (shares[..., None] * means).sum(1)
    axes = (quat_to_matrix(part.quats) * part.scales[:, None]).unflatten(0, shape)
    offsets = torch.cat((axes, (means - mean[:, None])[..., None]), -1) * shares.sqrt()[..., None, None]
    offsets = offsets.transpose(1, 2).flatten(2)  # [M, 3, 16]: the covariance is the sum of their outer products
    variances, turn = torch.linalg.eigh((offsets @ offsets.mT).double())
    turn = turn * torch.linalg.det(turn).sign()[:, None, None]  # eigenvectors may be a reflection
    scales = variances.clamp(min=1e-20).sqrt().float()
    opacities = (weights.sum(1) / _area(scales)).minimum(part.opacities.view(shape).amax(1))
    sh = (shares[..., None, None] * part.sh.unflatten(0, shape)).sum(1)
    batch = gaussians.batch[:groups]
    return Gaussians(mean, matrix_to_quat(turn).float(), scales, opacities, sh, batch, gaussians.background)


def place_of(tile: Gaussians) -> dict[str, Any]:
    """Returns where a tile is and how fine it is.

    Returns:
        ``count``; ``low`` and ``high``: corners of the box of the middle 98 % of the means; ``reach``: how far from it
        Gaussians are seen; ``size``: median extent of the Gaussians. Scene units.
    """
    low, high = torch.quantile(tile.means, torch.tensor([0.01, 0.99]), dim=0)
    outside = (tile.means - tile.means.clamp(low, high)).norm(dim=1)
    reach = float((outside + _REACH * tile.scales.amax(1)).max())
    size = float(_area(tile.scales).sqrt().median())
    return {"count": len(tile), "low": low.tolist(), "high": high.tolist(), "reach": reach, "size": size}


def _area(scales: Tensor) -> Tensor:
    """Returns the product of the two larger standard deviations: the area seen along the shortest axis, over pi."""
    return scales.prod(1) / scales.amin(1)
