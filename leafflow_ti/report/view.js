/* The surface in 3D. Coordinates are those of the camera (X right, Y down, Z away), drawn as x = X, y = -Y, z = -Z. */

const VERTEX = `#version 300 es
in vec3 point; in vec3 normal; in vec2 place;
uniform mat3 turn; uniform vec3 middle; uniform vec2 move; uniform vec2 zoom; uniform float depth; uniform float swell;
out vec3 facing; out vec2 at;
void main() {
  vec3 p = turn * (point + swell * normal - middle);
  facing = turn * normal;
  at = place;
  gl_Position = vec4((p.xy + move) * zoom, -p.z * depth, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 facing; in vec2 at;
uniform sampler2D colours; uniform vec4 paint;
out vec4 colour;
void main() {
  vec4 seen = paint.a > 0.5 ? paint : texture(colours, at);
  if (seen.a < 0.5) seen = vec4(0.62, 0.64, 0.63, 1.0); // no value
  float light = length(facing) > 0.0 ? abs(dot(normalize(facing), normalize(vec3(-0.3, 0.45, 0.85)))) : 1.0;
  colour = vec4(seen.rgb * (0.68 + 0.32 * light), seen.a);
}`;

/** Vertices of a frame in space, and where they lie in its images. */
async function surfaceOf(data, index) {
  const frame = data.frames[index], [columns, rows, x0, y0, pitch] = data.grid, [focal, px, py] = data.camera;
  const [pixels, depths, triangles] = await Promise.all([
    unpacked(frame.pixels, Uint32Array, 1), unpacked(frame.depths, Uint16Array, 1), unpacked(frame.triangles, Uint32Array, 3),
  ]);
  const points = new Float32Array(3 * pixels.length), places = new Float32Array(2 * pixels.length);
  pixels.forEach((pixel, i) => {
    const column = pixel % columns, row = Math.floor(pixel / columns), z = data.depth[0] + depths[i] * data.depth[1];
    points.set([((x0 + pitch * column - px) / focal) * z, (-(y0 + pitch * row - py) / focal) * z, -z], 3 * i);
    places.set([(column + 0.5) / columns, (row + 0.5) / rows], 2 * i);
  });
  const surface = { points, places, triangles, normals: normalsOf(points, triangles), tails: [], motion: [] };
  if (frame.tails) {
    const tails = await unpacked(frame.tails, Uint32Array, 1);
    const motion = new Int16Array((await unpacked(frame.arrows, Uint16Array, 3)).buffer);
    surface.tails = [...tails].flatMap((i) => [...points.subarray(3 * i, 3 * i + 3)]);
    surface.motion = [...motion].map((value, i) => (i % 3 ? -value : value) * data.step);
  }
  return surface;
}

/** Shows the surfaces of `data` on a canvas: show(frame), paint(image), arrows(on, stretch), home(). */
class SurfaceView {
  constructor(canvas, data, onDraw) {
    const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true }); // kept: for saving, printing
    if (!gl || typeof DecompressionStream === "undefined") throw new Error("WebGL 2 or DecompressionStream is missing");
    Object.assign(this, { canvas, data, gl, onDraw, cache: new Map(), pending: false });
    this.program = this.compiled();
    this.uniform = Object.fromEntries(
      ["turn", "middle", "move", "zoom", "depth", "swell", "paint"].map((name) => [name, gl.getUniformLocation(this.program, name)]));
    this.mesh = this.layout();
    this.shafts = this.layout();
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (const [key, value] of [[gl.TEXTURE_MIN_FILTER, gl.NEAREST], [gl.TEXTURE_MAG_FILTER, gl.NEAREST],
      [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) gl.texParameteri(gl.TEXTURE_2D, key, value);
    const [x, y, z, radius] = data.view;
    Object.assign(this, { middle: [x, -y, -z], radius, withArrows: true, stretch: 0, indices: 0, corners: 0 });
    this.home();
    this.listen();
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  compiled() {
    const gl = this.gl, program = gl.createProgram();
    for (const [type, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    ["point", "normal", "place"].forEach((name, i) => gl.bindAttribLocation(program, i, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  layout() {
    const gl = this.gl, found = { array: gl.createVertexArray(), buffers: [0, 1, 2].map(() => gl.createBuffer()), index: gl.createBuffer() };
    gl.bindVertexArray(found.array);
    [3, 3, 2].forEach((size, i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, found.buffers[i]);
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, size, gl.FLOAT, false, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, found.index);
    gl.bindVertexArray(null);
    return found;
  }

  fill(layout, arrays) {
    const gl = this.gl;
    arrays.forEach((values, i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, layout.buffers[i]);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    });
  }

  async show(index) {
    this.wanted = index;
    if (!this.cache.has(index)) this.cache.set(index, surfaceOf(this.data, index));
    const surface = await this.cache.get(index);
    if (this.wanted !== index) return; // the slider has moved on
    const gl = this.gl;
    this.surface = surface;
    this.fill(this.mesh, [surface.points, surface.normals, surface.places]);
    gl.bindVertexArray(this.mesh.array);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, surface.triangles, gl.DYNAMIC_DRAW);
    gl.bindVertexArray(null);
    this.indices = surface.triangles.length;
    this.setArrows();
  }

  /** The image whose pixels colour the surface. */
  paint(image) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    this.redraw();
  }

  arrows(on, stretch) {
    Object.assign(this, { withArrows: on, stretch });
    this.setArrows();
  }

  /** Length of an arrow [mm] for a motion of 1 mm/frame. */
  get magnification() {
    const typical = this.data.speed > 0 ? (0.25 * this.radius) / this.data.speed : 1;
    const power = 10 ** Math.floor(Math.log10(typical)), lead = typical / power;
    return (lead >= 5 ? 5 : lead >= 2 ? 2 : 1) * power * 2 ** this.stretch;
  }

  setArrows() {
    if (!this.surface) return;
    const spans = this.surface.motion.map((v) => v * this.magnification);
    const [points, normals] = arrowTriangles(this.surface.tails, spans, 0.0055 * this.radius);
    this.corners = points.length / 3;
    this.fill(this.shafts, [points, normals, new Float32Array(2 * this.corners)]);
    this.redraw();
  }

  home() {
    Object.assign(this, { yaw: 0.5, pitch: 0.42, move: [0, 0], magnify: 1 });
    this.redraw();
  }

  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.draw();
    });
  }

  /** Pixels of the page per mm. */
  get scale() {
    return (this.magnify * 0.5 * Math.min(this.canvas.clientWidth, this.canvas.clientHeight)) / this.radius;
  }

  draw() {
    const { gl, canvas, uniform } = this, density = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(canvas.clientWidth * density), Math.round(canvas.clientHeight * density)];
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.program);
    gl.uniformMatrix3fv(uniform.turn, true, turned(this.yaw, this.pitch));
    gl.uniform3fv(uniform.middle, this.middle);
    gl.uniform2fv(uniform.move, this.move);
    gl.uniform2f(uniform.zoom, (2 * this.scale) / canvas.clientWidth, (2 * this.scale) / canvas.clientHeight);
    gl.uniform1f(uniform.depth, 0.1 / this.radius);
    gl.uniform4f(uniform.paint, 0, 0, 0, 0);
    gl.uniform1f(uniform.swell, 0);
    gl.bindVertexArray(this.mesh.array);
    gl.drawElements(gl.TRIANGLES, this.indices, gl.UNSIGNED_INT, 0);
    if (this.withArrows && this.corners) this.drawArrows();
    gl.bindVertexArray(null);
    this.onDraw(this);
  }

  /** Dark arrows with a light rim, which is the inside of slightly thicker ones; faint where the surface hides them. */
  drawArrows() {
    const { gl, uniform } = this, rim = (0.003 * this.radius) / Math.sqrt(this.magnify);
    const pass = (grey, opacity, side, swell) => {
      gl.cullFace(side);
      gl.uniform1f(uniform.swell, swell);
      gl.uniform4f(uniform.paint, grey, grey, grey, opacity);
      gl.drawArrays(gl.TRIANGLES, 0, this.corners);
    };
    gl.bindVertexArray(this.shafts.array);
    gl.enable(gl.CULL_FACE);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    gl.depthFunc(gl.GREATER);
    pass(0.12, 0.55, gl.BACK, 0);
    gl.depthMask(true);
    gl.depthFunc(gl.LESS);
    gl.disable(gl.BLEND);
    pass(1.35, 1, gl.FRONT, rim);
    pass(0.12, 1, gl.BACK, 0);
    gl.disable(gl.CULL_FACE);
  }

  turnBy(dx, dy) {
    this.yaw += dx;
    this.pitch = Math.max(-1.57, Math.min(1.57, this.pitch + dy));
    this.redraw();
  }

  moveBy(dx, dy) {
    this.move = [this.move[0] + dx / this.scale, this.move[1] - dy / this.scale];
    this.redraw();
  }

  zoomBy(factor) {
    this.magnify = Math.max(0.2, Math.min(40, this.magnify * factor));
    this.redraw();
  }

  listen() {
    const { canvas } = this, held = new Map();
    const between = () => {
      const [a, b] = [...held.values()];
      return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) || 1 };
    };
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
    });
    canvas.addEventListener("pointermove", (e) => {
      const last = held.get(e.pointerId);
      if (!last) return;
      const before = held.size > 1 ? between() : null;
      const [dx, dy] = [e.clientX - last.x, e.clientY - last.y];
      held.set(e.pointerId, { x: e.clientX, y: e.clientY });
      if (before) {
        const after = between();
        this.zoomBy(after.apart / before.apart);
        this.moveBy(after.x - before.x, after.y - before.y);
      } else if (e.shiftKey) this.moveBy(dx, dy);
      else this.turnBy(dx * 0.008, dy * 0.008);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => held.delete(e.pointerId));
    canvas.addEventListener("wheel", (e) => {
      if (document.activeElement !== canvas && !e.ctrlKey) return; // else the page could not be scrolled past
      e.preventDefault();
      this.zoomBy(Math.exp(-e.deltaY * 0.0015));
    }, { passive: false });
    const keys = {
      ArrowLeft: () => this.turnBy(-0.1, 0), ArrowRight: () => this.turnBy(0.1, 0),
      ArrowUp: () => this.turnBy(0, -0.1), ArrowDown: () => this.turnBy(0, 0.1),
      "+": () => this.zoomBy(1.2), "=": () => this.zoomBy(1.2), "-": () => this.zoomBy(1 / 1.2), 0: () => this.home(),
    };
    canvas.addEventListener("keydown", (e) => {
      if (!keys[e.key] || e.ctrlKey || e.metaKey || e.altKey) return;
      e.preventDefault();
      keys[e.key]();
    });
  }
}
