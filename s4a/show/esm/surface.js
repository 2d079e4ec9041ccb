// Surfaces in the browser. One WebGL2 context draws all surfaces of the page, and the picture of a view is copied to its
// canvas, so that any number of views needs one context.

const VERTEX = `#version 300 es
in vec3 position, normal, color, coordinate;
uniform mat3 rotation;
uniform vec3 centre;
uniform vec4 viewport, ball;
uniform float depth;
out vec3 n, c, q;
void main() {
  vec3 p = rotation * ((ball.w > 0.0 ? ball.xyz + ball.w * position : position) - centre);
  n = rotation * normal;
  c = color;
  q = coordinate;
  gl_Position = vec4(p.xy * viewport.xy + viewport.zw, -p.z * depth, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 n, c, q;
uniform float opacity, cell;
out vec4 pixel;
void main() {
  vec3 base = c;
  if (cell > 0.0) { // a checkerboard of cubes in the space of the given coordinates
    vec3 at = floor(q / cell);
    base *= mod(at.x + at.y + at.z, 2.0) < 0.5 ? 1.0 : 0.5;
  }
  vec3 N = normalize(n) * (gl_FrontFacing ? 1.0 : -1.0);
  vec3 key = normalize(vec3(-0.42, 0.55, 0.72));
  float wrap = clamp((dot(N, key) + 0.3) / 1.3, 0.0, 1.0), sky = 0.5 + 0.5 * N.y;
  float silhouette = pow(clamp(1.0 - N.z, 0.0, 1.0), 3.0);
  float gloss = pow(clamp(dot(N, normalize(key + vec3(0.0, 0.0, 1.0))), 0.0, 1.0), 40.0);
  vec3 lit = base * (0.45 + 0.15 * sky + 0.52 * wrap) * (1.0 - 0.35 * silhouette) + 0.10 * gloss;
  pixel = vec4(clamp(lit, 0.0, 1.0) * opacity, opacity);
}`;
const CLAY = [0.8, 0.76, 0.7];
const ATTRIBUTES = ["position", "normal", "color", "coordinate"];

// The unit sphere: the normals are the vertices.
function ballMesh(rings = 10, around = 16) {
  const P = [], T = [];
  for (let i = 0; i <= rings; i++) for (let j = 0; j < around; j++) {
    const a = (Math.PI * i) / rings, b = (2 * Math.PI * j) / around;
    P.push(Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a));
    const here = i * around + j, next = i * around + ((j + 1) % around);
    if (i < rings) T.push(here, here + around, next, next, here + around, next + around);
  }
  return [new Float32Array(P), new Uint32Array(T)];
}

function shader(gl, kind, source) {
  const it = gl.createShader(kind);
  gl.shaderSource(it, source);
  gl.compileShader(it);
  return it;
}

// The context of the page, created at first use and again if it is lost; null without WebGL2.
function context() {
  const old = globalThis.s4aContext;
  if (old === null || (old && !old.gl.isContextLost())) return old;
  const gl = document.createElement("canvas").getContext("webgl2", { antialias: false, alpha: true });
  if (!gl) return (globalThis.s4aContext = null);
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl, gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, shader(gl, gl.FRAGMENT_SHADER, FRAGMENT));
  ATTRIBUTES.forEach((name, i) => gl.bindAttribLocation(program, i, name));
  gl.linkProgram(program);
  gl.useProgram(program);
  const at = {};
  for (const name of ["rotation", "centre", "viewport", "depth", "opacity", "ball", "cell"]) at[name] = gl.getUniformLocation(program, name);
  gl.enable(gl.DEPTH_TEST);
  return (globalThis.s4aContext = { gl, at });
}

// Normals of the vertices: the normalised sum of the area vectors of the adjacent triangles.
function normalsOf(P, T, N = new Float32Array(P.length)) {
  N.fill(0);
  for (let t = 0; t < T.length; t += 3) {
    const a = 3 * T[t], b = 3 * T[t + 1], c = 3 * T[t + 2];
    const ux = P[b] - P[a], uy = P[b + 1] - P[a + 1], uz = P[b + 2] - P[a + 2];
    const vx = P[c] - P[a], vy = P[c + 1] - P[a + 1], vz = P[c + 2] - P[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    N[a] += x; N[a + 1] += y; N[a + 2] += z;
    N[b] += x; N[b + 1] += y; N[b + 2] += z;
    N[c] += x; N[c + 1] += y; N[c + 2] += z;
  }
  for (let i = 0; i < N.length; i += 3) {
    const length = Math.hypot(N[i], N[i + 1], N[i + 2]) || 1;
    N[i] /= length; N[i + 1] /= length; N[i + 2] /= length;
  }
  return N;
}

class Surface {
  constructor(opacity = 1) {
    this.opacity = opacity;
    this.position = new Float32Array();
    this.corner = new Uint32Array();
    this.color = this.coordinate = null;
    this.cell = 0;
  }
  setMesh(position, corner) {
    this.corner = corner;
    this.color = this.coordinate = this.ring = null;
    this.cell = 0;
    this.setPosition(position);
  }
  setPosition(position) {
    this.position = position;
    this.normal = normalsOf(position, this.corner, this.normal?.length === position.length ? this.normal : undefined);
    this.stale = true;
  }
  setColor(color) {
    this.color = color && color.length === this.position.length ? color : null;
    this.stale = true;
  }
  setTexture(coordinate, cell) {
    this.coordinate = cell > 0 && coordinate && coordinate.length === this.position.length ? coordinate : null;
    this.cell = this.coordinate ? cell : 0;
    this.stale = true;
  }
  faceOf(vertex) { return Math.floor(this.corner.indexOf(vertex) / 3); }
  neighbours(vertex) { // from a table of the corners at every vertex, created at first use
    if (!this.ring) {
      const start = new Uint32Array(this.position.length / 3 + 1), T = this.corner;
      for (const v of T) start[v + 1]++;
      for (let v = 1; v < start.length; v++) start[v] += start[v - 1];
      const next = start.slice(), corners = new Uint32Array(T.length);
      T.forEach((v, i) => (corners[next[v]++] = i));
      this.ring = { start, corners };
    }
    const { start, corners } = this.ring, adjacent = new Set();
    for (let i = start[vertex]; i < start[vertex + 1]; i++) for (let m = 0; m < 3; m++) adjacent.add(this.corner[corners[i] - (corners[i] % 3) + m]);
    adjacent.delete(vertex);
    return [...adjacent];
  }
  upload(on) {
    const { gl } = on;
    if (this.on !== on) {
      this.on = on;
      this.array = gl.createVertexArray();
      this.buffers = [...ATTRIBUTES, "corner"].map(() => gl.createBuffer());
    }
    gl.bindVertexArray(this.array);
    [this.position, this.normal, this.color, this.coordinate].forEach((data, i) => {
      if (!data) return gl.disableVertexAttribArray(i);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[i]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, 3, data instanceof Uint8Array ? gl.UNSIGNED_BYTE : gl.FLOAT, data instanceof Uint8Array, 0, 0);
    });
    if (this.sent !== this.corner) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers[ATTRIBUTES.length]);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this.corner, gl.STATIC_DRAW);
      this.sent = this.corner;
    }
    this.stale = false;
  }
  draw(on) {
    const { gl, at } = on;
    if (this.on !== on) this.sent = null;
    if (this.stale || this.on !== on) this.upload(on);
    gl.bindVertexArray(this.array);
    gl.vertexAttrib3f(2, ...(this.tint || CLAY));
    gl.uniform1f(at.opacity, this.opacity);
    gl.uniform1f(at.cell, this.cell);
    gl.uniform4f(at.ball, ...(this.ball || [0, 0, 0, 0]));
    const triangles = () => gl.drawElements(gl.TRIANGLES, this.corner.length, gl.UNSIGNED_INT, 0);
    if (this.opacity < 1) { // first the depth alone, so that only the front is blended
      gl.colorMask(false, false, false, false);
      triangles();
      gl.colorMask(true, true, true, true);
      gl.depthFunc(gl.LEQUAL);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      triangles();
      gl.disable(gl.BLEND);
      gl.depthFunc(gl.LESS);
    } else triangles();
  }
  balls(on, points) { // [x, y, z, red, green, blue, radius] each
    for (const [x, y, z, r, g, b, radius] of points) {
      this.ball = [x, y, z, radius];
      this.tint = [r, g, b];
      this.draw(on);
    }
  }
  dispose() {
    if (!this.on) return;
    this.on.gl.deleteVertexArray(this.array);
    this.buffers.forEach((buffer) => this.on.gl.deleteBuffer(buffer));
    this.on = null;
  }
}
