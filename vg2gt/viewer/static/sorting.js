// Back-to-front order by the depth of the means, exact in float32: positive floats sort like their bits. Of equal depths
// the later Gaussian is the farther one.

// Self-contained, because a worker gets its source text. axis: third row of world_to_camera, four numbers; box: low and
// high corners of what is shown, null: everything; least: Gaussians of a smaller weight are left out.
function makeDepthSorter(means, weights) {
  const count = means.length / 3;
  const depths = new Float32Array(count), bits = new Uint32Array(depths.buffer);
  const first = new Uint32Array(count), second = new Uint32Array(count);
  return (axis, near, box, least = 0) => {
    const [lx, ly, lz, hx, hy, hz] = box ?? [-Infinity, -Infinity, -Infinity, Infinity, Infinity, Infinity];
    const [ax, ay, az, at] = axis;
    let visible = 0;
    for (let i = count - 1; i >= 0; i--) {
      if (least && weights[i] < least) continue;
      const x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
      depths[i] = ax * x + ay * y + az * z + at;
      if (depths[i] > near && x >= lx && x <= hx && y >= ly && y <= hy && z >= lz && z <= hz) first[visible++] = i;
    }
    const pass = (from, to, shift) => {
      const starts = new Uint32Array(65537);
      for (let i = 0; i < visible; i++) starts[((~bits[from[i]] >>> shift) & 65535) + 1]++;
      for (let key = 0; key < 65536; key++) starts[key + 1] += starts[key];
      for (let i = 0; i < visible; i++) to[starts[(~bits[from[i]] >>> shift) & 65535]++] = from[i];
    };
    pass(first, second, 0);
    pass(second, first, 16);
    return first.slice(0, visible);
  };
}

// Sorts in a worker where the browser allows one for this page, otherwise here. sort() answers with a promise.
class DepthSorter {
  constructor(means, weights) {
    this.waiting = [];
    try {
      const source = `${makeDepthSorter};
        let sort;
        onmessage = ({ data }) => {
          if (data.means) { sort = makeDepthSorter(data.means, data.weights); return; }
          const order = sort(data.axis, data.near, data.box, data.least);
          postMessage(order, [order.buffer]);
        };`;
      this.worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
      this.worker.onmessage = ({ data }) => this.waiting.shift().resolve(data);
      this.worker.onerror = () => this.fallBack(means, weights);
      this.worker.postMessage({ means, weights });
    } catch {
      this.fallBack(means, weights);
    }
  }

  fallBack(means, weights) {
    this.worker = null;
    this.sortHere = makeDepthSorter(means, weights);
    for (const { asked, resolve } of this.waiting.splice(0)) resolve(this.sortHere(...asked));
  }

  sort(axis, near, box, least) {
    if (!this.worker) return Promise.resolve(this.sortHere(axis, near, box, least));
    return new Promise((resolve) => {
      this.waiting.push({ asked: [axis, near, box, least], resolve });
      this.worker.postMessage({ axis, near, box, least });
    });
  }
}
