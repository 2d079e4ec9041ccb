// The mean shape moved along its modes, wholly in the browser: p = mean + sum of score times deformation.
class Modes {
  constructor(model) {
    this.model = model;
    this.load();
  }
  load() {
    const get = (name) => this.model.get(name);
    this.mean = numbers(Float32Array, get("mean"));
    this.corner = numbers(Uint32Array, get("corner"));
    this.deformation = numbers(Float32Array, get("deformation"));
    this.normal = normalsOf(this.mean, this.corner);
    this.reach = this.far(3);
    this.palettes = { normal: numbers(Uint8Array, get("signed_palette")), magnitude: numbers(Uint8Array, get("ramp_palette")) };
    this.own = numbers(Uint8Array, get("own"));
    this.limits = { normal: get("limit"), magnitude: get("limit_magnitude") };
  }
  positions(scores, out = new Float32Array(this.mean.length)) {
    out.set(this.mean);
    scores.forEach((score, c) => {
      if (!score) return;
      const start = c * out.length, D = this.deformation;
      for (let i = 0; i < out.length; i++) out[i] += score * D[start + i];
    });
    return out;
  }
  // How far from the mean's centre each mode alone takes the surface, at so many standard deviations to either side.
  far(sigma) {
    const M = this.mean, D = this.deformation, centre = boxOf(M).centre;
    let r2 = 0;
    for (let start = 0; start < D.length; start += M.length) {
      for (let i = 0; i < M.length; i += 3) {
        let there = 0, along = 0, moved = 0;
        for (let x = 0; x < 3; x++) {
          const p = M[i + x] - centre[x], d = sigma * D[start + i + x];
          there += p * p; along += p * d; moved += d * d;
        }
        r2 = Math.max(r2, there + 2 * Math.abs(along) + moved);
      }
    }
    return Math.sqrt(r2);
  }
  colors(P, kind, out) {
    if (kind === "own" && this.own) return out.set(this.own), out;
    const palette = this.palettes[kind];
    if (!palette) return null;
    const M = this.mean, N = this.normal, limit = this.limits[kind];
    for (let i = 0; i < P.length; i += 3) {
      const x = P[i] - M[i], y = P[i + 1] - M[i + 1], z = P[i + 2] - M[i + 2];
      const value = kind === "normal" ? 0.5 + (0.5 * (x * N[i] + y * N[i + 1] + z * N[i + 2])) / limit : Math.hypot(x, y, z) / limit;
      const at = 3 * Math.round(255 * Math.min(1, Math.max(0, value)));
      out[i] = palette[at]; out[i + 1] = palette[at + 1]; out[i + 2] = palette[at + 2];
    }
    return out;
  }
  show(surface, scores, kind) {
    const size = this.mean.length, fresh = surface.corner !== this.corner;
    const P = this.positions(scores, fresh ? undefined : surface.position);
    surface.corner = this.corner;
    surface.setPosition(P);
    surface.setColor(this.colors(P, kind, surface.color?.length === size ? surface.color : new Uint8Array(size)));
  }
}

function modesWidget({ model, el }) {
  el.classList.add("s4a");
  ownKeys(el);
  const modes = new Modes(model), ratio = model.get("ratio"), count = ratio.length, range = 3;
  let current = [...model.get("scores")]; // ahead of the model's while a slider moves
  const scores = () => [...current];
  const box = html(el, "div", { class: "s4a-modes" }), left = html(box, "div"), right = html(box, "div");
  const views = html(left, "div", { class: "s4a-views" }), bar = html(left, "div"), still = html(left, "img", { class: "s4a-still", hidden: "" });
  let active = 0, shown = [], timer = 0, playing = 0, crosshair = null;
  el.modes = modes;

  const tell = (name, value) => { model.set(name, value); model.save_changes(); };
  const set = (values, last = active) => {
    active = last;
    current = [...values];
    update();
    timer ||= setTimeout(() => { timer = 0; tell("scores", current); }, 100); // ten messages a second at most
  };
  const told = () => { // an answer to an earlier message must not move the slider back
    if (timer || model.get("scores").every((s, c) => s === current[c])) return;
    current = [...model.get("scores")];
    update();
  };
  const buttons = html(right, "div", { class: "s4a-buttons" });
  const button = (text, act, help) => {
    const it = html(buttons, "button", { type: "button", title: help }, text);
    it.addEventListener("click", act);
    return it;
  };
  button("Reset", () => set(scores().fill(0)), "all scores to 0: the mean shape");
  const play = button("Play", () => toggle(), "moves the marked mode back and forth");
  const threeButton = button("−3 · mean · +3", () => tell("side_by_side", !model.get("side_by_side")), "the marked mode at both ends, side by side");
  button("Random", () => set(scores().map(() => {
    let z = range + 1; // one normal number each, those beyond the sliders drawn again
    while (Math.abs(z) > range) z = Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
    return Math.round(100 * z) / 100;
  })), "a plausible shape: scores drawn from the normal distribution");
  const kinds = html(buttons, "select", { "aria-label": "colours", title: "colour: how far a place moved from the mean, along its normal or at all" });
  for (const [value, text] of [["normal", "along the normal"], ["magnitude", "distance"], ["none", "no colours"], ...(model.get("own")?.byteLength ? [["own", "of each part"]] : [])]) html(kinds, "option", { value }, text);
  kinds.addEventListener("change", () => tell("colors", kinds.value));
  const sliders = html(right, "div", { class: "s4a-sliders" });
  const rows = ratio.map((share, c) => {
    const row = html(sliders, "label", { class: "s4a-slider", title: `component ${c + 1}: ${(100 * share).toFixed(1)} % of the variance; the slider is its score, in standard deviations (σ)` });
    html(row, "span", {}, `PC${c + 1} · ${(100 * share).toFixed(1)} %`);
    const input = html(row, "input", { type: "range", min: -range, max: range, step: 0.05, "aria-label": `component ${c + 1} in standard deviations` });
    const output = html(row, "output", {}, "0.00");
    input.addEventListener("input", () => { const s = scores(); s[c] = Number(input.value); set(s, c); });
    input.addEventListener("focus", () => { active = c; mark(); });
    input.addEventListener("keydown", (e) => e.stopPropagation()); // where the notebook hears keys after the slider
    return { row, input, output };
  });
  const distance = html(right, "div", { class: "s4a-readout", "aria-live": "polite" });
  const charts = html(box, "div", { class: "s4a-charts" }), scorePart = html(charts, "div"), variancePart = html(charts, "div");

  const mark = () => rows.forEach(({ row }, c) => row.classList.toggle("s4a-active", c === active));
  const toggle = (on = !playing) => {
    cancelAnimationFrame(playing);
    playing = 0;
    play.textContent = on ? "Stop" : "Play";
    if (!on) return;
    const start = performance.now(), from = Math.asin(Math.max(-1, Math.min(1, (scores()[active] || 0) / range)));
    const step = (now) => {
      if (!el.isConnected) return toggle(false);
      const s = scores();
      s[active] = Math.round(100 * range * Math.sin(from + (now - start) / 700)) / 100;
      set(s);
      playing = requestAnimationFrame(step);
    };
    playing = requestAnimationFrame(step);
  };
  // What a film shows: the marked mode from one end to the other, the others as they stand.
  const filmed = new Surface();
  const slider = () => ({
    name: `PC${active + 1} from −${range} to +${range} σ`, ends: [-range, range],
    at: (score) => {
      const s = scores().map((other, c) => (c === active ? score : other));
      modes.show(filmed, s, model.get("colors"));
      shown[0].widen(filmed.position);
      return { title: said(s), surfaces: [filmed] };
    },
  });
  const said = (s) => s.map((score, c) => (score ? `PC${c + 1} ${score < 0 ? "−" : "+"}${Math.abs(score).toFixed(1)} σ` : "")).filter(Boolean).join(", ") || "mean";
  const arrange = () => {
    shown.forEach((view) => view.dispose());
    views.replaceChildren();
    const three = model.get("side_by_side");
    threeButton.setAttribute("aria-pressed", three);
    box.classList.toggle("s4a-side-by-side", three);
    shown = (three ? [-range, 0, range] : [null]).map((at) => {
      const part = html(views, "div"), caption = html(part, "div", { class: "s4a-title" });
      const view = new View(part, { turn: model.get("turn"), group: model.get("group"), height: model.get("height"), label: "shape" });
      view.surfaces = [new Surface()];
      view.fit(modes.mean, modes.reach);
      const heading = () => (at === null ? said(scores()) : caption.textContent), bar = () => model.get("bars")[model.get("colors")];
      return Object.assign(view, { at, caption, heading, bar, slider: at === null ? slider : undefined });
    });
    update();
  };
  const shape = (at) => (at === null ? scores() : scores().map((_, c) => (c === active ? at : 0)));
  const update = () => {
    const s = scores(), kind = model.get("colors");
    shown.forEach((view) => {
      if (!context()) return;
      modes.show(view.surfaces[0], shape(view.at), kind);
      view.widen(view.surfaces[0].position);
      view.caption.textContent = view.at === null ? "mean + Σ score · deformation" : view.at ? `PC${active + 1} at ${view.at > 0 ? "+" : "−"}3 σ` : "mean";
      view.name(view.at === null ? "shape" : view.caption.textContent);
      view.redraw();
    });
    rows.forEach(({ input, output }, c) => {
      if (Number(input.value) !== s[c]) input.value = s[c];
      output.textContent = `${s[c] < 0 ? "−" : "+"}${Math.abs(s[c]).toFixed(2)} σ`;
    });
    mark();
    kinds.value = kind;
    const far = Math.hypot(...s);
    distance.textContent = `Mahalanobis distance ${far.toFixed(2)} (about ${Math.sqrt(count).toFixed(1)} is usual for a random shape)`;
    colorBar(bar, model.get("bars")[kind]);
    crosshair?.(s[0], s[1] ?? 0);
  };
  const chart = () => {
    [scorePart, variancePart].forEach((part) => part.replaceChildren());
    const samples = model.get("samples"), names = model.get("names"), low = model.get("ratio_low");
    const sum = (values) => values.map((_, i) => values.slice(0, i + 1).reduce((a, b) => a + 100 * b, 0));
    const series = [{ y: sum(ratio), name: "full resolution", color: BLUE, dots: true, wide: true, legend: true }];
    if (low.length) series.push({ y: sum(low), name: "low resolution", color: ORANGE, dash: "5 3", dots: true, wide: true, legend: true });
    series.forEach((s) => {
      s.x = s.y.map((_, i) => i + 1);
      s.text = `${s.name}: ${s.y.map((v, i) => `${i + 1}: ${v.toFixed(1)} %`).slice(0, 12).join(", ")}`;
    });
    if (ratio.length > 1) lines(variancePart, { series, title: "Cumulative variance", xlabel: "number of components", ylabel: "%", ymin: 0, legend: "bottom" }, () => {});
    crosshair = scatter(scorePart, {
      x: samples.map((s) => s[0]), y: samples.map((s) => s[1] ?? 0), names, title: "Scores: click a shape to see it",
      faint: model.get("faint"), xlabel: "PC1 (σ)", ylabel: count > 1 ? "PC2 (σ)" : "", most: 460, reach: [-range, range],
    }, ({ index }) => { tell("sample", index); set(samples[index]); });
  };
  const picture = () => {
    const bytes = numbers(Uint8Array, model.get("still"));
    if (bytes) still.src = URL.createObjectURL(new Blob([bytes], { type: "image/png" }));
  };
  const reload = () => { modes.load(); arrange(); };
  const on = {
    "change:scores": told, "change:colors": update, "change:side_by_side": arrange, "change:deformation": reload, "change:corner": () => { modes.load(); update(); }, "change:own": () => { modes.load(); update(); },
    "change:still": picture, "change:turn": () => shown[0].reset(model.get("turn")),
  };
  Object.entries(on).forEach(([event, act]) => model.on(event, act));
  chart();
  arrange();
  const stop = onRoom(scorePart, () => { redrawn(charts, chart); update(); });
  const webgl = context() !== null;
  views.hidden = !webgl;
  still.hidden = webgl;
  if (!webgl) picture();
  model.set("webgl", webgl ? "yes" : "no");
  model.save_changes();
  return () => {
    toggle(false);
    stop();
    clearTimeout(timer);
    Object.entries(on).forEach(([event, act]) => model.off(event, act));
    shown.forEach((view) => view.dispose());
    filmed.dispose();
  };
}
export default { render: modesWidget };
