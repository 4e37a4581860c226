// Levels of detail: which tiles are drawn for a view, and which are loaded for it (vg2gt/viewer/levels.py).

const DRAWN = 40 * 32768, SLOTS = 64, AT_ONCE = 4;  // Gaussians of an image, tiles in memory, tiles loaded at once
const SHARP = 0.25;  // pixels of a Gaussian's extent below which a tile is fine enough

class Levels {
  // description: what write_levels returns; near: the near plane.
  constructor(description, near) {
    Object.assign(this, description, { near, now: 0, loading: new Set(), failed: null });
    this.tiles = this.places.map((level, k) => level.map((place, j) => ({ ...place, k, j, slot: null, seen: 0 })));
    this.root = this.tiles.at(-1)[0];
    this.root.slot = 0;
    this.owners = new Array(Math.min(SLOTS, this.tiles.flat().length)).fill(null);
    this.owners[0] = this.root;
  }

  parts({ k, j }) {
    return this.tiles[k - 1].slice(4 * j, 4 * j + 4);
  }

  // Extent of a tile's Gaussians in pixels, at the place that is nearest to the eye.
  extent({ low, high, size }, { center }, lens) {
    const gap = center.map((value, k) => Math.max(low[k] - value, 0, value - high[k]));
    return size * lens.fx / Math.max(Math.hypot(...gap), this.near);
  }

  // Whether a sphere around a tile reaches into the image.
  inView({ low, high, reach }, { axes, center }, lens, [width, height]) {
    const offset = low.map((value, k) => (value + high[k]) / 2 - center[k]);
    const [x, y, z] = axes.map((axis) => dot(axis, offset));
    const radius = Math.hypot(...addScaled(high, low, -1)) / 2 + reach;
    const outside = (side, slope) => (side - slope * z) / Math.hypot(1, slope) > radius;
    return z + radius > this.near
      && !outside(x, (width - 0.5 - lens.cx) / lens.fx) && !outside(-x, (0.5 + lens.cx) / lens.fx)
      && !outside(y, (height - 0.5 - lens.cy) / lens.fy) && !outside(-y, (0.5 + lens.cy) / lens.fy);
  }

  // The ranges of Gaussians to draw: the coarsest tiles are replaced first, at most until there are `most` Gaussians,
  // as far as their parts are loaded. What is missing is asked for.
  choose(view, lens, size, most) {
    const drawn = new Set([this.root]), open = [this.root], missing = [];
    let count = this.always + this.root.count;
    this.now++;
    while (open.length) {
      open.sort((a, b) => this.extent(a, view, lens) - this.extent(b, view, lens));
      const tile = open.pop(), parts = this.parts(tile).filter((part) => this.inView(part, view, lens, size));
      count += parts.reduce((sum, part) => sum + part.count, -tile.count);
      if (this.extent(tile, view, lens) < SHARP || count > most) break;
      for (const part of parts) part.seen = this.now;
      const absent = parts.filter(({ slot }) => slot === null);
      missing.push(...absent);
      if (absent.length) continue;
      drawn.delete(tile);
      for (const part of parts) drawn.add(part);
      if (tile.k > 1) open.push(...parts);
    }
    for (const tile of missing) this.load(tile);
    const ranges = [...drawn].map((tile) => {
      const first = tile === this.root ? this.always : tile.slot * this.tile;
      return [first, first + tile.count];
    });
    return [[0, this.always], ...ranges].sort((a, b) => a[0] - b[0]);
  }

  // Asks for a tile if there is a place that the newest view does not need.
  load(tile) {
    if (this.loading.has(tile) || this.loading.size >= AT_ONCE || this.failed) return;
    const free = this.owners.map((owner, slot) => ({ slot, seen: owner ? owner.seen : -1 })).slice(1)
      .filter(({ slot, seen }) => seen < this.now && !this.loading.has(this.owners[slot]));
    if (!free.length) return;
    const { slot } = free.reduce((a, b) => (b.seen < a.seen ? b : a));
    if (this.owners[slot]) this.owners[slot].slot = null;
    this.owners[slot] = tile;
    this.loading.add(tile);
    tile.came = false;
    const script = document.createElement("script");
    script.src = `${encodeURIComponent(this.folder)}/${tile.k}-${tile.j}.js?${this.version}`;
    script.onload = () => {
      script.remove();
      if (!tile.came) this.done(tile, new Error(`A tile in ${this.folder} is damaged: run vg2gt view --levels again.`));
    };
    script.onerror = () => this.done(tile, new Error(`The folder ${this.folder} of tiles is not next to the page.`));
    document.head.append(script);
  }

  // First Gaussian of an asked tile, which has come.
  first(tile) {
    tile.came = true;
    return this.owners.indexOf(tile) * this.tile;
  }

  done(tile, failed = null) {
    tile.slot = failed ? null : this.owners.indexOf(tile);
    this.failed ??= failed;
    this.loading.delete(tile);
    this.changed();
  }
}
