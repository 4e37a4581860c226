"""The page's script without a browser: node runs its parts. ``test_browser.py`` (slow) drives the whole page."""

import json
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest
import torch

from tests.viewer.test_browser import ball_before_a_wall
from vg2gt.viewer.page import SCRIPTS, STATIC

# what main.js needs of a browser to wire the boxes: elements that remember what is set, and an address
DOM = """
const made = {}, listens = { addEventListener() {} };
const stub = () => ({ ...listens, classList: { toggle() {} }, append() {}, textContent: "", checked: false });
globalThis.document = { getElementById: (id) => (made[id] ??= stub()) };
globalThis.window = listens;
globalThis.location = { hash: "" };
globalThis.ResizeObserver = class { observe() {} };
globalThis.Option = class {};
"""


STARTED = """
const count = 200000, means = new Float32Array(3 * count), geometry = new Float32Array(12 * count), drawn = [];
for (let i = 0; i < count; i++) {
  means[3 * i + 2] = 5;
  geometry.set([0, 0, 5, 1, 1, 0, 0, 0, 1 + i / count, 1, 1, 0], 12 * i);
}
inflate = async () => null;
decodeGaussians = () => ({ means, harmonics: null, geometry });
Renderer = class {
  allocate() {} put() {} setFrusta() {} resize() {} draw() {}
  setOrder(order) { drawn.push(order.length); }
};
let move;
connect = ({ changed, setCamera }) => { move = changed; return setCamera; };
connectTools = () => {};
pivotDepth = () => 1;
for (const id of ["view", "cameras", "scene", "gaussians"]) element(id).remove = () => {};
made.scene.textContent = JSON.stringify({
  gaussians: { degree: 0, count }, settings: { near: 0.1 }, cameras: [], frustum_depth: 1, initial: RECORD,
});
made.view.clientWidth = made.view.clientHeight = 10;
window.devicePixelRatio = 1;
globalThis.requestAnimationFrame = (action) => setTimeout(action, 100);  // a slow device
const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
(async () => {
  await start();
  for (let i = 0; i < 10; i++) { move(); await wait(50); }
  const least = Math.min(...drawn);
  for (let i = 0; i < 100 && drawn.at(-1) < count; i++) await wait(100);
  console.log(JSON.stringify([drawn[0], least, drawn.at(-1)]));
  process.exit();
})();
"""


def run(code: str, answers: bool = True) -> Any:
    """Runs code after the page's scripts, and returns the JSON that its ``answer`` is, or that it prints."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node: apt-get install nodejs")
    script = "\n".join((STATIC / name).read_text() for name in SCRIPTS)
    program = f"{DOM}{script}\nlet answer;\n{code}\n{'console.log(JSON.stringify(answer));' * answers}"
    done = subprocess.run([node, "-"], input=program, capture_output=True, text=True, timeout=60, check=False)
    assert not done.returncode, done.stderr
    return json.loads(done.stdout)


OPENED = """
const show = {}, scene = { gaussians: { count: 5 }, cameras: [{ name: "a" }, { name: "b" }] };
const keep = { canvas: { ...stub(), tabIndex: 0 }, view: {}, changed() {}, show, records: scene.cameras, scene };
answer = [HASHES].map((hash) => {
  location.hash = hash;
  let seen = null;
  const follow = connect({ ...keep, pictures: [{}], resized() {}, setCamera(camera) { seen = camera; } });
  follow(0);
  const boxes = ["show-cameras", "show-images", "fly"].map((id) => made[id].checked);
  return [boxes, seen, made.panel.hidden, made.status.textContent];
});
"""


def test_address_and_boxes() -> None:
    """The page opens without a ticked box: Fly was on, and a drag threw the scene out of view."""
    none, counts = [False] * 3, "5 Gaussians, 2 cameras"
    wanted = {
        "": (none, 0, False, counts),
        "#show=": (none, 0, False, counts),
        "#fly=off&ui=on": (none, 0, False, counts),
        "#fly=on": ([False, False, True], 0, False, counts),
        "#camera=1&show=images&ui=off": ([False, True, False], 1, True, counts),
        "#show=cameras,images": ([True, True, False], 0, False, counts),
        "#camera=2": (none, 0, False, "camera=2;"),
        "#camera=1x": (none, 0, False, "camera=1x;"),
        "#camera=-1&show=fly": (none, 0, False, "camera=-1 and show=fly;"),
        "#fly=yes&turn=on&ui=of": (none, 0, False, "fly=yes and turn=on and ui=of;"),
    }
    for (hash_, (boxes, camera, hidden, said)), found in zip(
        wanted.items(), run(OPENED.replace("HASHES", json.dumps(list(wanted))[1:-1])), strict=True
    ):
        assert found[:3] == [boxes, camera, hidden], hash_
        known = "camera=0 to camera=1, show=cameras,images, fly=on and ui=off."
        refused = f"The page's address has {said} it takes {known}"
        assert found[3] == (said if said == counts else refused), hash_


def test_dragging_turns_around_what_the_middle_shows() -> None:
    """100 px on a page of 900 x 600: the ball's middle stays where it was, the wall behind it does not count."""
    scene = ball_before_a_wall()
    gaussians, record = scene.gaussians, scene.initial().fields()
    geometry = torch.cat(
        (gaussians.means, gaussians.opacities[:, None], gaussians.quats, gaussians.scales, gaussians.means * 0), -1
    )[:, :12]
    page = {"settings": {"near": 0.01, "lowpass": 0.3}, "frustum_depth": 1}
    pivot, *places = run(f"""
        const canvas = {{ ...stub(), clientWidth: 900, clientHeight: 600, setPointerCapture() {{}} }}, on = {{}};
        canvas.addEventListener = (name, action) => {{ on[name] = action; }};
        const view = new View([0, -1, 0]), controls = new Controls(canvas, view, () => {{}}, {{}});
        const where = () => {{
          const local = view.axes.map((axis) => dot(axis, addScaled([0, 0, 4], view.center, -1)));
          return [local[0] / local[2], local[1] / local[2], local[2]];
        }};
        view.set(fromRecord({json.dumps(record)}));
        view.pivot = pivotDepth(view, new Float32Array({geometry.flatten().tolist()}), {json.dumps(page)});
        answer = [view.pivot];
        for (const [dx, dy] of [[100, 0], [-200, 0], [100, 100]]) {{
          const event = {{ pointerId: 1, buttons: 1, clientX: 400, clientY: 300 }};
          on.pointerdown(event);
          on.pointermove({{ ...event, clientX: 400 + dx, clientY: 300 + dy }});
          on.pointerup(event);
          answer.push(where());
        }}""")
    assert pivot == pytest.approx(3.5, abs=0.3)  # the ball's near side
    for x, y, depth in places:
        assert abs(x) < 0.1
        assert abs(y) < 0.1
        assert depth == pytest.approx(4, abs=0.3)


def test_measuring_cropping_and_views_to_keep() -> None:
    """What is measured is what vg2gt place takes; a kept view is a camera of ours; a crop hides what is outside it."""
    record = ball_before_a_wall().initial().fields()
    answer = run(f"""
        const view = new View([0, -1, 0]);
        view.set(fromRecord({json.dumps(record)}));
        const back = toRecord("view-0", view), means = new Float32Array([0, 0, 1, 0, 0, 2, 3, 0, 3, 0, 0, 4]);
        const order = (box) => [...makeDepthSorter(means)([0, 0, 1, 0], 0.1, box)];
        view.level([1, 0, 0]);
        answer = {{
          text: measured([[0, 0, 1], [0.3, 0.4, 1]], null), metres: measured([[0, 0, 1], [0.3, 0.4, 1]], 2.4),
          whole: cropBox([0, 200, 0, 200, 0, 200], [[0, 1], [0, 1], [0, 1]]),
          half: cropBox([0, 100, 0, 200, 50, 200], [[0, 1], [0, 1], [0, 8]]).map((v) => Number.isFinite(v) ? v : null),
          orders: [order(null), order([-1, -1, 1.5, 1, 1, 9])], back, axes: view.axes,
        }};""")
    assert answer["text"] == "0.5 scene units. To set the scale: vg2gt place DIR --scale=0,0,1,0.3,0.4,1=LENGTHm"
    assert answer["metres"].startswith("1.2 m.")
    assert answer["whole"] is None
    assert answer["half"] == [None, None, 2, 0.5, None, None]
    assert answer["orders"] == [[3, 2, 1, 0], [3, 1]]
    for field in ("width", "height", "intrinsics", "world_to_camera"):
        assert np.allclose(answer["back"][field], record[field])
    assert np.allclose(answer["axes"][1], [-1, 0, 0])  # down; the camera looks along z


def test_fewer_gaussians_are_drawn_while_a_large_scene_moves() -> None:
    """Slow frames halve them at most, fast ones bring them back; those that cover most are kept, in their order."""
    answer = run("""
        const count = 200000, geometry = new Float32Array(12 * count), means = new Float32Array(3 * count);
        for (let i = 0; i < count; i++) {
          geometry.set([0, 0, 1 + i / count, i % 2 ? 0.5 : 1, 1, 0, 0, 0, 0.001, 1 + i % 4, 1, 0], 12 * i);
          means[3 * i + 2] = 1 + i / count;
        }
        const weights = weightsOf(geometry), detail = new Detail(weights), seen = [detail.least()];
        const sort = makeDepthSorter(means, weights), shown = [];
        for (const duration of [66, 10, 100, 1000, 1000]) {
          detail.adapt(duration);
          shown.push(detail.most);
          seen.push(sort([0, 0, 1, 0], 0.1, null, detail.least()).length);
        }
        const kept = [...sort([0, 0, 1, 0], 0.1, null, detail.least())];
        for (let i = 0; i < 20; i++) detail.adapt(16);
        const sorted = kept.every((value, k) => !k || value < kept[k - 1]);
        const kinds = [...new Set(kept.map((i) => i % 4))], first = [...weights.slice(0, 4)];
        answer = { seen, shown, sorted, all: detail.least(), kinds, first };
        """)
    assert answer["first"] == [1, 1, 3, 2]
    assert answer["shown"] == pytest.approx([100_000, 110_000, 55_000, 50_000, 50_000])
    assert answer["seen"] == [0, 100_000, 200_000, 100_000, 50_000, 50_000]  # equal weights stay together
    assert answer["kinds"] == [2]
    assert answer["sorted"]
    assert answer["all"] == 0


def test_what_was_left_out_is_drawn_once_the_view_rests() -> None:
    record = json.dumps(ball_before_a_wall().initial().fields())
    first, least, last = run(STARTED.replace("RECORD", record), answers=False)
    assert (first, last) == (200_000, 200_000)
    assert least <= 100_000
