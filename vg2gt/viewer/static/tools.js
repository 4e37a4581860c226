// Measuring, cropping, the direction up, the background and views to keep.

const CLICK = 4;  // pixels that a click may move
const STEPS = 200;  // of a crop's sliders; their ends crop nothing
const UPS = { "+X": [1, 0, 0], "-X": [-1, 0, 0], "+Y": [0, 1, 0], "-Y": [0, -1, 0], "+Z": [0, 0, 1], "-Z": [0, 0, -1] };

// The point of the scene at a position of the canvas, or null.
function pointAt(geometry, view, lens, [x, y], limits) {
  const depth = surfaceDepth(geometry, view, lens, [x, y], limits);
  const local = [(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1];
  return depth && local.reduce((point, value, k) => addScaled(point, view.axes[k], value * depth), view.center);
}

// What two points are apart, and how vg2gt place takes them.
function measured([from, to], metresPerUnit) {
  const length = Math.hypot(...addScaled(to, from, -1)), digits = (value) => Number(value.toPrecision(6));
  const metres = metresPerUnit ? `${digits(length * metresPerUnit)} m` : `${digits(length)} scene units`;
  return `${metres}. To set the scale: vg2gt place DIR --scale=${[...from, ...to].map(digits)}=LENGTHm`;
}

// Low and high corners of a crop by the sliders' positions, low and high of x, y and z; null: nothing is cropped.
function cropBox(sliders, bounds) {
  const side = (value, k, open) =>
    value === (open < 0 ? 0 : STEPS) ? open : bounds[k][0] + (value / STEPS) * (bounds[k][1] - bounds[k][0]);
  const low = [0, 2, 4].map((i, k) => side(sliders[i], k, -Infinity));
  const high = [1, 3, 5].map((i, k) => side(sliders[i], k, Infinity));
  return [...low, ...high].some(Number.isFinite) ? [...low, ...high] : null;
}

// Between these values are 99 % of the means, along each axis.
function spreadOf(means) {
  return [0, 1, 2].map((k) => {
    const sorted = new Float32Array(means.length / 3).map((_, i) => means[3 * i + k]).sort();
    return [0.005, 0.995].map((share) => sorted[Math.round(share * (sorted.length - 1))]);
  });
}

// A view as vg2gt render --path takes it.
function toRecord(name, view) {
  const { fx, fy, cx, cy, width, height } = view.lens, translation = view.translation();
  const rows = view.axes.map((axis, k) => [...axis, translation[k]]);
  return { name, width, height, intrinsics: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
    world_to_camera: [...rows, [0, 0, 0, 1]] };
}

function connectTools({ canvas, view, changed, renderer, scene, geometry, means, crop, shown }) {
  const { near, lowpass, background } = scene.settings, kept = [], original = view.up;
  let points = [], start = null, bounds = null;
  const hex = (value) => Math.round(255 * Math.min(1, Math.max(0, value))).toString(16).padStart(2, "0");
  element("background").value = `#${background.map(hex).join("")}`;
  element("background").addEventListener("input", ({ target }) => {
    scene.settings.background = [1, 3, 5].map((at) => parseInt(target.value.slice(at, at + 2), 16) / 255);
    changed();
  });
  element("up").addEventListener("change", ({ target }) => {
    view.level(UPS[target.value] ?? original);
    changed();
  });
  element("measure").addEventListener("change", () => {
    points = [];
    renderer.setMarks(points, view.pivot);
    changed();
  });
  canvas.addEventListener("pointerdown", ({ clientX, clientY }) => { start = [clientX, clientY]; });
  canvas.addEventListener("pointerup", ({ clientX, clientY, offsetX, offsetY }) => {
    const moved = Math.hypot(clientX - start[0], clientY - start[1]) > CLICK;
    if (!element("measure").checked || moved) return;
    const lens = view.fitted(canvas.clientWidth, canvas.clientHeight);
    const limits = { near, blur: lowpass, ranges: shown() };
    const point = pointAt(geometry, view, lens, [offsetX - 0.5, offsetY - 0.5], limits);
    if (point) points = [...points.slice(-1), point];
    say(!point ? "There is no surface." : points.length < 2 ? "Click the second point."
      : measured(points, scene.cameras[0]?.metres_per_unit));
    renderer.setMarks(points, view.pivot);
    changed();
  });
  const sliders = [...element("crop").querySelectorAll("input")];
  for (const slider of sliders) {
    slider.addEventListener("input", () => {
      bounds ??= spreadOf(means);
      crop.box = cropBox(sliders.map(({ value }) => Number(value)), bounds);
      changed();
    });
  }
  element("keep").addEventListener("click", () => {
    kept.push(toRecord(`view-${kept.length}`, view));
    element("download").disabled = false;
    say(`${kept.length} views are kept. Download them for vg2gt render --path views.json.`);
  });
  element("download").addEventListener("click", () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([JSON.stringify(kept, null, 1)], { type: "application/json" }));
    link.download = "views.json";
    link.click();
    URL.revokeObjectURL(link.href);
  });
}
