// Reads the scene from the page: base64, gzip, then one block a column (vg2gt/viewer/page.py writes them).

async function inflate(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

// Returns means (3 floats each), harmonics (half floats as they are) and geometry: 12 floats each, three texels of mean
// and opacity, quaternion wxyz, scales.
function decodeGaussians(header, buffer) {
  const count = header.count, coefficients = (header.degree + 1) ** 2;
  let at = 0;
  const take = (Kind, length) => {
    const column = new Kind(buffer, at, length);
    at += column.byteLength;
    return column;
  };
  const means = take(Float32Array, 3 * count);
  const harmonics = take(Uint16Array, 3 * coefficients * count);
  const scales = take(Uint16Array, 3 * count);
  const quats = take(Int16Array, 4 * count);
  const opacities = take(Uint16Array, count);
  const geometry = new Float32Array(12 * count);
  const low = header.log_scale_min, step = (header.log_scale_max - low) / 65535;
  for (let i = 0; i < count; i++) {
    const to = 12 * i;
    for (let k = 0; k < 3; k++) {
      geometry[to + k] = means[3 * i + k];
      geometry[to + 8 + k] = Math.exp(scales[3 * i + k] * step + low);
    }
    geometry[to + 3] = opacities[i] / 65535;
    const length = Math.hypot(quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
    for (let k = 0; k < 4; k++) geometry[to + 4 + k] = quats[4 * i + k] / length;
  }
  return { means, harmonics, geometry };
}

async function decodePicture(base64) {
  const text = atob(base64);
  const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  return createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
}
