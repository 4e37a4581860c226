// Wires the page together. window.vg2gtViewer is for scripts: ready (a promise), setCamera(index or camera record), which
// resolves when that view is drawn completely, drawn() (the number of Gaussians in the last frame) and loadSeconds. The
// address may end in #camera=INDEX&show=cameras,images&fly=on&ui=off (address.js).

const started = performance.now();
const element = (id) => document.getElementById(id);

function say(text, isError = false) {
  element("status").textContent = text;
  element("status").classList.toggle("error", isError);
}

async function start() {
  const scene = JSON.parse(element("scene").textContent), canvas = element("view");
  const buffer = await inflate(element("gaussians").textContent);
  element("gaussians").remove();  // megabytes of text
  const { means, harmonics, geometry } = decodeGaussians(scene.gaussians, buffer);
  const weights = weightsOf(geometry), detail = new Detail(weights);
  const renderer = new Renderer(canvas, scene.settings), sorter = new DepthSorter(means, weights);
  renderer.setGaussians(geometry, harmonics, scene.gaussians.degree);
  const records = scene.cameras.length ? scene.cameras : [scene.initial];
  const pictures = await Promise.all(scene.cameras.map(({ picture }) => picture && decodePicture(picture)));
  renderer.setFrusta(scene.cameras.map(fromRecord), pictures, scene.frustum_depth);

  const up = records.map(fromRecord).reduce((sum, { axes }) => addScaled(sum, axes[1], -1), [0, 0, 0]);
  const view = new View(Math.hypot(...up) > 0.1 ? unit(up) : [0, -1, 0]);
  const show = { frusta: false, images: false }, crop = { box: null };
  let version = 0, drawn = -1, busy = false, moving = false, whole = true, rest = 0, waiting = [];

  // Sorts for the newest view and draws; in between frames show the newest view in an older order. The first one is
  // sorted here: it is sooner than a worker starts. Large scenes are drawn completely once the view rests.
  async function update() {
    busy = true;
    while (drawn < version) {
      const now = version, axis = [...view.axes[2], view.translation()[2]], near = scene.settings.near;
      const began = performance.now(), least = moving ? detail.least() : 0, measured = moving;
      whole = least === 0;
      renderer.setOrder(drawn < 0 ? makeDepthSorter(means)(axis, near) : await sorter.sort(axis, near, crop.box, least));
      paint();
      if (measured) {
        await new Promise(requestAnimationFrame);
        detail.adapt(performance.now() - began);
      }
      drawn = now;
    }
    busy = false;
    for (const resolve of waiting.splice(0)) resolve();
  }

  function wantedSize() {
    const density = Math.min(window.devicePixelRatio, 2);
    return [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * density)));
  }

  function paint() {
    renderer.resize(...wantedSize());
    renderer.draw(view, show);
  }

  function resized() {
    const [width, height] = wantedSize();
    if (width !== canvas.width || height !== canvas.height) changed();
  }

  function redraw() {
    version++;
    if (busy) requestAnimationFrame(paint);
    else update();
  }

  function changed() {
    moving = true;
    clearTimeout(rest);
    rest = setTimeout(rested, 200);
    redraw();
  }

  function rested() {
    moving = false;
    if (!whole) redraw();
  }

  function complete() {
    clearTimeout(rest);
    moving = false;
    return new Promise((resolve) => {
      waiting.push(resolve);
      redraw();
    });
  }

  function setCamera(camera) {
    const record = typeof camera === "number" ? records[camera] : camera;
    if (!record) throw new Error(`There is no camera ${camera}; the scene has ${records.length}.`);
    view.set(fromRecord(record));
    view.pivot = pivotDepth(view, geometry, scene);
    if (typeof camera === "number") element("cameras").selectedIndex = camera;
    return complete();
  }

  const follow = connect({ canvas, view, changed, resized, setCamera, show, records, scene, pictures });
  connectTools({ canvas, view, changed, renderer, scene, geometry, means, crop });
  await follow(0);
  viewer.drawn = () => renderer.visible;
  viewer.loadSeconds = (performance.now() - started) / 1000;
  return setCamera;
}

// Depth of what is in the middle of a camera's image, so that turning keeps it there.
function pivotDepth(view, geometry, { settings, frustum_depth }) {
  const { width, height } = view.lens, shares = [0.45, 0.5, 0.55], blur = settings.lowpass, near = settings.near;
  const places = shares.flatMap((x) => shares.map((y) => [x * width - 0.5, y * height - 0.5]));
  const depths = places.map((place) => surfaceDepth(geometry, view, view.lens, place, { near, blur }));
  const found = depths.filter((depth) => depth !== null).sort((a, b) => a - b);
  return found.length ? found[found.length >> 1] : 50 * frustum_depth;
}

// Buttons, boxes, keys, window.
function connect({ canvas, view, changed, resized, setCamera, show, records, scene, pictures }) {
  const list = element("cameras");
  for (const { name } of records) list.append(new Option(name));
  const walk = (step) => setCamera((list.selectedIndex + step + records.length) % records.length);
  const reset = () => setCamera(Math.max(0, list.selectedIndex));
  const controls = new Controls(canvas, view, changed, {
    n: () => walk(1),
    p: () => walk(-1),
    r: reset,
    c: () => element("show-cameras").click(),
    i: () => element("show-images").click(),
  });
  list.addEventListener("change", reset);
  element("next").addEventListener("click", () => walk(1));
  element("previous").addEventListener("click", () => walk(-1));
  element("reset").addEventListener("click", reset);
  const boxes = {
    cameras: [element("show-cameras"), scene.cameras.length > 0, (on) => { show.frusta = on; }],
    images: [element("show-images"), pictures.some(Boolean), (on) => { show.images = on; }],
    fly: [element("fly"), true, (on) => { controls.fly = on; }],
  };
  for (const [box, enabled, apply] of Object.values(boxes)) {
    box.disabled = !enabled;
    box.addEventListener("change", () => {
      apply(box.checked);
      changed();
    });
  }
  const counts = `${scene.gaussians.count.toLocaleString("en")} Gaussians, ${scene.cameras.length} cameras`;
  const follow = (otherwise) => {  // does what the address asks for; otherwise: the camera if it names none, null: stay
    const wanted = readAddress(location.hash, records.length);
    element("panel").hidden = !wanted.panel;
    for (const [name, [box, enabled, apply]] of Object.entries(boxes)) {
      box.checked = enabled && wanted.boxes[name];
      apply(box.checked);
    }
    say(wanted.problem || counts, Boolean(wanted.problem));
    const camera = wanted.camera ?? otherwise;
    return camera === null ? changed() : setCamera(camera);
  };
  new ResizeObserver(resized).observe(canvas);
  window.addEventListener("hashchange", () => follow(null));
  canvas.addEventListener("webglcontextlost", () => say("The graphics device was lost; reload the page.", true));
  return follow;
}

element("panel").hidden = !readAddress(location.hash, Infinity).panel;
const viewer = { ready: null, loadSeconds: null };
viewer.ready = start();
viewer.setCamera = async (camera) => (await viewer.ready)(camera);
viewer.ready.catch((error) => say(`${error.message ?? error}`, true));
window.vg2gtViewer = viewer;
