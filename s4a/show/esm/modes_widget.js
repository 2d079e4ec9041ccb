// The mean shape deformed in the browser along the modes of variation: mean + sum of score times deformation.
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
    this.reach = this.radiusAt(3);
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
  // The radius around the mean's centre that contains the surface at ± sigma of each mode.
  radiusAt(sigma) {
    const M = this.mean, D = this.deformation, centre = boxOf(M).centre;
    let r2 = 0;
    for (let start = 0; start < D.length; start += M.length) {
      for (let i = 0; i < M.length; i += 3) {
        let start2 = 0, along = 0, moved2 = 0;
        for (let x = 0; x < 3; x++) {
          const p = M[i + x] - centre[x], d = sigma * D[start + i + x];
          start2 += p * p; along += p * d; moved2 += d * d;
        }
        r2 = Math.max(r2, start2 + 2 * Math.abs(along) + moved2);
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
  let current = [...model.get("scores")]; // newer than the model's scores while a slider moves
  const scores = () => [...current];
  const box = html(el, "div", { class: "s4a-modes" }), left = html(box, "div"), right = html(box, "div");
  const views = html(left, "div", { class: "s4a-views" }), bar = html(left, "div"), still = html(left, "img", { class: "s4a-still", hidden: "" });
  let active = 0, shown = [], timer = 0, playing = 0, crosshair = null;
  el.modes = modes;

  const send = (name, value) => { model.set(name, value); model.save_changes(); };
  const set = (values, last = active) => {
    active = last;
    current = [...values];
    update();
    timer ||= setTimeout(() => { timer = 0; send("scores", current); }, 100); // at most ten messages a second
  };
  const onScores = () => { // an answer to an earlier message must not reset the slider
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
  button("Reset", () => set(scores().fill(0)), "set all scores to 0: the mean shape");
  const play = button("Play", () => toggle(), "animate the selected mode");
  const threeButton = button("−3 · mean · +3", () => send("side_by_side", !model.get("side_by_side")), "show the selected mode at −3 and +3 standard deviations side by side");
  button("Random", () => set(scores().map(() => {
    let z = range + 1; // normally distributed scores within the range of the sliders
    while (Math.abs(z) > range) z = Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
    return Math.round(100 * z) / 100;
  })), "draw scores from the normal distribution: a plausible shape");
  const kinds = html(buttons, "select", { "aria-label": "colours", title: "colours: displacement from the mean, along the normals or its length" });
  for (const [value, text] of [["normal", "along the normal"], ["magnitude", "distance"], ["none", "no colours"], ...(model.get("own")?.byteLength ? [["own", "by structure"]] : [])]) html(kinds, "option", { value }, text);
  kinds.addEventListener("change", () => send("colors", kinds.value));
  const sliders = html(right, "div", { class: "s4a-sliders" });
  const rows = ratio.map((share, c) => {
    const row = html(sliders, "label", { class: "s4a-slider", title: `mode ${c + 1}: ${(100 * share).toFixed(1)} % of the variance; the slider is its score, in standard deviations (σ)` });
    html(row, "span", {}, `mode ${c + 1} · ${(100 * share).toFixed(1)} %`);
    const input = html(row, "input", { type: "range", min: -range, max: range, step: 0.05, "aria-label": `mode ${c + 1} in standard deviations` });
    const output = html(row, "output", {}, "0.00");
    input.addEventListener("input", () => { const s = scores(); s[c] = Number(input.value); set(s, c); });
    input.addEventListener("focus", () => { active = c; mark(); });
    input.addEventListener("keydown", (e) => e.stopPropagation()); // not for the notebook
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
  // A film of the selected mode from one end to the other; the other scores do not change.
  const filmed = new Surface();
  const slider = () => ({
    name: `mode ${active + 1} from −${range} to +${range} σ`, ends: [-range, range],
    at: (score) => {
      const s = scores().map((other, c) => (c === active ? score : other));
      modes.show(filmed, s, model.get("colors"));
      shown[0].widen(filmed.position);
      return { title: scoreText(s), surfaces: [filmed] };
    },
  });
  const scoreText = (s) => s.map((score, c) => (score ? `mode ${c + 1} ${score < 0 ? "−" : "+"}${Math.abs(score).toFixed(1)} σ` : "")).filter(Boolean).join(", ") || "mean";
  const arrange = () => {
    shown.forEach((view) => view.dispose());
    views.replaceChildren();
    const three = model.get("side_by_side");
    threeButton.setAttribute("aria-pressed", three);
    box.classList.toggle("s4a-side-by-side", three);
    shown = (three ? [-range, 0, range] : [null]).map((at) => {
      const part = html(views, "div"), caption = html(part, "div", { class: "s4a-title" });
      const view = new View(part, { rotation: model.get("rotation"), group: model.get("group"), height: model.get("height"), label: "shape" });
      view.surfaces = [new Surface()];
      view.fit(modes.mean, modes.reach);
      const heading = () => (at === null ? scoreText(scores()) : caption.textContent), bar = () => model.get("bars")[model.get("colors")];
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
      view.caption.textContent = view.at === null ? "mean + Σ score · deformation" : view.at ? `mode ${active + 1} at ${view.at > 0 ? "+" : "−"}3 σ` : "mean";
      view.name(view.at === null ? "shape" : view.caption.textContent);
      view.redraw();
    });
    rows.forEach(({ input, output }, c) => {
      if (Number(input.value) !== s[c]) input.value = s[c];
      output.textContent = `${s[c] < 0 ? "−" : "+"}${Math.abs(s[c]).toFixed(2)} σ`;
    });
    mark();
    kinds.value = kind;
    const mahalanobis = Math.hypot(...s);
    distance.textContent = `Mahalanobis distance ${mahalanobis.toFixed(2)} (about ${Math.sqrt(count).toFixed(1)} for a random shape)`;
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
    if (ratio.length > 1) lines(variancePart, { series, title: "Explained variance", xlabel: "number of modes", ylabel: "%", ymin: 0, legend: "bottom" }, () => {});
    crosshair = scatter(scorePart, {
      x: samples.map((s) => s[0]), y: samples.map((s) => s[1] ?? 0), names, title: "Scores: click a shape to see it",
      faint: model.get("faint"), xlabel: "mode 1 (σ)", ylabel: count > 1 ? "mode 2 (σ)" : "", most: 460, reach: [-range, range],
    }, ({ index }) => { send("sample", index); set(samples[index]); });
  };
  const picture = () => {
    const bytes = numbers(Uint8Array, model.get("still"));
    if (bytes) still.src = URL.createObjectURL(new Blob([bytes], { type: "image/png" }));
  };
  const reload = () => { modes.load(); arrange(); };
  const on = {
    "change:scores": onScores, "change:colors": update, "change:side_by_side": arrange, "change:deformation": reload, "change:corner": () => { modes.load(); update(); }, "change:own": () => { modes.load(); update(); },
    "change:still": picture, "change:rotation": () => shown[0].reset(model.get("rotation")),
  };
  Object.entries(on).forEach(([event, act]) => model.on(event, act));
  chart();
  arrange();
  const stop = onResize(scorePart, () => { keepFocus(charts, chart); update(); });
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
