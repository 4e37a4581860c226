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
  const { count, degree } = scene.gaussians, first = decodeGaussians(scene.gaussians, buffer);
  const levels = scene.levels && new Levels(scene.levels, scene.settings.near);
  const room = levels ? levels.owners.length * levels.tile : count;
  const [means, geometry] = levels ? [3, 12].map((each) => new Float32Array(each * room))
    : [first.means, first.geometry];
  const weights = levels ? new Float32Array(DRAWN) : weightsOf(geometry), detail = new Detail(weights);
  const renderer = new Renderer(canvas, scene.settings);
  renderer.allocate(room, degree);
  renderer.put(0, first.geometry, first.harmonics);
  if (levels) {
    means.set(first.means);
    geometry.set(first.geometry);
  }
  const sorter = new DepthSorter(means, weights);
  const records = scene.cameras.length ? scene.cameras : [scene.initial];
  const pictures = await Promise.all(scene.cameras.map(({ picture }) => picture && decodePicture(picture)));
  renderer.setFrusta(scene.cameras.map(fromRecord), pictures, scene.frustum_depth);

  const up = records.map(fromRecord).reduce((sum, { axes }) => addScaled(sum, axes[1], -1), [0, 0, 0]);
  const view = new View(Math.hypot(...up) > 0.1 ? unit(up) : [0, -1, 0]);
  const show = { frusta: false, images: false }, crop = { box: null };
  let version = 0, drawn = -1, busy = false, moving = false, whole = true, rest = 0, waiting = [];
  let ranges = [[0, count]];

  // Sorts for the newest view and draws; in between frames show the newest view in an older order. The first one is
  // sorted here: it is sooner than a worker starts. Large scenes are drawn completely once the view rests.
  async function update() {
    busy = true;
    while (drawn < version) {
      const now = version, axis = [...view.axes[2], view.translation()[2]], near = scene.settings.near;
      const began = performance.now(), least = moving ? detail.least() : 0, measured = moving;
      const size = wantedSize(), most = moving ? detail.most : DRAWN;
      ranges = levels?.choose(view, view.fitted(...size), size, most) ?? ranges;
      whole = levels ? most === DRAWN : least === 0;
      renderer.setOrder(drawn < 0 ? makeDepthSorter(means)(axis, near, null, 0, ranges)
        : await sorter.sort(axis, near, crop.box, least, ranges));
      paint();
      if (measured || levels?.loading.size) await new Promise(requestAnimationFrame);
      if (measured) detail.adapt(performance.now() - began);
      drawn = now;
    }
    busy = false;
    if (levels?.loading.size) return;
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
    view.pivot = pivotDepth(view, geometry, scene, ranges);
    if (typeof camera === "number") element("cameras").selectedIndex = camera;
    return complete();
  }

  const follow = connect({ canvas, view, changed, resized, setCamera, show, records, scene, pictures });
  connectTools({ canvas, view, changed, renderer, scene, geometry, means: first.means, crop, shown: () => ranges });
  if (levels) {
    levels.changed = () => {
      if (levels.failed) say(levels.failed.message, true);
      version++;
      if (!busy) update();
    };
    window.vg2gtTile = async (k, j, header, text) => {
      const tile = levels.tiles[k][j], at = levels.first(tile);
      try {
        const content = decodeGaussians(header, await inflate(text));
        means.set(content.means, 3 * at);
        geometry.set(content.geometry, 12 * at);
        renderer.put(at, content.geometry, content.harmonics);
        sorter.put(at, content.means);
        levels.done(tile);
      } catch (error) {
        levels.done(tile, error);
      }
    };
  }
  await follow(0);
  viewer.drawn = () => renderer.visible;
  viewer.loadSeconds = (performance.now() - started) / 1000;
  return setCamera;
}

// Depth of what is in the middle of a camera's image, so that turning keeps it there.
function pivotDepth(view, geometry, { settings, frustum_depth }, ranges) {
  const { width, height } = view.lens, shares = [0.45, 0.5, 0.55], blur = settings.lowpass, near = settings.near;
  const places = shares.flatMap((x) => shares.map((y) => [x * width - 0.5, y * height - 0.5]));
  const depths = places.map((place) => surfaceDepth(geometry, view, view.lens, place, { near, blur, ranges }));
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
  const count = scene.levels?.total ?? scene.gaussians.count;
  const counts = `${count.toLocaleString("en")} Gaussians, ${scene.cameras.length} cameras`;
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
