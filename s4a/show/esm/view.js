// Views with one camera name share a camera, also between widgets.
function camera(name, rotation) {
  const all = (globalThis.s4aCameras ??= new Map());
  const shared = (name && all.get(name)) || { views: new Set(), home: [...rotation], rotation: [...rotation], zoom: 1, pan: [0, 0] };
  if (name) all.set(name, shared);
  return shared;
}

// The pointers that are pressed anywhere in the page: during a drag on a view, or of a slider.
const pressed = (globalThis.s4aPressed ??= (() => {
  const down = new Set();
  const up = (e) => {
    if (e.type === "blur") down.clear();
    down.delete(e.pointerId);
    document.querySelectorAll("canvas.s4a-view").forEach(({ view }) => view?.due && view.redraw());
  };
  addEventListener("pointerdown", (e) => down.add(e.pointerId), true);
  for (const end of ["pointerup", "pointercancel", "blur"]) addEventListener(end, up, true);
  return down;
})());

function boxOf(P) {
  const low = [Infinity, Infinity, Infinity], high = low.map((x) => -x);
  for (let i = 0; i < P.length; i++) {
    low[i % 3] = Math.min(low[i % 3], P[i]);
    high[i % 3] = Math.max(high[i % 3], P[i]);
  }
  return { low, high, centre: low.map((x, i) => (x + high[i]) / 2) };
}

function radiusOf(P, centre) {
  let r2 = 0;
  for (let i = 0; i < P.length; i += 3) r2 = Math.max(r2, (P[i] - centre[0]) ** 2 + (P[i + 1] - centre[1]) ** 2 + (P[i + 2] - centre[2]) ** 2);
  return Math.sqrt(r2);
}

// The buttons in a corner of a view; others are added by `add(text, act, help)`. The tooltip is the help and the name of the
// surface, so that the buttons of a panel have different names.
function toolbar(view) {
  const row = html(view.box, "div", { class: "s4a-toolbar", role: "group" }), helps = new Map();
  let label = "surface";
  const setTooltip = (help, it) => { it.title = `${help}: ${label}`; it.setAttribute("aria-label", it.title); };
  const add = (text, act, help, more = {}) => {
    const it = html(row, "button", { type: "button", ...more }, text);
    it.addEventListener("click", act);
    helps.set(it, help);
    setTooltip(help, it);
    return it;
  };
  const name = (now) => {
    label = now;
    row.setAttribute("aria-label", `view of ${label}`);
    helps.forEach(setTooltip);
  };
  add("+", () => view.scale(1.25), "zoom in");
  add("−", () => view.scale(1 / 1.25), "zoom out");
  add("⟲", () => view.reset(), "reset the view");
  add("Save", () => openSaveDialog(view), "save a picture or a film");
  return { row, add, name };
}

class View {
  constructor(parent, { rotation, group = "", height = 360, label = "surface", onPick, onHover, onLasso }) {
    Object.assign(this, { surfaces: [], points: [], cursor: -1, lasso: false, path: null, onPick: onPick || null, onHover: onHover || null, onLasso, group });
    this.ball = new Surface();
    this.ball.setMesh(...ballMesh());
    this.box = html(parent, "div", { class: "s4a-surface" });
    this.canvas = html(this.box, "canvas", { class: "s4a-view", tabindex: 0, role: onPick ? "application" : "img" });
    this.canvas.view = this;
    this.canvas.style.height = `${height / 13}em`; // relative to the font size, as everything in a panel
    this.toolbar = toolbar(this);
    this.finger = this.toolbar.add("Turn", () => {
      this.camera.touch = !this.camera.touch;
      this.camera.views.forEach((view) => view.updateTouch());
    }, "one finger rotates the surface instead of scrolling the page", { class: "s4a-finger" });
    this.camera = camera(group, rotation);
    this.camera.views.add(this);
    this.name(label);
    this.updateTouch();
    this.observer = new ResizeObserver(() => this.redraw());
    this.observer.observe(this.canvas);
    this.listen();
  }
  name(label) {
    if (label === this.label) return;
    this.label = label;
    const choose = this.onPick ? ", C starts a cursor that the arrow keys move over the surface, with shift by one edge, Enter picks its vertex, Escape ends it" : "";
    this.canvas.setAttribute("aria-label", `${label}: drag or arrow keys rotate, wheel or + and - zoom, shift and drag pan, two fingers zoom and pan, 0 resets${choose}`);
    this.toolbar.name(label);
  }
  moved() { this.camera.views.forEach((view) => view.redraw()); }
  updateTouch() { // one finger rotates or scrolls the page; two always zoom and pan
    this.canvas.style.touchAction = this.camera.touch || this.lasso ? "none" : "";
    this.finger.setAttribute("aria-pressed", Boolean(this.camera.touch));
  }
  listen() {
    const canvas = this.canvas, fingers = new Map(), position = (e) => [e.clientX, e.clientY];
    let last = null, travel = 0;
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      if (e.pointerType === "touch") {
        fingers.set(e.pointerId, position(e));
        if (fingers.size > 1) return (last = this.path = null);
      } else canvas.focus({ preventScroll: true });
      if (this.lasso && this.frame && !e.shiftKey) return (this.path = [this.plane(e)]);
      last = position(e);
      travel = 0;
    });
    canvas.addEventListener("pointermove", (e) => {
      if (this.path) return this.path.push(this.plane(e)), this.redraw();
      if (fingers.has(e.pointerId)) {
        const before = [...fingers.values()];
        fingers.set(e.pointerId, position(e));
        if (before.length === 2) return this.pinch(before, [...fingers.values()]);
      }
      if (!last) return e.pointerType !== "touch" && this.onHover?.(this.pick(e));
      const dx = e.clientX - last[0], dy = e.clientY - last[1];
      last = position(e);
      travel += Math.abs(dx) + Math.abs(dy);
      if (e.pointerType === "touch" && !this.camera.touch) return;
      if (e.shiftKey || e.buttons > 1) this.shift(dx, dy);
      else this.rotate(dx * 0.01, dy * 0.01);
    });
    canvas.addEventListener("pointerup", (e) => {
      fingers.delete(e.pointerId);
      if (this.path) {
        const polygon = this.path;
        this.path = null;
        if (polygon.length > 2) this.onLasso?.({ polygon, rotation: [...this.camera.rotation] });
        return this.redraw();
      }
      if (last && travel < (e.pointerType === "touch" ? 12 : 4)) {
        canvas.focus({ preventScroll: true });
        this.onPick?.(this.pick(e));
      }
      last = null;
    });
    canvas.addEventListener("pointercancel", (e) => { // the page scrolls
      fingers.delete(e.pointerId);
      last = this.path = null;
    });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("dblclick", () => this.reset());
    canvas.addEventListener("wheel", (e) => {
      if (canvas.getRootNode().activeElement !== canvas) return; // the wheel scrolls the page unless the view has the focus
      e.preventDefault();
      this.scale(Math.exp(-0.0015 * e.deltaY));
    }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const direction = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
      const act = (this.cursor >= 0 && {
        Enter: () => this.onPick(this.hit(this.cursor)), " ": () => this.onPick(this.hit(this.cursor)), Escape: () => this.moveCursor(-1),
        ...(direction && { [e.key]: () => this.walk(...direction, e.shiftKey) }),
      }[e.key]) || (this.onPick && { c: () => this.start(), C: () => this.start() }[e.key]) || {
        ArrowLeft: () => this.rotate(-0.1, 0), ArrowRight: () => this.rotate(0.1, 0),
        ArrowUp: () => this.rotate(0, -0.1), ArrowDown: () => this.rotate(0, 0.1),
        "+": () => this.scale(1.1), "=": () => this.scale(1.1), "-": () => this.scale(1 / 1.1), 0: () => this.reset(),
      }[e.key];
      if (!act || e.ctrlKey || e.metaKey) return;
      e.preventDefault();
      e.stopPropagation();
      act();
    });
  }
  // Start the cursor: a vertex of the first surface, moved by the arrow keys.
  start() {
    const surface = this.surfaces[0], R = this.camera.rotation;
    if (!surface?.position.length || !this.frame) return;
    const { w, h } = this.placement(), box = this.canvas.getBoundingClientRect();
    const middle = this.pick({ clientX: box.left + w / 2, clientY: box.top + h / 2 });
    if (middle) return this.moveCursor(middle.vertex);
    let best = 0, nearest = -Infinity; // nothing is in the middle: the vertex nearest to the viewer
    for (let i = 0, P = surface.position; i < P.length; i += 3) {
      const z = R[6] * P[i] + R[7] * P[i + 1] + R[8] * P[i + 2];
      if (z > nearest) [nearest, best] = [z, i / 3];
    }
    this.moveCursor(best);
  }
  moveCursor(vertex) {
    this.cursor = vertex;
    if (vertex >= 0) this.onHover?.(this.hit(vertex));
    this.canvas.dataset.cursor = vertex;
    this.redraw();
  }
  at(vertex) { return Array.from(this.surfaces[0].position.subarray(3 * vertex, 3 * vertex + 3)); }
  hit(vertex) {
    const face = this.surfaces[0].faceOf(vertex);
    return { vertex, face, weights: [0, 1, 2].map((m) => +(this.surfaces[0].corner[3 * face + m] === vertex)), point: this.at(vertex) };
  }
  walk(x, y, fine) { // along edges, by 3 % of the radius or one edge; the surface rotates when the cursor reaches its back
    const surface = this.surfaces[0], R = this.camera.rotation, dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const d = [0, 1, 2].map((i) => x * R[i] + y * R[3 + i]);
    let here = this.cursor, walked = 0;
    while (walked < 0.03 * this.frame.radius) {
      const N = Array.from(surface.normal.subarray(3 * here, 3 * here + 3)), P = this.at(here), along = d.map((v, i) => v - dot(d, N) * N[i]);
      let best = -1, most = 0.3 * Math.hypot(...along), length = 0;
      for (const v of surface.neighbours(here)) {
        const e = this.at(v).map((p, i) => p - P[i]), long = Math.hypot(...e) || 1;
        if (dot(e, along) / long > most) [best, most, length] = [v, dot(e, along) / long, long];
      }
      if (best < 0) break;
      here = best;
      walked += length;
      if (fine) break;
    }
    if (dot(Array.from(surface.normal.subarray(3 * here, 3 * here + 3)), R.slice(6)) < 0.35) this.rotate(-0.2 * x, 0.2 * y);
    this.moveCursor(here);
  }
  rotate(a, b) {
    const [r, u, t] = [0, 3, 6].map((i) => this.camera.rotation.slice(i, i + 3));
    const mix = (x, y, c, s) => x.map((v, i) => c * v + s * y[i]);
    const right = mix(r, t, Math.cos(a), Math.sin(a)), side = mix(t, r, Math.cos(a), -Math.sin(a));
    this.camera.rotation = [...right, ...mix(u, side, Math.cos(b), -Math.sin(b)), ...mix(side, u, Math.cos(b), Math.sin(b))];
    this.moved();
  }
  shift(dx, dy) {
    const { clientWidth: w, clientHeight: h } = this.canvas, [x, y] = this.camera.pan;
    this.camera.pan = [x + dx / Math.min(w, h), y - dy / Math.min(w, h)];
    this.moved();
  }
  pinch(before, now) { // the points under two fingers stay under them
    const box = this.canvas.getBoundingClientRect(), size = Math.min(box.width, box.height);
    const middle = ([a, b]) => [(a[0] + b[0]) / 2 - box.left - box.width / 2, box.top + box.height / 2 - (a[1] + b[1]) / 2].map((v) => v / size);
    const spacing = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1, zoom = this.camera.zoom, from = middle(before), to = middle(now);
    this.scale(spacing(now) / spacing(before));
    this.camera.pan = this.camera.pan.map((p, i) => to[i] - ((from[i] - p) * this.camera.zoom) / zoom);
  }
  scale(factor) {
    this.camera.zoom = Math.min(40, Math.max(0.2, this.camera.zoom * factor));
    this.moved();
  }
  reset(rotation = this.camera.home) {
    Object.assign(this.camera, { home: [...rotation], rotation: [...rotation], zoom: 1, pan: [0, 0] });
    this.moved();
  }
  fit(P, reach = 0) { // the bounding sphere around the centre of the bounding box, or a larger one
    const centre = boxOf(P).centre;
    this.frame = { centre, radius: Math.max(radiusOf(P, centre), reach) || 1 };
  }
  widen(P) { // enlarge the sphere to contain a surface
    this.frame.radius = Math.max(this.frame.radius, radiusOf(P, this.frame.centre));
  }
  placement() {
    const { clientWidth: w, clientHeight: h } = this.canvas, { zoom, pan } = this.camera, half = Math.min(w, h) / 2;
    const scale = (0.97 * zoom * half) / this.frame.radius;
    return { w, h, scale, x: 2 * half * pan[0], y: 2 * half * pan[1] };
  }
  middle() { // of the frame, in the plane of the view
    const R = this.camera.rotation, c = this.frame.centre;
    return [0, 3].map((i) => R[i] * c[0] + R[i + 1] * c[1] + R[i + 2] * c[2]);
  }
  plane(e) { // the position under the pointer, in the plane of the view and the unit of the surface
    const box = this.canvas.getBoundingClientRect(), { w, h, scale, x, y } = this.placement(), [u, v] = this.middle();
    return [(e.clientX - box.left - w / 2 - x) / scale + u, (h / 2 - (e.clientY - box.top) - y) / scale + v];
  }
  drawLasso(ratio) { // the lasso while it is drawn
    const on = this.canvas.getContext("2d"), { w, h, scale, x, y } = this.placement(), [u, v] = this.middle();
    on.beginPath();
    for (const [a, b] of this.path) on.lineTo(ratio * (w / 2 + x + scale * (a - u)), ratio * (h / 2 - y - scale * (b - v)));
    on.closePath();
    Object.assign(on, { strokeStyle: "#d55e00", lineWidth: 2 * ratio });
    on.stroke();
  }
  redraw() { // at once; with twice the resolution when nothing moves and no pointer is pressed
    clearTimeout(this.resting);
    this.resting = setTimeout(() => this.rest(), Math.max(150, 4 * (this.took || 0)));
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => { this.waiting = 0; this.draw(); });
  }
  rest() { // a smooth frame of a large surface is slow, so not during a drag
    this.due = pressed.size > 0;
    if (!this.due) this.draw(2);
  }
  // Render a tile of the view, which has W by H pixels, into the lower left corner of the context.
  render(on, [W, H], [left, top, width, height], ground, { surfaces = this.surfaces, rotation = this.camera.rotation } = {}) {
    const { gl, at } = on, { w, h, scale, x, y } = this.placement(), across = W / width, down = H / height;
    if (gl.canvas.width < width) gl.canvas.width = width;
    if (gl.canvas.height < height) gl.canvas.height = height;
    gl.viewport(0, 0, width, height);
    gl.clearColor(...ground);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix3fv(at.rotation, true, rotation);
    gl.uniform3f(at.centre, ...this.frame.centre);
    const right = ((2 * x) / w) * across + (W - 2 * left) / width - 1, up = ((2 * y) / h) * down - (H - 2 * top) / height + 1;
    gl.uniform4f(at.viewport, ((2 * scale) / w) * across, ((2 * scale) / h) * down, right, up);
    gl.uniform1f(at.depth, 1 / (4 * this.frame.radius));
    [...surfaces].sort((a, b) => b.opacity - a.opacity).forEach((surface) => surface.draw(on));
    this.ball.balls(on, this.points);
  }
  // Paint the view, without background, into a box of another canvas: in tiles of twice its pixels, as 4K needs a large context.
  paint(target, [left, top, width, height], options) {
    const on = context(), { canvas } = on.gl, most = 1024;
    for (let y = 0; y < height; y += most) for (let x = 0; x < width; x += most) {
      const w = Math.min(most, width - x), h = Math.min(most, height - y);
      this.render(on, [2 * width, 2 * height], [2 * x, 2 * y, 2 * w, 2 * h], [0, 0, 0, 0], options);
      target.drawImage(canvas, 0, canvas.height - 2 * h, 2 * w, 2 * h, left + x, top + y, w, h);
    }
  }
  draw(smooth = 1) {
    const on = context(), { w, h } = this.frame && this.canvas.clientWidth ? this.placement() : {};
    if (!on || !w || !this.surfaces.length) return;
    const start = performance.now(), { gl } = on, ratio = Math.min(2, globalThis.devicePixelRatio || 1);
    const width = Math.round(w * ratio), height = Math.round(h * ratio), W = smooth * width, H = smooth * height;
    this.render(on, [W, H], [0, 0, W, H], [1, 1, 1, 1]); // a white background, so that colours are the same in every theme
    if (this.cursor >= 0 && 3 * this.cursor < this.surfaces[0].position.length) this.ball.balls(on, [[...this.at(this.cursor), 0.84, 0.37, 0, 0.018 * this.frame.radius]]);
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    this.canvas.getContext("2d").drawImage(gl.canvas, 0, gl.canvas.height - H, W, H, 0, 0, width, height);
    if (this.path) this.drawLasso(ratio);
    if (smooth === 1) this.took = performance.now() - start;
    else this.smooth = (this.smooth || 0) + 1;
    this.frames = (this.frames || 0) + 1;
  }
  // The point of the first surface under the pointer: triangle, barycentric weights, nearest corner and position; null for none.
  pick(e) {
    const surface = this.surfaces[0], box = this.canvas.getBoundingClientRect();
    if (!surface || !this.frame || !this.canvas.clientWidth) return null;
    const { w, h, scale, x, y } = this.placement(), R = this.camera.rotation, c = this.frame.centre;
    const px = (e.clientX - box.left - w / 2 - x) / scale, py = (h / 2 - (e.clientY - box.top) - y) / scale;
    const { position: P, corner: T } = surface, n = P.length / 3;
    const U = new Float32Array(n), V = new Float32Array(n), Z = new Float32Array(n);
    for (let i = 0, j = 0; i < n; i++, j += 3) {
      const a = P[j] - c[0], b = P[j + 1] - c[1], d = P[j + 2] - c[2];
      U[i] = R[0] * a + R[1] * b + R[2] * d - px;
      V[i] = R[3] * a + R[4] * b + R[5] * d - py;
      Z[i] = R[6] * a + R[7] * b + R[8] * d;
    }
    let best = null, depth = -Infinity;
    for (let t = 0; t < T.length; t += 3) {
      const i = T[t], j = T[t + 1], k = T[t + 2];
      const wi = U[j] * V[k] - U[k] * V[j], wj = U[k] * V[i] - U[i] * V[k], wk = U[i] * V[j] - U[j] * V[i];
      if (!((wi >= 0 && wj >= 0 && wk >= 0) || (wi <= 0 && wj <= 0 && wk <= 0))) continue;
      const sum = wi + wj + wk;
      if (!sum) continue;
      const z = (wi * Z[i] + wj * Z[j] + wk * Z[k]) / sum;
      if (z > depth) [depth, best] = [z, { face: t / 3, weights: [wi / sum, wj / sum, wk / sum] }];
    }
    if (!best) return null;
    const corners = [0, 1, 2].map((m) => T[3 * best.face + m]);
    best.vertex = corners[best.weights.indexOf(Math.max(...best.weights))];
    best.point = [0, 1, 2].map((m) => corners.reduce((s, v, q) => s + best.weights[q] * P[3 * v + m], 0));
    return best;
  }
  dispose() {
    this.observer.disconnect();
    cancelAnimationFrame(this.waiting);
    clearTimeout(this.resting);
    this.camera.views.delete(this);
    if (!this.camera.views.size && this.group) globalThis.s4aCameras.delete(this.group);
    [...this.surfaces, this.ball].forEach((surface) => surface.dispose());
    this.box.remove();
  }
}
