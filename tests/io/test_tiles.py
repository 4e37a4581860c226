"""A scene as tiles."""

import json
from dataclasses import replace

import pytest
import torch

from tests.io.gaussian_scenes import scene
from vg2gt.io.tiles import read_tiles, write_tiles


def test_tiles_hold_every_gaussian_once_and_say_where(tmp_path) -> None:
    means = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([8.0, 2.0, 3.0])
    whole = replace(scene(1000), means=means)
    write_tiles(tmp_path, whole, ".ply", most=130)
    index = json.loads((tmp_path / "index.json").read_text())
    assert index["gaussians"] == 1000 == sum(tile["gaussians"] for tile in index["tiles"])
    assert len(index["tiles"]) == 8
    assert all(tile["gaussians"] <= 130 for tile in index["tiles"])
    boxes = torch.tensor([[tile["low"], tile["high"]] for tile in index["tiles"]])
    volume = (boxes[:, 1] - boxes[:, 0]).prod(1).sum()
    assert volume <= 8 * 2 * 3  # they hardly overlap
    back = read_tiles(tmp_path)
    order, other = whole.means[:, 0].argsort(), back.means[:, 0].argsort()
    torch.testing.assert_close(back.means[other], whole.means[order])
    torch.testing.assert_close(back.opacities[other], whole.opacities[order])


def test_a_tile_that_is_not_what_the_index_says_is_refused(tmp_path) -> None:
    write_tiles(tmp_path, scene(40), most=20)
    (tmp_path / "tile-0000.spz").write_bytes((tmp_path / "tile-0001.spz").read_bytes())
    index = json.loads((tmp_path / "index.json").read_text())
    index["tiles"][0]["gaussians"] += 1
    (tmp_path / "index.json").write_text(json.dumps(index))
    with pytest.raises(ValueError, match="tile-0000"):
        read_tiles(tmp_path)
