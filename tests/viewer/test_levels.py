"""Levels of detail: what the tiles hold, what a coarser level looks like, and which tiles the page draws and loads."""

import base64
import gzip
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.io.gaussian_scenes import scene
from tests.viewer.reading import read_viewer_html
from tests.viewer.test_script import run
from vg2gt.geometry.rotations import quat_to_matrix
from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians
from vg2gt.viewer import ViewerScene, levels, write_viewer_html


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles of 512 Gaussians."""
    monkeypatch.setattr(levels, "TILE", 512)
    monkeypatch.setattr("vg2gt.viewer.page.TILE", 512)
    monkeypatch.setattr(levels, "ALWAYS", 128)


def surface(count: int) -> Gaussians:
    """A textured sphere of radius 1 around (0, 0, 3), of small flat Gaussians."""
    generator = torch.Generator().manual_seed(1)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    quats = torch.cat((1 + normals[:, 2:], -normals[:, 1:2], normals[:, :1], 0 * normals[:, :1]), -1)  # from z to these
    size = 2.0 / count**0.5
    scales = torch.tensor([size, size, size / 10]) * torch.empty(count, 1).uniform_(0.7, 1.4, generator=generator)
    sh = torch.sin(6 * normals)[:, None]
    far = torch.tensor([0, 0, 3.0])
    return Gaussians(normals + far, quats, scales, torch.full((count,), 0.8), sh, torch.zeros(count).long())


def test_a_merged_gaussian_has_the_moments_of_its_four() -> None:
    four = scene(9, 1)
    found = levels.merged(four)
    assert len(found) == 3
    area = four.scales.sort(dim=1).values[:, 1:].prod(1)
    weights = (four.opacities * area).double()
    for row, part in enumerate((slice(0, 4), slice(4, 8), slice(8, 9))):
        share = weights[part] / weights[part].sum()
        mean = share @ four.means[part].double()
        spread = quat_to_matrix(four.quats[part]) * four.scales[part][:, None]
        away = four.means[part].double() - mean
        covariance = torch.einsum("n,nij->ij", share, (spread @ spread.mT).double() + away[:, :, None] * away[:, None])
        turn = quat_to_matrix(found.quats[row]) * found.scales[row]
        torch.testing.assert_close(found.means[row].double(), mean, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close((turn @ turn.T).double(), covariance, rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(found.sh[row].double(), torch.einsum("n,nkc->kc", share, four.sh[part].double()))
        kept = found.opacities[row] * found.scales[row].sort().values[1:].prod()
        assert float(kept) == pytest.approx(float(weights[part].sum()), rel=1e-3) or float(
            found.opacities[row]
        ) == pytest.approx(float(four.opacities[part].max()))


def test_coarser_levels_look_alike_from_afar() -> None:
    """A level of a quarter of the Gaussians, where one covers half a pixel: as many that cover most leave holes."""
    fine = surface(20_000)
    always, found = levels.levels_of(fine)
    assert [len(level) for level in found] == [19_872, 4_968, 1_242, 311]
    intrinsics = torch.tensor([[60.0, 0, 31.5], [0, 60.0, 31.5], [0, 0, 1]])
    cameras = Cameras(torch.eye(4).view(1, 1, 4, 4), intrinsics.view(1, 1, 3, 3), (64, 64))

    def decibels(gaussians: Gaussians) -> float:
        images = [render(each, cameras, "rasterized", geometry=False).color for each in (gaussians, fine)]
        return float(-10 * (images[0] - images[1]).square().mean().log10())

    coarse = always.joined(found[1])
    picked = fine.select((fine.opacities * fine.scales[:, 0] ** 2).topk(len(coarse)).indices.sort().values)
    assert decibels(coarse) > 30
    assert decibels(coarse) > decibels(picked) + 4


def read_tile(path: Path) -> tuple[list[Any], int]:
    """The arguments of a tile's script before its data, and the length of its unpacked data."""
    arguments = re.fullmatch(r'vg2gtTile\((\d+), (\d+), (\{.*\}), "([^"]*)"\);\n', path.read_text())
    assert arguments is not None
    level, index, header, data = arguments.groups()
    return [int(level), int(index), json.loads(header)], len(gzip.decompress(base64.b64decode(data)))


def test_tiles_hold_every_gaussian_once(tmp_path: Path) -> None:
    before = scene(3000, 2)
    page = write_viewer_html(tmp_path / "old barn.html", ViewerScene(before), levels=True)
    told = json.loads(re.search(r'id="scene">([^<]*)<', page.read_text())[1])["levels"]
    assert told["folder"] == "old barn_levels"
    assert told["total"] == 3000
    assert [len(level) for level in told["places"]] == [6, 2, 1]
    files = sorted((tmp_path / "old barn_levels").iterdir())
    assert [file.name for file in files] == [f"0-{j}.js" for j in range(6)] + ["1-0.js", "1-1.js"]
    first = read_viewer_html(page)
    assert len(first) == told["always"] + told["places"][2][0]["count"]
    for file in files:
        (level, index, header), length = read_tile(file)
        assert file.name == f"{level}-{index}.js"
        place = told["places"][level][index]
        assert header["count"] == place["count"]
        assert header["degree"] == 2
        assert length == header["count"] * (12 + 54 + 6 + 8 + 2)
    finest = sum(place["count"] for place in told["places"][0])
    assert finest + told["always"] == 3000
    together = levels.levels_of(before)
    whole = torch.cat((together[0].means, together[1][0].means)).sort(dim=0).values
    torch.testing.assert_close(whole, before.means.sort(dim=0).values, rtol=0, atol=0)
    for place, start in zip(told["places"][0], range(0, 3000, 512), strict=True):
        own = together[1][0].select(slice(start, start + 512))
        low, high = torch.tensor(place["low"]), torch.tensor(place["high"])
        outside = (own.means - own.means.clamp(low, high)).norm(dim=1) + 3 * own.scales.amax(1)
        assert float(outside.max()) <= place["reach"] * (1 + 1e-5)


def test_pages_that_need_no_tiles_and_folders_that_are_not_ours(tmp_path: Path) -> None:
    page = write_viewer_html(tmp_path / "page.html", ViewerScene(scene(500)), levels=True)
    assert "strict-dynamic" not in page.read_text().split("<script>")[0]
    assert not (tmp_path / "page_levels").exists()
    (tmp_path / "page_levels").mkdir()
    write_viewer_html(page, ViewerScene(scene(2000)), levels=True)
    write_viewer_html(page, ViewerScene(scene(1000)), levels=True)
    assert "script-src 'sha256-" in page.read_text()
    assert "' 'strict-dynamic';" in page.read_text()
    assert len(list((tmp_path / "page_levels").iterdir())) == 2
    (tmp_path / "page_levels" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="page_levels has files that are no tiles"):
        write_viewer_html(page, ViewerScene(scene(1000)), levels=True)
    assert (tmp_path / "page_levels" / "notes.txt").exists()


WALK = """
const asked = [];
document.createElement = () => ({ remove() {} });
let last;
document.head = { append: (script) => { asked.push(script.src); last = script; } };
// a floor from x = 0 to 16 at z = 5: 16 tiles of 1 unit, 4 of 4 units, one of all
const place = (low, high, size) => ({ count: 100, low: [low, 0, 5], high: [high, 1, 5], reach: 0.1, size });
const spread = (count, wide, size) => Array.from({ length: count }, (_, j) => place(j * wide, (j + 1) * wide, size));
const description = { tile: 128, always: 10, folder: "a b", version: "0", total: 1610,
  places: [spread(16, 1, 0.01), spread(4, 4, 0.03), spread(1, 16, 0.1)] };
const levels = new Levels(description, 0.1), lens = { fx: 100, fy: 100, cx: 49.5, cy: 49.5 };
levels.changed = () => {};
const axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
const at = (x, most = 1e6, z = 0) => levels.choose({ axes, center: [x, 0.5, z] }, lens, [100, 100], most);
const arrive = () => { for (const tile of [...levels.loading]) levels.done(tile); };
const count = (ranges) => ranges.reduce((sum, [a, b]) => sum + b - a, 0);
const names = () => asked.splice(0).map((src) => src.split("/")[1].slice(0, -5));
const sizes = [], files = [];
const look = (...where) => { sizes.push(count(at(...where))); files.push(names()); arrive(); };
"""


def test_the_page_draws_and_loads_what_the_view_needs() -> None:
    """The view sees 5 units of a floor of 16: around x = 2.5 the tiles 0 to 5, of the first two coarser ones."""
    answer = run(f"""{WALK}
        const first = at(2.5), path = asked[0];
        files.push(names());
        arrive();
        for (let i = 0; i < 4; i++) look(2.5);
        const few = count(at(2.5, 310)), ranges = at(2.5, 110), far = at(8, 1e6, -300), away = at(8, 1e6, 6);
        answer = {{ first, path, sizes, files, few, ranges, far, away, more: names() }};""")
    assert answer["first"] == [[0, 10], [10, 110]]  # nothing is loaded: the coarsest level
    assert answer["path"] == "a%20b/1-0.js?0"
    assert answer["files"][:2] == [["1-0", "1-1"], ["0-0", "0-1", "0-2", "0-3"]]
    assert answer["files"][2:] == [["0-4", "0-5"], [], []]
    assert answer["sizes"] == [210, 510, 610, 610]
    assert answer["few"] == 210  # within 310
    assert answer["ranges"] == [[0, 10], [10, 110]]
    assert answer["far"] == [[0, 10], [10, 110]]
    assert answer["away"] == [[0, 10]]  # behind the view
    assert answer["more"] == []


def test_tiles_that_were_not_seen_for_longest_make_room_and_missing_ones_are_told() -> None:
    answer = run(f"""{WALK}
        levels.owners = levels.owners.slice(0, 10);
        for (const x of [2.5, 2.5, 2.5, 2.5, 13.5, 13.5, 13.5, 13.5, 13.5, 13.5]) look(x);
        const kept = levels.owners.map((tile) => tile && `${{tile.k}}-${{tile.j}}`);
        at(2.5);
        const script = [...levels.loading].length;
        for (const tile of [...levels.loading].slice(0, -1)) levels.done(tile);
        last.onload();  // without a tile in it
        asked.length = 0;
        const after = count(at(2.5));
        answer = {{ sizes, kept, script, failed: levels.failed.message, after, asked }};""")
    assert answer["sizes"][3] == answer["sizes"][-1] == 610
    assert {"2-0", "1-2", "1-3", "0-11", "0-15"} <= set(answer["kept"])
    assert answer["script"] > 0
    assert answer["failed"] == "A tile in a b is damaged: run vg2gt view --levels again."
    assert answer["after"] >= 110  # what is there is drawn
    assert answer["asked"] == []
