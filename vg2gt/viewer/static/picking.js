// Where a ray from the eye meets the scene.

const HALF = 0.5;  // share of the light that is left at a surface: its median depth

// Returns the z-depth at which half of the light of an image position is absorbed, or null if less than that is.
// geometry: 12 floats a Gaussian, of decodeGaussians; lens: fx, fy, cx, cy of the image; blur: variance in pixels that
// every Gaussian has at least; ranges: those of the Gaussians that are shown, as the sorter takes them.
function surfaceDepth(geometry, { axes, center }, lens, [x, y], { near, blur, ranges = [[0, geometry.length / 12]] }) {
  const local = [(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1];
  const ray = [0, 1, 2].map((k) => local.reduce((sum, value, i) => sum + value * axes[i][k], 0));
  const [rx, ry, rz] = ray, [fx, fy, fz] = axes[2], pixel = Math.sqrt(blur) / lens.fx, hits = [];
  const visit = (at) => {
    const mx = geometry[at] - center[0], my = geometry[at + 1] - center[1], mz = geometry[at + 2] - center[2];
    const depth = mx * fx + my * fy + mz * fz;
    if (depth <= near) return;
    const ox = mx - depth * rx, oy = my - depth * ry, oz = mz - depth * rz;  // from the ray to the mean
    const least = pixel * depth, reach = 3.4 * Math.max(least, geometry[at + 8], geometry[at + 9], geometry[at + 10]);
    if (ox * ox + oy * oy + oz * oz > reach * reach * (rx * rx + ry * ry + rz * rz)) return;
    const hit = peakOnRay(geometry, at, [mx, my, mz], ray, least);
    if (hit.depth > near) hits.push(hit);
  };
  for (const [start, end] of ranges) {
    for (let i = start; i < end; i++) visit(12 * i);
  }
  let light = 1;
  for (const { depth, alpha } of hits.sort((a, b) => a.depth - b.depth)) {
    light *= 1 - alpha;
    if (light <= HALF) return depth;
  }
  return null;
}

// Depth and opacity where a Gaussian is densest along a ray from the origin (whose depth is its parameter).
function peakOnRay(geometry, at, mean, ray, least) {
  const [w, x, y, z] = geometry.subarray(at + 4, at + 8);
  const columns = [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
  const scaled = (vector) => columns.map((axis, k) => dot(axis, vector) / Math.max(least, geometry[at + 8 + k]));
  const m = scaled(mean), r = scaled(ray), depth = dot(m, r) / dot(r, r);
  const square = dot(m, m) - depth * dot(m, r);
  return { depth, alpha: geometry[at + 3] * Math.exp(-0.5 * square) };
}
