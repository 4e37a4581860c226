"""The page in headless Chromium, against our own renderer."""

import io
import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.viewer.test_page import HOSTILE, pictured_scene
from vg2gt.io import named_cameras
from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians
from vg2gt.viewer import ViewerScene, write_viewer_html

pytestmark = pytest.mark.slow

CLEAN = "#ui=off"
CLOSE = 55.0  # dB; rounding to 8 bits alone is 59
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--force-color-profile=srgb"]


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    tools = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    with tools.sync_playwright() as started:
        made = started.chromium.launch(executable_path=program, args=FLAGS).new_page()
        made.set_default_timeout(240e3)  # software rendering on a busy machine is slow
        yield made


def show(page: Any, path: Path, scene: ViewerScene, size: tuple[int, int], fragment: str = CLEAN, levels=False) -> None:
    """Opens a scene's page in a window of ``(height, width)`` pixels and waits until it is drawn."""
    page.set_viewport_size({"width": size[1], "height": size[0]})
    page.goto(write_viewer_html(path, scene, levels).as_uri() + fragment)
    page.evaluate("vg2gtViewer.ready.then(() => null)")


def ball_before_a_wall() -> ViewerScene:
    """A red ball of radius 0.5 at depth 4, and a larger grey wall of more Gaussians at depth 12; no cameras."""
    generator = torch.Generator().manual_seed(3)
    ball = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator), dim=-1) * 0.5
    wall = (torch.rand(1500, 3, generator=generator) - 0.5) * torch.tensor([40.0, 40.0, 0.1])
    means = torch.cat((ball + torch.tensor([0, 0, 4.0]), wall + torch.tensor([0, 0, 12.0])))
    red, grey = torch.tensor([2.2, -1.6, -1.6]).expand(400, 1, 3), torch.zeros(1500, 1, 3)
    scales = torch.cat((torch.full((400, 3), 0.06), torch.full((1500, 3), 0.6)))
    quats, one = torch.tensor([1.0, 0, 0, 0]).expand(1900, 4), torch.full((1900,), 0.95)
    return ViewerScene(Gaussians(means, quats, scales, one, torch.cat((red, grey)), torch.zeros(1900).long()))


def screenshot(page: Any) -> np.ndarray:
    """``[H, W, 3]`` uint8."""
    return np.array(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def psnr(image: np.ndarray, truth: torch.Tensor) -> float:
    """Of a screenshot against an image ``[3, H, W]``, in dB."""
    error = torch.from_numpy(image).permute(2, 0, 1) / 255 - truth.clamp(0, 1)
    return -10 * math.log10(float(error.square().mean()))


def compare(page: Any, path: Path, gaussians: Gaussians, cameras: Cameras, antialiased: bool = False) -> list[float]:
    """PSNR of every view."""
    records = named_cameras(cameras, [str(index) for index in range(cameras.intrinsics.shape[1])])
    show(page, path, ViewerScene(gaussians, records, antialiased=antialiased), cameras.size)
    truth = render(gaussians, cameras, "rasterized", geometry=False, antialiased=antialiased).color[0]
    figures = []
    for index in range(len(records)):
        page.evaluate(f"vg2gtViewer.setCamera({index}).then(() => null)")
        figures.append(psnr(screenshot(page), truth[index]))
    return figures


@pytest.mark.parametrize(("size", "count"), [((240, 320), 25_000), ((480, 640), 140_000)])
def test_screenshot_is_our_rasterized_image_of_a_room(page, tmp_path, size, count, benchmark_script):
    room = benchmark_script("render")
    gaussians, cameras = room.room_gaussians(count, size, sigma=2.0), room.room_cameras(12, size)
    path = tmp_path / f"room-{len(gaussians)}.html"
    figures = compare(page, path, gaussians, cameras.select(slice(0, 12, 4)))
    seconds = page.evaluate("vg2gtViewer.loadSeconds")
    megabytes = path.stat().st_size / 1e6
    print(f"{len(gaussians)} Gaussians, {megabytes:.2f} MB, loaded in {seconds:.2f} s, PSNR {figures}")
    assert min(figures) > CLOSE


def test_opacities_are_compensated_where_the_scene_says_so(page, tmp_path, benchmark_script):
    room = benchmark_script("render")
    size = (240, 320)
    gaussians, cameras = room.room_gaussians(25_000, size, sigma=0.5), room.room_cameras(12, size).select(slice(0, 1))
    plain, compensated = (render(gaussians, cameras, "rasterized", antialiased=on).color for on in (False, True))
    assert (plain - compensated).abs().mean() > 0.01
    assert min(compare(page, tmp_path / "room.html", gaussians, cameras, antialiased=True)) > CLOSE


def test_controls_move_the_view_and_reset_brings_it_back(page: Any, tmp_path: Path) -> None:
    show(page, tmp_path / "page.html", pictured_scene(), (400, 700), "")
    before = screenshot(page)

    def drag(button: str) -> None:
        page.mouse.move(500, 200)
        page.mouse.down(button=button)
        page.mouse.move(560, 230)
        page.mouse.up(button=button)

    actions = {
        "turn": lambda: drag("left"),
        "move": lambda: drag("right"),
        "wheel": lambda: page.mouse.wheel(0, 240),
        "fly": lambda: page.keyboard.press("w", delay=300),
        "arrow": lambda: page.keyboard.press("ArrowLeft", delay=300),
    }
    for name, action in actions.items():
        action()
        page.wait_for_timeout(700)
        assert (screenshot(page) != before).any(-1).mean() > 0.02, name
        page.evaluate("document.getElementById('reset').click()")
        page.wait_for_timeout(700)
        assert (screenshot(page) == before).all(), name


def red_share(page: Any, mid: tuple[float, float] = (0.5, 0.5)) -> tuple[float, float]:
    """Share of the page's pixels that show the ball, and the distance of their middle from ``mid``, in page sizes."""
    image = screenshot(page).astype(float)
    red = (image[..., 0] > 120) & (image[..., 0] > 2 * image[..., 2])
    places = np.argwhere(red) / red.shape
    return float(red.mean()), float(np.abs(places.mean(0) - mid).max()) if len(places) else 1.0


@pytest.mark.parametrize("fragment", ["", "#fly=on"])
@pytest.mark.parametrize("phone", [False, True])
def test_drag_of_100_pixels_keeps_the_object_in_view(page: Any, tmp_path: Path, phone: bool, fragment: str) -> None:
    """Flying, the same drag looks away from it: the page opened so, and the test sees the difference."""
    size = (844, 390) if phone else (600, 900)
    context = page.context.browser.new_context(
        viewport={"height": size[0], "width": size[1]}, is_mobile=phone, has_touch=phone
    )
    opened = context.new_page()
    opened.set_default_timeout(240e3)
    show(opened, tmp_path / "page.html", ball_before_a_wall(), size, fragment)
    before, off = red_share(opened)
    assert before > 0.01
    assert off < 0.02
    if phone:
        touch = context.new_cdp_session(opened)
        for kind, x in [("touchStart", 150), *(("touchMove", x) for x in range(160, 251, 10)), ("touchEnd", None)]:
            points = [] if x is None else [{"x": x, "y": 600}]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    else:
        opened.mouse.move(500, 400)
        opened.mouse.down()
        opened.mouse.move(600, 400, steps=10)
        opened.mouse.up()
    opened.evaluate("new Promise((done) => setTimeout(done, 500))")
    after, moved = red_share(opened)
    context.close()
    if fragment:
        assert moved > 0.3
    else:
        assert after == pytest.approx(before, rel=0.2)
        assert moved < 0.05


def test_page_fetches_nothing_and_hostile_names_do_nothing(page: Any, tmp_path: Path) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    show(page, tmp_path / "page.html", pictured_scene(HOSTILE), (400, 700), "")
    assert not [address for address in asked if not address.startswith(("file:", "blob:"))]
    assert [worker.url for worker in page.workers if worker.url.startswith("blob:")]  # the sorting worker is let in
    assert page.evaluate("document.title") == HOSTILE
    assert page.evaluate("document.getElementById('cameras').options[1].text.startsWith('</script><script>')")
    # the policy stops what a hole in the escaping would let in
    page.evaluate("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hole = 1\">')")
    page.evaluate(
        "{const s = document.createElement('script'); s.textContent = 'window.hole = 2'; document.body.append(s);}"
    )
    assert page.evaluate("fetch('data:,x').then(() => 'fetched', () => 'refused')") == "refused"
    assert page.evaluate("window.hole") is None


def test_tiles_that_are_in_view_are_loaded_and_drawn(page, tmp_path, monkeypatch, benchmark_script) -> None:
    """What is seen is the whole scene's image, from disk; without the folder the page says so and shows little."""
    monkeypatch.setattr("vg2gt.viewer.levels.TILE", 4096)
    monkeypatch.setattr("vg2gt.viewer.levels.ALWAYS", 1024)
    monkeypatch.setattr("vg2gt.viewer.page.TILE", 4096)
    room, size = benchmark_script("render"), (120, 160)
    near, cameras = room.room_gaussians(30_000, size, sigma=2.0), room.room_cameras(12, size)
    gaussians = near.joined(replace(near, means=near.means + 50))  # another room, not in the first view
    view = cameras.select(slice(0, 1))
    scene = ViewerScene(gaussians, named_cameras(view, ["0"]))
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    show(page, tmp_path / "room.html", scene, size, levels=True)
    image, drawn = screenshot(page), page.evaluate("vg2gtViewer.drawn()")
    truth = render(gaussians, view, "rasterized", geometry=False).color[0, 0]
    tiles = {address for address in asked if "room_levels/" in address}
    assert psnr(image, truth) > CLOSE
    assert all(address.startswith(("file:", "blob:")) for address in asked)
    assert 4 < len(tiles) < len(list((tmp_path / "room_levels").iterdir()))
    assert drawn < 0.6 * len(gaussians)
    shutil.rmtree(tmp_path / "room_levels")
    page.reload()
    page.evaluate("vg2gtViewer.ready.then(() => null)")
    assert "room_levels of tiles is not next to the page" in page.evaluate(
        "document.getElementById('status').textContent"
    )
    assert 1024 < page.evaluate("vg2gtViewer.drawn()") <= 4096
