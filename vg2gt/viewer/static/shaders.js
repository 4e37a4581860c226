// GLSL sources. Pixel coordinates have integer pixel centres and y down, as everywhere in the scene's own conventions;
// toClip turns them into WebGL's, where the centre of the first pixel is at (1/2, 1/2) and y points up.

const TO_CLIP = `
vec2 toClip(vec2 pixel, vec2 size) { return (2.0 * (pixel + 0.5) / size - 1.0) * vec2(1.0, -1.0); }
`;

// One instance a Gaussian, four corners each: the affine splat of classic rasterisation. The quad spans the ellipse on
// which opacity falls to alphaMin; vUnit is the position in units of its half axes.
const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D geometry;   // three texels a Gaussian: mean and opacity, unit quaternion wxyz, scales
uniform sampler2D harmonics;  // (degree + 1)^2 texels a Gaussian
uniform int degree;
uniform mat3 rotation;
uniform vec3 translation;
uniform vec3 eye;
uniform vec4 lens;            // fx, fy, cx, cy
uniform vec2 size;
uniform vec2 slopeLimit;
uniform float lowpass;
uniform float compensationFloor;  // 1: opacities are not compensated for the low-pass filter
uniform float alphaMin;
in uint index;
out vec2 vUnit;
flat out vec3 vColor;
flat out float vOpacity;
flat out float vCutoff;
${TO_CLIP}
vec4 texel(sampler2D table, int at) {
  int width = textureSize(table, 0).x;
  return texelFetch(table, ivec2(at % width, at / width), 0);
}

mat3 axes(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 colorSeen(int gaussian, vec3 d) {
  int first = gaussian * (degree + 1) * (degree + 1);
  vec3 sum = 0.28209479177387814 * texel(harmonics, first).rgb;
  if (degree > 0) {
    sum += 0.4886025119029199 * (-d.y * texel(harmonics, first + 1).rgb + d.z * texel(harmonics, first + 2).rgb
      - d.x * texel(harmonics, first + 3).rgb);
  }
  vec3 s = d * d;
  if (degree > 1) {
    sum += 1.0925484305920792 * (d.x * d.y * texel(harmonics, first + 4).rgb
      - d.y * d.z * texel(harmonics, first + 5).rgb - d.x * d.z * texel(harmonics, first + 7).rgb
      + 0.5 * (s.x - s.y) * texel(harmonics, first + 8).rgb)
      + 0.31539156525252005 * (2.0 * s.z - s.x - s.y) * texel(harmonics, first + 6).rgb;
  }
  if (degree > 2) {
    sum += -0.5900435899266435 * (d.y * (3.0 * s.x - s.y) * texel(harmonics, first + 9).rgb
        + d.x * (s.x - 3.0 * s.y) * texel(harmonics, first + 15).rgb)
      + 2.890611442640554 * d.x * d.y * d.z * texel(harmonics, first + 10).rgb
      - 0.4570457994644658 * (4.0 * s.z - s.x - s.y) * (d.y * texel(harmonics, first + 11).rgb
        + d.x * texel(harmonics, first + 13).rgb)
      + 0.3731763325901154 * d.z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y) * texel(harmonics, first + 12).rgb
      + 1.445305721320277 * d.z * (s.x - s.y) * texel(harmonics, first + 14).rgb;
  }
  return max(sum + 0.5, 0.0);
}

void main() {
  int gaussian = int(index);
  vec4 first = texel(geometry, 3 * gaussian);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  vec3 mean = rotation * first.xyz + translation;
  vec2 tangent = mean.xy / mean.z;
  vec2 slope = clamp(tangent, -slopeLimit, slopeLimit);
  mat3 frame = rotation * axes(texel(geometry, 3 * gaussian + 1));
  vec3 scales = texel(geometry, 3 * gaussian + 2).xyz;
  vec2 zoom = lens.xy / mean.z;
  float xx = lowpass, xy = 0.0, yy = lowpass;
  for (int k = 0; k < 3; k++) {
    vec3 axis = frame[k] * scales[k];
    vec2 v = (axis.xy - slope * axis.z) * zoom;
    xx += v.x * v.x;
    xy += v.x * v.y;
    yy += v.y * v.y;
  }
  float sharp = (xx - lowpass) * (yy - lowpass) - xy * xy, blurred = xx * yy - xy * xy;
  float opacity = first.w * sqrt(max(sharp / blurred, compensationFloor));
  float cutoff = 2.0 * log(opacity / alphaMin);
  if (!(cutoff > 0.0)) return;
  float middle = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy));
  float larger = middle + spread, smaller = max(middle - spread, lowpass);
  vec2 major = xx > yy ? vec2(larger - yy, xy) : vec2(xy, larger - xx);
  float norm = length(major);
  major = norm > 0.0 ? major / norm : vec2(1.0, 0.0);
  vUnit = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 offset = sqrt(cutoff * larger) * vUnit.x * major + sqrt(cutoff * smaller) * vUnit.y * vec2(-major.y, major.x);
  vColor = colorSeen(gaussian, normalize(first.xyz - eye));
  vOpacity = opacity;
  vCutoff = cutoff;
  gl_Position = vec4(toClip(tangent * lens.xy + lens.zw + offset, size), 0.0, 1.0);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
uniform float alphaMax;
in vec2 vUnit;
flat in vec3 vColor;
flat in float vOpacity;
flat in float vCutoff;
out vec4 pixel;
void main() {
  float square = dot(vUnit, vUnit);
  if (square > 1.0) discard;
  float alpha = min(alphaMax, vOpacity * exp(-0.5 * vCutoff * square));
  pixel = vec4(vColor * alpha, alpha);
}`;

// Copies the blended image to the canvas.
const COPY_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

const COPY_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D image;
out vec4 pixel;
void main() { pixel = vec4(texelFetch(image, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`;

// Frusta (lines) and the images in them (triangles), over the Gaussians.
const OVERLAY_VERTEX = `#version 300 es
precision highp float;
uniform mat3 rotation;
uniform vec3 translation;
uniform vec4 lens;
uniform vec2 size;
uniform float near;
in vec3 position;
in vec2 corner;
out vec2 vCorner;
${TO_CLIP}
void main() {
  vec3 p = rotation * position + translation;
  vCorner = corner;
  // homogeneous, so that what is nearer than the near plane is clipped
  vec2 far = toClip(lens.zw, size);
  gl_Position = vec4(far * p.z + 2.0 * lens.xy / size * vec2(1.0, -1.0) * p.xy, p.z - 2.0 * near, p.z);
}`;

const OVERLAY_FRAGMENT = `#version 300 es
precision highp float;
uniform vec4 color;
uniform bool textured;
uniform sampler2D image;
in vec2 vCorner;
out vec4 pixel;
void main() { pixel = textured ? texture(image, vCorner) : color; }`;
