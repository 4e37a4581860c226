// While the view moves, only as many Gaussians are drawn as keep the frame rate: those that cover most of an image.

const FRAME = 33, FEWEST = 50000;  // milliseconds of a frame; Gaussians that are drawn in any case

// Opacity times the area that a Gaussian covers when it is seen along its shortest axis.
function weightsOf(geometry) {
  const weights = new Float32Array(geometry.length / 12);
  for (let i = 0; i < weights.length; i++) {
    const at = 12 * i + 8, x = geometry[at], y = geometry[at + 1], z = geometry[at + 2];
    weights[i] = geometry[12 * i + 3] * Math.max(x * y, y * z, x * z);
  }
  return weights;
}

class Detail {
  constructor(weights) {
    this.sorted = weights.slice().sort();
    this.most = weights.length;
  }

  // The weight from which Gaussians are drawn while the view moves; 0: all.
  least() {
    const count = this.sorted.length;
    return this.most < count ? this.sorted[count - Math.round(this.most)] : 0;
  }

  // Takes the duration of a frame in milliseconds.
  adapt(duration) {
    const count = this.sorted.length, change = Math.min(Math.max(FRAME / duration, 0.5), 1.1);
    this.most = Math.min(Math.max(this.most * change, FEWEST), count);
  }
}
