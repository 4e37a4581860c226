// The view: a pose with OpenCV axes, a lens, and a point ahead to turn around.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const addScaled = (a, b, factor) => a.map((value, k) => value + factor * b[k]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));

function turned(vector, axis, angle) {
  const cos = Math.cos(angle), sin = Math.sin(angle), along = dot(axis, vector) * (1 - cos), side = cross(axis, vector);
  return vector.map((value, k) => value * cos + side[k] * sin + axis[k] * along);
}

// A camera of the page's scene (name, width, height, intrinsics, world_to_camera) as axes, centre and lens.
function fromRecord(record) {
  const rows = record.world_to_camera.slice(0, 3);
  const axes = rows.map((row) => row.slice(0, 3));
  const center = [0, 1, 2].map((k) => -rows.reduce((sum, row, i) => sum + axes[i][k] * row[3], 0));
  const [[fx, , cx], [, fy, cy]] = record.intrinsics;
  return { axes, center, lens: { fx, fy, cx, cy, width: record.width, height: record.height } };
}

// The corners of a camera's image (clockwise from the upper left) and a mark above it, at a z-depth.
function frustumCorners({ axes, center, lens }, depth) {
  const at = (x, y) => {
    const local = [(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1];
    return local.reduce((point, value, k) => addScaled(point, axes[k], value * depth), center);
  };
  const right = lens.width - 0.5, bottom = lens.height - 0.5;
  return [at(-0.5, -0.5), at(right, -0.5), at(right, bottom), at(-0.5, bottom),
    at((right - 0.5) / 2, -0.5 - 0.25 * lens.height)];
}

class View {
  constructor(up) {
    this.up = up;  // what turning sideways turns around
    this.pivot = 1;  // distance to the point ahead
  }

  set({ axes, center, lens }) {
    this.axes = axes.map((axis) => [...axis]);
    this.center = [...center];
    this.lens = lens;
  }

  // The lens for a canvas: the whole image fits in, scaled by pixel areas.
  fitted(width, height) {
    const lens = this.lens, scale = Math.min(width / lens.width, height / lens.height);
    return {
      fx: scale * lens.fx,
      fy: scale * lens.fy,
      cx: scale * (lens.cx + 0.5) - 0.5 + (width - scale * lens.width) / 2,
      cy: scale * (lens.cy + 0.5) - 0.5 + (height - scale * lens.height) / 2,
    };
  }

  translation() {
    return this.axes.map((axis) => -dot(axis, this.center));
  }

  // Turns by angles in radians, around the point ahead or on the spot; looking straight up or down is as far as it goes.
  turn(sideways, upwards, onTheSpot) {
    const ahead = addScaled(this.center, this.axes[2], this.pivot);
    const elevation = Math.asin(Math.max(-1, Math.min(1, dot(this.axes[2], this.up))));
    const limit = Math.max(1.5, Math.abs(elevation));
    const step = Math.max(-limit, Math.min(limit, elevation + upwards)) - elevation;
    const axes = this.axes.map((axis) => turned(axis, this.axes[0], step));
    const rotated = axes.map((axis) => turned(axis, this.up, sideways));
    const forward = unit(rotated[2]), right = unit(cross(rotated[1], forward));
    this.axes = [right, cross(forward, right), forward];
    if (!onTheSpot) this.center = addScaled(ahead, forward, -this.pivot);
  }

  // Sets the direction up, and turns the view upright unless it looks along it.
  level(up) {
    const forward = this.axes[2], right = cross(up.map((value) => -value), forward);
    this.up = up;
    if (Math.hypot(...right) < 0.01) return;
    this.axes = [unit(right), cross(forward, unit(right)), forward];
  }

  // Moves along the view's own axes, scene units.
  move(right, down, forward) {
    [right, down, forward].forEach((step, k) => { this.center = addScaled(this.center, this.axes[k], step); });
  }

  // Comes closer to the point ahead by a factor below 1.
  approach(factor) {
    const distance = this.pivot * factor;
    this.move(0, 0, this.pivot - distance);
    this.pivot = distance;
  }
}
