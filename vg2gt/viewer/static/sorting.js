// Back-to-front order by the depth of the means, exact in float32: positive floats sort like their bits. Of equal depths
// the later Gaussian is the farther one.

// Self-contained, because a worker gets its source text. axis: third row of world_to_camera, four numbers; box: low and
// high corners of what is shown, null: everything; least: Gaussians of a smaller weight are left out; ranges: first and
// last (exclusive) Gaussians of the tiles that are shown, in order.
function makeDepthSorter(means, weights) {
  const count = means.length / 3;
  const depths = new Float32Array(count), bits = new Uint32Array(depths.buffer);
  const first = new Uint32Array(count), second = new Uint32Array(count);
  return (axis, near, box, least = 0, ranges = [[0, count]]) => {
    const [lx, ly, lz, hx, hy, hz] = box ?? [-Infinity, -Infinity, -Infinity, Infinity, Infinity, Infinity];
    const [ax, ay, az, at] = axis;
    let visible = 0;
    for (const [start, end] of [...ranges].reverse()) {
      for (let i = end - 1; i >= start; i--) {
        if (least && weights[i] < least) continue;
        const x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
        depths[i] = ax * x + ay * y + az * z + at;
        if (depths[i] > near && x >= lx && x <= hx && y >= ly && y <= hy && z >= lz && z <= hz) first[visible++] = i;
      }
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
        let sort, means;
        onmessage = ({ data }) => {
          if (data.means) { means = data.means; sort = makeDepthSorter(means, data.weights); return; }
          if (data.tile) { means.set(data.tile, 3 * data.first); return; }
          const order = sort(...data);
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

  // Takes the means of a tile, which the caller has put into the means already.
  put(first, tile) {
    this.worker?.postMessage({ first, tile });
  }

  // Arguments as of makeDepthSorter's answer.
  sort(...asked) {
    if (!this.worker) return Promise.resolve(this.sortHere(...asked));
    return new Promise((resolve) => {
      this.waiting.push({ asked, resolve });
      this.worker.postMessage(asked);
    });
  }
}
