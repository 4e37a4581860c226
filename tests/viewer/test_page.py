"""The self-contained page: what is in it, that it needs nothing else, that names in it stay names."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.io.gaussian_scenes import scene, views
from tests.viewer.reading import read_viewer_html
from vg2gt.io import named_cameras
from vg2gt.rendering import render
from vg2gt.viewer import ViewerScene, load_pictures, write_viewer_html

HOSTILE = "</script><script>alert(1)</script><!-- {{script}} \"'&\u2028 \\u003c"


class Elements(HTMLParser):
    """Opening tags with attributes and the text of scripts, as a browser's parser finds them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {"script": [], "title": [], "style": []}
        self._inside = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside in self.texts:
            self.texts[self._inside].append(data)


def pictured_scene(name: str = "view") -> ViewerScene:
    cameras = named_cameras(views(), [f"{name} {index}" for index in range(3)])
    return ViewerScene(scene(100, 3), cameras, [np.full((4, 6, 3), 90, np.uint8), None, None], title=name)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_page_holds_the_gaussians(tmp_path: Path, degree: int) -> None:
    before = scene(300, degree)
    after = read_viewer_html(write_viewer_html(tmp_path / "page.html", ViewerScene(before)))
    unit = torch.nn.functional.normalize(before.quats, dim=-1)
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=0)
    torch.testing.assert_close(after.quats, unit, rtol=0, atol=2e-5)
    torch.testing.assert_close(after.scales, before.scales, rtol=1e-4, atol=0)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=0, atol=1e-5)
    torch.testing.assert_close(after.sh, before.sh, rtol=1e-3, atol=1e-6)
    images = [render(gaussians, views(), "rasterized").color for gaussians in (before, after)]
    assert (images[0] - images[1]).abs().max() < 2e-3


@pytest.mark.parametrize(("behind", "shown"), [(None, [0, 0, 0]), (torch.tensor([[0.25, 0.5, 1.0]]), [0.25, 0.5, 1])])
def test_page_knows_the_colour_behind_the_scene(tmp_path, behind, shown):
    gaussians = replace(scene(20, 0), background=behind)
    page = write_viewer_html(tmp_path / "page.html", ViewerScene(gaussians, near=0.00125)).read_text()
    assert '"near": 0.00125' in page
    assert json.loads(re.search(r'id="scene">([^<]*)<', page)[1])["settings"]["background"] == shown
    assert "clearColor(...this.settings.background, 1)" in page


def test_policy_allows_this_script_only(tmp_path: Path) -> None:
    elements = Elements(write_viewer_html(tmp_path / "page.html", pictured_scene()).read_text())
    (policy,) = [attributes["content"] or "" for _, attributes in elements.tags if "http-equiv" in attributes]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert "connect-src" not in rules
    for kind in ("script", "style"):
        digest = hashlib.sha256(elements.texts[kind][-1].encode()).digest()
        assert f"'sha256-{base64.b64encode(digest).decode()}'" in rules[f"{kind}-src"]
        assert "unsafe" not in rules[f"{kind}-src"]


def test_hostile_names_stay_names(tmp_path: Path) -> None:
    calm = Elements(write_viewer_html(tmp_path / "calm.html", pictured_scene()).read_text())
    page = write_viewer_html(tmp_path / "hostile.html", pictured_scene(HOSTILE)).read_text()
    elements = Elements(page)
    assert [tag for tag, _ in elements.tags] == [tag for tag, _ in calm.tags]
    assert elements.texts["script"][-1] == calm.texts["script"][-1]
    assert "".join(elements.texts["title"]) == HOSTILE
    assert "alert(1)</script>" not in page
    assert len(read_viewer_html(tmp_path / "hostile.html")) == 100


def test_pictures_are_found_inside_their_folder_only(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    picture = Image.new("RGB", (800, 400), (200, 30, 30))
    turned = picture.getexif()
    turned[0x0112] = 6
    picture.save(folder / "a.jpg", exif=turned)
    for place in (tmp_path / "secret.png", folder / "b.png"):
        picture.save(place)
    (record,) = named_cameras(views().select(slice(0, 1)), ["a.jpg"])
    names = ["a.jpg", "b.png", "../secret.png", str(tmp_path / "secret.png"), "absent.png", "."]
    pictures = load_pictures([replace(record, name=name) for name in names], folder)
    assert [picture.shape for picture in pictures[:2]] == [(320, 160, 3), (160, 320, 3)]
    assert pictures[2:] == [None] * 4
    (folder / "b.png").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"cannot read .*b\.png"):
        load_pictures([replace(record, name="b.png")], folder)
