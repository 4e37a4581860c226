"""The page in headless Chromium, against our own renderer."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.viewer.chromium import Page, chromium
from tests.viewer.test_page import HOSTILE, pictured_scene
from vg2gt.io import named_cameras
from vg2gt.rendering import render
from vg2gt.types import Cameras, Gaussians
from vg2gt.viewer import ViewerScene, write_viewer_html

pytestmark = pytest.mark.slow

CLEAN = "#ui=off"
CLOSE = 55.0  # dB; rounding to 8 bits alone is 59


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with chromium(tmp_path_factory.mktemp("profile")) as tab:
        yield tab


def show(page: Page, path: Path, scene: ViewerScene, size: tuple[int, int], fragment: str = CLEAN) -> None:
    """Opens a scene's page in a window of ``(height, width)`` pixels and waits until it is drawn."""
    address = write_viewer_html(path, scene).as_uri()
    page.open(address + fragment, size[1], size[0])
    page.run("vg2gtViewer.ready.then(() => null)")


def psnr(image: np.ndarray, truth: torch.Tensor) -> float:
    """Of a screenshot against an image ``[3, H, W]``, in dB."""
    error = torch.from_numpy(image).permute(2, 0, 1) / 255 - truth.clamp(0, 1)
    return -10 * math.log10(float(error.square().mean()))


def compare(page: Page, path: Path, gaussians: Gaussians, cameras: Cameras) -> list[float]:
    """PSNR of every view."""
    records = named_cameras(cameras, [str(index) for index in range(cameras.intrinsics.shape[1])])
    show(page, path, ViewerScene(gaussians, records), cameras.size)
    truth = render(gaussians, cameras, "rasterized", geometry=False).color[0]
    figures = []
    for index in range(len(records)):
        page.run(f"vg2gtViewer.setCamera({index}).then(() => null)")
        figures.append(psnr(page.screenshot(), truth[index]))
    return figures


@pytest.mark.parametrize(("size", "count"), [((240, 320), 25_000), ((480, 640), 140_000)])
def test_screenshot_is_our_rasterized_image_of_a_room(page, tmp_path, size, count, benchmark_script):
    room = benchmark_script("render")
    gaussians, cameras = room.room_gaussians(count, size, sigma=2.0), room.room_cameras(12, size)
    path = tmp_path / f"room-{len(gaussians)}.html"
    figures = compare(page, path, gaussians, cameras.select(slice(0, 12, 4)))
    seconds = page.run("vg2gtViewer.loadSeconds")
    megabytes = path.stat().st_size / 1e6
    print(f"{len(gaussians)} Gaussians, {megabytes:.2f} MB, loaded in {seconds:.2f} s, PSNR {figures}")
    assert min(figures) > CLOSE


def test_controls_move_the_view_and_reset_brings_it_back(page: Page, tmp_path: Path) -> None:
    show(page, tmp_path / "page.html", pictured_scene(), (400, 700), "")
    before = page.screenshot()

    def drag(button: str, buttons: int) -> None:
        common = {"button": button, "buttons": buttons, "clickCount": 1}
        page.call("Input.dispatchMouseEvent", type="mousePressed", x=500, y=200, **common)
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=560, y=230, **common)
        page.call("Input.dispatchMouseEvent", type="mouseReleased", x=560, y=230, **common)

    def key(name: str) -> None:
        page.call("Input.dispatchKeyEvent", type="keyDown", key=name)
        page.run("new Promise((resolve) => setTimeout(resolve, 300))")
        page.call("Input.dispatchKeyEvent", type="keyUp", key=name)

    actions = {
        "turn": lambda: drag("left", 1),
        "move": lambda: drag("right", 2),
        "wheel": lambda: page.call("Input.dispatchMouseEvent", type="mouseWheel", x=500, y=200, deltaX=0, deltaY=240),
        "fly": lambda: key("w"),
        "arrow": lambda: key("ArrowLeft"),
    }
    settle = "new Promise((resolve) => setTimeout(resolve, 700))"
    for name, action in actions.items():
        action()
        page.run(settle)
        assert (page.screenshot() != before).any(-1).mean() > 0.02, name
        page.run("document.getElementById('reset').click()")
        page.run(settle)
        assert (page.screenshot() == before).all(), name


def test_page_fetches_nothing_and_hostile_names_do_nothing(page: Page, tmp_path: Path) -> None:
    show(page, tmp_path / "page.html", pictured_scene(HOSTILE), (400, 700), "")
    assert [address for address in page.requests if address.startswith("blob:")]  # the sorting worker is let in
    assert [address for address in page.requests if not address.startswith(("file:", "blob:"))] == []
    assert page.run("document.title") == HOSTILE
    assert page.run("document.getElementById('cameras').options[1].text.startsWith('</script><script>')")
    # the policy stops what a hole in the escaping would let in
    page.run("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hole = 1\">')")
    page.run(
        "{const s = document.createElement('script'); s.textContent = 'window.hole = 2'; document.body.append(s);}"
    )
    assert page.run("fetch('data:,x').then(() => 'fetched', () => 'refused')") == "refused"
    assert page.run("window.hole") is None
