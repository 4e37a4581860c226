// WebGL 2: splats back to front into a half-float image (8 bits would round at every splat), then frusta and images.

class Renderer {
  constructor(canvas, settings) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl) throw new Error("This browser has no WebGL 2, which the viewer needs.");
    Object.assign(this, { gl, canvas, settings, frusta: null });
    this.precise = Boolean(gl.getExtension("EXT_color_buffer_float"));
    this.splats = this.program(SPLAT_VERTEX, SPLAT_FRAGMENT, ["index"]);
    this.copy = this.program(COPY_VERTEX, COPY_FRAGMENT, []);
    this.overlay = this.program(OVERLAY_VERTEX, OVERLAY_FRAGMENT, ["position", "corner"]);
    this.order = gl.createBuffer();
    this.orderArray = gl.createVertexArray();
    gl.bindVertexArray(this.orderArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    this.visible = 0;
    this.frame = gl.createFramebuffer();
  }

  program(vertex, fragment, attributes) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    attributes.forEach((name, place) => gl.bindAttribLocation(program, place, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(`The graphics driver refuses a shader: ${gl.getProgramInfoLog(program)} ${logs.join(" ")}`);
    }
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  texture(filter) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
      gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    }
    return texture;
  }

  // A texture for some texels a Gaussian, of full rows.
  table(texels, each, internal) {
    const gl = this.gl, most = gl.getParameter(gl.MAX_TEXTURE_SIZE), width = Math.min(most, 4096, texels);
    if (Math.ceil(texels / width) > most) {
      throw new Error("The scene has more Gaussians than this graphics device can hold; vg2gt view --levels helps.");
    }
    const texture = this.texture(gl.NEAREST);
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, Math.ceil(texels / width));
    return { texture, width, each };
  }

  // Values from a Gaussian on whose row is its own; the last row is uploaded alone because it is shorter.
  fill({ texture, width, each }, first, values, channels, ...kind) {
    const gl = this.gl, texels = values.length / channels, full = Math.floor(texels / width);
    const top = first * each / width;
    this.bind(0, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, top, width, full, ...kind, values, 0);
    const rest = texels - full * width;
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, top + full, rest, 1, ...kind, values, full * width * channels);
  }

  // Makes room; put() fills it.
  allocate(count, degree) {
    const gl = this.gl, coefficients = (degree + 1) ** 2;
    this.geometry = this.table(3 * count, 3, gl.RGBA32F);
    this.harmonics = this.table(coefficients * count, coefficients, gl.RGB16F);
    this.degree = degree;
  }

  put(first, geometry, harmonics) {
    this.fill(this.geometry, first, geometry, 4, this.gl.RGBA, this.gl.FLOAT);
    this.fill(this.harmonics, first, harmonics, 3, this.gl.RGB, this.gl.HALF_FLOAT);
  }

  setOrder(order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.visible = order.length;
  }

  // cameras: of fromRecord; pictures: ImageBitmap or null each.
  setFrusta(cameras, pictures, depth) {
    const gl = this.gl, values = [];
    this.frusta = cameras.map((camera, index) => {
      const [a, b, c, d, above] = frustumCorners(camera, depth), apex = camera.center;
      const lines = [apex, a, apex, b, apex, c, apex, d, a, b, b, c, c, d, d, a, a, above, above, b];
      const start = values.length / 5;
      for (const point of lines) values.push(...point, 0, 0);
      for (const [point, u, v] of [[a, 0, 0], [b, 1, 0], [d, 0, 1], [c, 1, 1]]) values.push(...point, u, v);
      let texture = null;
      if (pictures[index]) {
        texture = this.texture(gl.LINEAR);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, pictures[index]);
      }
      return { center: camera.center, start, lines: lines.length, texture, depth };
    });
    this.frustumArray = gl.createVertexArray();
    gl.bindVertexArray(this.frustumArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 20, 0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 2, gl.FLOAT, false, 20, 12);
  }

  resize(width, height) {
    const gl = this.gl, canvas = this.canvas;
    if (canvas.width === width && canvas.height === height && this.image) return;
    canvas.width = width;
    canvas.height = height;
    if (this.image) gl.deleteTexture(this.image);
    this.image = this.texture(gl.NEAREST);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.precise ? gl.RGBA16F : gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
  }

  usePose({ program, uniforms }, view) {
    const gl = this.gl, { width, height } = this.canvas, lens = view.fitted(width, height);
    gl.useProgram(program);
    gl.uniformMatrix3fv(uniforms.rotation, true, view.axes.flat());
    gl.uniform3fv(uniforms.translation, view.translation());
    gl.uniform4f(uniforms.lens, lens.fx, lens.fy, lens.cx, lens.cy);
    gl.uniform2f(uniforms.size, width, height);
    return lens;
  }

  draw(view, { frusta, images }) {
    const gl = this.gl, { width, height } = this.canvas;
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.clearColor(...this.settings.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.drawSplats(view);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.copy.program);
    this.bind(0, this.image);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (this.frusta && (frusta || images)) this.drawFrusta(view, frusta, images);
    if (this.marks) this.drawMarks(view);
  }

  // Crosses at points, and lines between them; size: that of a unit on the screen.
  setMarks(points, size) {
    const gl = this.gl, lines = points.length > 1 ? [points[0], points[1]] : [];
    for (const point of points) {
      for (const axis of [[1, 0, 0], [0, 1, 0], [0, 0, 1]]) {
        for (const side of [-0.01, 0.01]) lines.push(addScaled(point, axis, side * size));
      }
    }
    this.marks = lines.length;
    this.markArray ??= gl.createVertexArray();
    this.markBuffer ??= gl.createBuffer();
    gl.bindVertexArray(this.markArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.markBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(lines.flat()), gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 12, 0);
  }

  drawMarks(view) {
    const gl = this.gl, { uniforms } = this.overlay;
    this.usePose(this.overlay, view);
    gl.uniform1f(uniforms.near, this.settings.near);
    gl.uniform1i(uniforms.textured, 0);
    gl.uniform4f(uniforms.color, 0.3, 1.0, 0.5, 1.0);
    gl.bindVertexArray(this.markArray);
    gl.drawArrays(gl.LINES, 0, this.marks);
  }

  bind(place, texture) {
    this.gl.activeTexture(this.gl.TEXTURE0 + place);
    this.gl.bindTexture(this.gl.TEXTURE_2D, texture);
  }

  drawSplats(view) {
    const gl = this.gl, { uniforms } = this.splats, settings = this.settings;
    const lens = this.usePose(this.splats, view);
    gl.uniform3fv(uniforms.eye, view.center);
    gl.uniform2f(uniforms.slopeLimit, settings.jacobian_clamp * this.canvas.width / 2 / lens.fx,
      settings.jacobian_clamp * this.canvas.height / 2 / lens.fy);
    gl.uniform1f(uniforms.lowpass, settings.lowpass);
    gl.uniform1f(uniforms.compensationFloor, settings.antialiased ? settings.compensation_floor : 1);
    gl.uniform1f(uniforms.alphaMin, settings.alpha_min);
    gl.uniform1f(uniforms.alphaMax, settings.alpha_max);
    gl.uniform1i(uniforms.degree, this.degree);
    gl.uniform1i(uniforms.geometry, 0);
    gl.uniform1i(uniforms.harmonics, 1);
    this.bind(0, this.geometry.texture);
    this.bind(1, this.harmonics.texture);
    gl.bindVertexArray(this.orderArray);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.visible);
    gl.activeTexture(gl.TEXTURE0);
  }

  // Far frusta first; those at the eye would hide the scene and are left away.
  drawFrusta(view, frusta, images) {
    const gl = this.gl, { uniforms } = this.overlay;
    this.usePose(this.overlay, view);
    gl.uniform1f(uniforms.near, this.settings.near);
    gl.bindVertexArray(this.frustumArray);
    const distance = ({ center }) => Math.hypot(...addScaled(center, view.center, -1));
    const shown = this.frusta.filter((frustum) => distance(frustum) > 2 * frustum.depth);
    for (const { start, lines, texture } of shown.sort((a, b) => distance(b) - distance(a))) {
      gl.uniform1i(uniforms.textured, images && texture ? 1 : 0);
      if (images && texture) {
        this.bind(0, texture);
        gl.drawArrays(gl.TRIANGLE_STRIP, start + lines, 4);
      }
      gl.uniform1i(uniforms.textured, 0);
      gl.uniform4f(uniforms.color, 1.0, 0.72, 0.2, 1.0);
      if (frusta) gl.drawArrays(gl.LINES, start, lines);
    }
  }
}
