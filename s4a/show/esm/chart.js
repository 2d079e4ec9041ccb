// SVG charts whose marks can be hovered, clicked and reached with the arrow keys. Every function takes a parent element,
// a spec (numbers and names) and `pick`, which is called with the selected mark.

const BLUE = "#0072b2", ORANGE = "#d55e00", INK = "#333", FAINT = "#ddd", PALE = "#bbb";

function ticks(low, high, count = 5) {
  const span = high - low || 1, raw = span / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
  const out = [];
  for (let x = Math.ceil(low / step) * step; x <= high + step * 1e-6; x += step) out.push(Math.abs(x) < step * 1e-6 ? 0 : x);
  return out;
}

function bounds(values, margin = 0.08) {
  const known = values.filter((x) => Number.isFinite(x));
  const low = Math.min(...known), high = Math.max(...known), pad = margin * (high - low || 1);
  return [low - pad, high + pad];
}

// The width of a chart in 1/13 of the font size: that of its parent, up to `most`. So all charts have one font size.
function availableWidth(parent, most, least = 230) {
  const style = getComputedStyle(parent), inner = parent.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight);
  return inner > 0 ? Math.min(most, Math.max(least, Math.round((13 * inner) / (parseFloat(style.fontSize) || 13)))) : most;
}
const atMost = (svg, width) => (svg.style.maxWidth = `calc(${width} / 13 * var(--s4a-size, 13px))`);

// Call `act` when the width of a parent changes.
function onResize(parent, act) {
  let last = availableWidth(parent, 1e4);
  const observer = new ResizeObserver(() => {
    const now = availableWidth(parent, 1e4);
    if (parent.clientWidth && Math.abs(now - last) > 2) { last = now; act(); }
  });
  observer.observe(parent);
  return () => observer.disconnect();
}

// As many ticks as fit without overlap of their texts.
function fewer(range, length) {
  for (let count = 6; count > 1; count--) {
    const candidates = ticks(...range, count), width = 7 * Math.max(...candidates.map((t) => short(t).length)) + 6;
    if (width * (candidates.length - 1) <= length || candidates.length < 3) return candidates;
  }
  return ticks(...range, 1);
}

// Draw both axes at a given size; return the scales.
function plot(parent, { width, height, x, y, xlabel = "", ylabel = "", title = "", left = 48, grid = true }) {
  const svg = node(parent, "svg", { viewBox: `0 0 ${width} ${height}`, class: "s4a-chart", role: "group", "aria-label": title });
  atMost(svg, width);
  const top = title ? 22 : 8, bottom = height - 36, right = width - 10;
  const X = (v) => left + ((v - x[0]) / (x[1] - x[0])) * (right - left);
  const Y = (v) => bottom - ((v - y[0]) / (y[1] - y[0])) * (bottom - top);
  if (title) node(svg, "text", { x: Math.max(0, Math.min(left, width - 7.2 * title.length)), y: 14, "font-weight": "bold" }, title);
  for (const t of fewer(x, right - left)) {
    if (grid) node(svg, "line", { x1: X(t), x2: X(t), y1: top, y2: bottom, stroke: FAINT });
    node(svg, "text", { x: X(t), y: bottom + 14, "text-anchor": "middle" }, short(t));
  }
  for (const t of ticks(...y, 5)) {
    if (grid) node(svg, "line", { x1: left, x2: right, y1: Y(t), y2: Y(t), stroke: FAINT });
    node(svg, "text", { x: left - 5, y: Y(t) + 4, "text-anchor": "end" }, short(t));
  }
  node(svg, "text", { x: (left + right) / 2, y: height - 5, "text-anchor": "middle" }, xlabel);
  node(svg, "text", { transform: `translate(11 ${(top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, ylabel);
  return { svg, X, Y, left, right, top, bottom };
}

// Shorten names that are too long, and omit their common prefix and suffix.
function shortened(names, length = 16) {
  if (Math.max(...names.map((name) => name.length)) <= length) return names;
  const common = (texts) => {
    let n = 0;
    while (texts.every((text) => n < text.length && text[n] === texts[0][n])) n++;
    return texts[0].slice(0, n).match(/^(.*[_\W])?/s)[0].length; // up to a separator
  };
  const start = common(names), stop = common(names.map((name) => [...name.slice(start)].reverse().join("")));
  return names.map((name) => {
    const text = `${start ? "…" : ""}${name.slice(start, name.length - stop)}${stop ? "…" : ""}`;
    return text.length <= length ? text : `${text.slice(0, length / 2 - 1)}…${text.slice(-length / 2)}`;
  });
}

// Write names next to their marks where they overlap nothing; the others are shown on hover and focus.
function labels(svg, { x, y, names, width, height, start = 0, sides, avoid = [], letter = 6.4, distance = 7, ...style }) {
  const taken = [...x.map((v, i) => [v - 6, y[i] - 6, v + 6, y[i] + 6]), ...avoid.map(([v, w]) => [v - 8, w - 8, v + 8, w + 8])];
  shortened(names).forEach((text, i) => {
    const textWidth = letter * text.length;
    for (const [right, down] of sides ? sides(i) : [[1, -4], [-1, -4], [1, 12], [-1, 12]]) {
      const left = right > 0 ? x[i] + distance : x[i] - distance - textWidth, low = y[i] + down, box = [left, low - 9, left + textWidth, low + 2];
      if (box[0] < start || box[2] > width || box[1] < 0 || box[3] > height) continue;
      if (taken.some((other, j) => j !== i && box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3])) continue;
      taken.push(box);
      node(svg, "text", { x: x[i] + right * distance, y: low, "text-anchor": right > 0 ? "start" : "end", ...style }, text);
      return;
    }
  });
}

// Make marks focusable: one tab stop, arrow keys for the others, Enter picks; the text of a mark is shown below.
function reachable(marks, readout, pick) {
  marks.forEach(({ at, text, value }, i) => {
    at.setAttribute("tabindex", i ? -1 : 0);
    at.setAttribute("role", "button");
    at.setAttribute("aria-label", text);
    at.dataset.mark = JSON.stringify(value);
    at.classList.add("s4a-mark");
    node(at, "title", {}, text);
    const show = () => (readout.textContent = text);
    at.addEventListener("pointerenter", show);
    at.addEventListener("focus", () => {
      marks.forEach((other) => other.at.setAttribute("tabindex", -1));
      at.setAttribute("tabindex", 0);
      show();
    });
    at.addEventListener("click", () => pick(value));
    at.addEventListener("keydown", (e) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[e.key];
      if (step) marks[(i + step + marks.length) % marks.length].at.focus();
      else if (e.key === "Enter" || e.key === " ") pick(value);
      else return;
      e.preventDefault();
      e.stopPropagation();
    });
  });
}

// Redraw the content of a parent; the focus stays on its mark, or moves to the first one if that is gone.
function keepFocus(parent, draw) {
  const last = parent.getRootNode().activeElement; // of the page, or of a shadow tree
  const within = parent.contains(last);
  draw();
  if (!within || last.isConnected) return;
  const stops = [...parent.querySelectorAll("[tabindex]")], same = stops.find((at) => last.dataset.mark && at.dataset.mark === last.dataset.mark);
  (same || stops.find((at) => at.tabIndex === 0))?.focus({ preventScroll: true });
}

const line = (parent) => html(parent, "div", { class: "s4a-readout", "aria-live": "polite" }, " ");

function scatter(parent, spec, pick) {
  const { x, y, names, xlabel, ylabel, title, selected = -1, faint = [], width = availableWidth(parent, spec.most ?? 430) } = spec, { height = Math.min(300, width) } = spec;
  const frame = plot(parent, { width, height, x: bounds([...x, ...(spec.reach || [0])]), y: bounds([...y, ...(spec.reach || [0])]), xlabel, ylabel, title });
  const marks = x.map((_, i) => {
    const at = node(frame.svg, "circle", { cx: frame.X(x[i]), cy: frame.Y(y[i]), r: i === selected ? 7 : 5, fill: i === selected ? ORANGE : faint[i] ? PALE : BLUE, stroke: "#fff" });
    return { at, value: { index: i, name: names[i] }, text: `${names[i]}${faint[i] ? " (flagged)" : ""}: ${short(x[i])}, ${short(y[i])}` };
  });
  labels(frame.svg, { x: x.map(frame.X), y: y.map(frame.Y), names, width, height: frame.bottom, start: frame.left, avoid: [[frame.X(0), frame.Y(0)]], class: "s4a-small" }); // the initial position of the cross
  const cross = node(frame.svg, "path", { d: "M-7 0H7M0 -7V7", stroke: ORANGE, "stroke-width": 2, visibility: "hidden", class: "s4a-cross" });
  reachable(marks, line(parent), pick);
  return (a, b) => {
    cross.setAttribute("visibility", "visible");
    cross.setAttribute("transform", `translate(${frame.X(a)} ${frame.Y(b)})`);
  };
}

function bars(parent, spec, pick) {
  const { values, names, label, title, marked = [], selected = -1, width = availableWidth(parent, 430) } = spec, shortNames = shortened(names);
  const row = values.length > 25 ? 15 : 20, height = 26 + row * values.length + 40, left = 10 + 6.5 * Math.max(...shortNames.map((n) => n.length), 4);
  const numbers = sameDecimals(values), numberWidth = 8 + 7 * Math.max(...numbers.map((n) => n.length)), barWidth = width - 10 - left; // of the longest bar with its number
  const frame = plot(parent, { width, height, left, x: [0, (Math.max(...values) * barWidth) / Math.max(barWidth - numberWidth, 1) || 1], y: [0, 1], xlabel: label, title, grid: false });
  frame.svg.querySelectorAll("text[text-anchor=end]").forEach((t) => t.remove());
  const marks = values.map((v, i) => {
    const top = frame.top + 2 + i * row;
    const at = node(frame.svg, "rect", { x: left, y: top, width: Math.max(1, frame.X(v) - left), height: row - 4, fill: marked.includes(i) ? ORANGE : BLUE });
    if (i === selected) Object.entries({ stroke: INK, "stroke-width": 2.5 }).forEach(([k, s]) => at.setAttribute(k, s));
    node(frame.svg, "text", { x: left - 4, y: top + row - 8, "text-anchor": "end" }, shortNames[i]);
    node(frame.svg, "text", { x: frame.X(v) + 4, y: top + row - 8 }, numbers[i]);
    return { at, value: { index: i, name: names[i] }, text: `${names[i]}: ${v.toPrecision(4)}` };
  });
  reachable(marks, line(parent), pick);
}

function lines(parent, spec, pick) {
  const { series, xlabel, ylabel, title, width = availableWidth(parent, 460), ymin, marker } = spec, { height = Math.min(280, width) } = spec;
  const y = bounds(series.flatMap((s) => s.y), 0.04);
  const frame = plot(parent, { width, height, x: bounds(series.flatMap((s) => s.x), 0.02), y: [ymin ?? y[0], y[1]], xlabel, ylabel, title });
  const drawn = series.map((s) => {
    const d = s.x.map((v, i) => `${i ? "L" : "M"}${frame.X(v).toFixed(1)} ${frame.Y(s.y[i]).toFixed(1)}`).join("");
    const path = node(frame.svg, "path", { d, fill: "none", stroke: s.color || BLUE, "stroke-width": s.wide ? 2.5 : 1.2, "stroke-dasharray": s.dash || "", "pointer-events": "none" });
    const at = node(frame.svg, "g", { fill: s.color || BLUE, class: "s4a-series" });
    node(at, "path", { d, fill: "none", stroke: "transparent", "stroke-width": 9 });
    if (s.dots) s.x.forEach((v, i) => node(at, "circle", { cx: frame.X(v), cy: frame.Y(s.y[i]), r: 3.2 }));
    return { path, at, chosen: s.wide, reference: s.reference, value: { series: s.name }, text: s.text || s.name };
  });
  for (const { path, at, chosen } of drawn) if (chosen) frame.svg.append(path, at); // above the others
  const legend = series.filter((s) => s.legend), below = Boolean(spec.legend);
  legend.forEach((s, i) => {
    const x0 = spec.legend === "bottom" ? frame.right - 130 : frame.left + 10, y0 = below ? frame.bottom - 15 * (legend.length - i) : frame.top + 10 + 15 * i;
    node(frame.svg, "line", { x1: x0, x2: x0 + 24, y1: y0, y2: y0, stroke: s.color || BLUE, "stroke-width": 2, "stroke-dasharray": s.dash || "" });
    node(frame.svg, "text", { x: x0 + 30, y: y0 + 4, class: "s4a-halo" }, s.name);
  });
  if (marker !== undefined) node(frame.svg, "line", { x1: frame.X(marker), x2: frame.X(marker), y1: frame.top, y2: frame.bottom, stroke: ORANGE, "stroke-width": 2 });
  reachable(drawn.filter((mark) => !mark.reference), line(parent), pick);
}

function graph(parent, spec, pick) {
  const { x, y, names, source, target, colors, values, weights, title, edges, highlight = -1, faint = [], node: chosen = -1, edge = -1, width = availableWidth(parent, 460) } = spec, { height = Math.round(Math.min(390, Math.max(290, 0.87 * width))) } = spec;
  const svg = node(parent, "svg", { viewBox: `0 0 ${width} ${height}`, class: "s4a-chart", role: "group", "aria-label": title });
  atMost(svg, width);
  node(svg, "text", { x: 8, y: 14, "font-weight": "bold" }, title);
  const [x0, x1] = bounds(x, 0), [y0, y1] = bounds(y, 0);
  const margin = 20 + 6.4 * Math.max(...shortened(names).map((n) => n.length));
  const X = x.map((v) => margin + ((v - x0) / (x1 - x0 || 1)) * (width - 2 * margin)), Y = y.map((v) => height - 25 - ((v - y0) / (y1 - y0 || 1)) * (height - 75));
  const marks = source.map((s, i) => { // the two directions of a pair are curved to either side
    const t = target[i], dx = X[t] - X[s], dy = Y[t] - Y[s], bend = spec.bidirectional === false ? 0 : 0.06;
    const d = `M${X[s]} ${Y[s]}Q${(X[s] + X[t]) / 2 - bend * dy} ${(Y[s] + Y[t]) / 2 + bend * dx} ${X[t]} ${Y[t]}`;
    const at = node(svg, "g", { fill: "none", class: "s4a-edge", "data-edge": i });
    node(at, "path", { d, stroke: "transparent", "stroke-width": 7 });
    const marked = edge >= 0 && edges[i] === edge;
    if (marked) node(at, "path", { d, stroke: ORANGE, "stroke-width": 9 });
    node(at, "path", { d, stroke: colors[i], "stroke-width": marked ? 4 : 1 + 1.8 * (weights ? weights[i] : 0.3), class: "s4a-line" });
    const weight = weights ? `, weight ${short(weights[i])}` : "";
    if (marked) svg.append(at);
    return { at, value: { edge: edges[i] }, text: `${names[s]} → ${names[t]}: ${spec.label} ${values[i] === null ? spec.unknown : short(values[i])}${weight}` };
  });
  marks.push(...names.map((name, i) => {
    const at = node(svg, "g", { "data-node": i });
    if (i === highlight) node(at, "circle", { cx: X[i], cy: Y[i], r: 12, fill: "none", stroke: ORANGE, "stroke-width": 3 });
    node(at, "circle", { cx: X[i], cy: Y[i], r: 8, fill: i === chosen ? ORANGE : faint[i] ? PALE : INK, stroke: "#fff" });
    return { at, value: { node: name }, text: `${name}${i === highlight ? ", the median" : ""}${faint[i] ? " (flagged)" : ""}` };
  }));
  const sides = (i) => { // names are outside of the circle
    const out = X[i] < width / 2 - 20 ? -1 : 1, down = Y[i] < height / 2 ? -5 : 13;
    return [[out, down], [out, 4], [-out, down]];
  };
  labels(svg, { x: X, y: Y, names, width, height, sides, letter: 6.4, distance: 12, class: "s4a-halo" });
  reachable([...marks.slice(source.length), ...marks.slice(0, source.length)], line(parent), pick);
}

// A matrix as pixels: `values` row by row, coloured by a palette of 256 colours from -limit to limit. Its frame:
//
//   ylabel | ticks | pixels
//          |       | ticks
//          |       | xlabel
//          |       | colour bar
function matrix(parent, spec, pick) {
  const { rows, columns, values, palette, limit, blocks = [], label, title, note = "", axes = ["", ""], row = -1, column = -1, size = 380 } = spec;
  html(parent, "div", { class: "s4a-title" }, title);
  const frame = html(parent, "div", { class: "s4a-matrix-frame", style: `max-width:${size / 13}em` });
  html(frame, "div", { class: "s4a-ylabel" }, axes[1]);
  const numbered = (count, side, extent) => {
    const scale = html(frame, "div", { class: `s4a-${extent}ticks`, "aria-hidden": "true" });
    const whole = ticks(0, count - 1, 4).filter(Number.isInteger);
    for (const i of whole) html(scale, "span", { style: `${side}:${(100 * (i + 0.5)) / count}%` }, i);
    if (extent === "y") scale.style.width = `${String(count - 1).length + 0.5}ch`;
  };
  numbered(rows, "top", "y");
  const box = html(frame, "div", { class: "s4a-matrix", style: `aspect-ratio:${columns}/${rows}` });
  numbered(columns, "left", "x");
  html(frame, "div", { class: "s4a-xlabel" }, axes[0]);
  const colors = Array.from({ length: 11 }, (_, i) => `rgb(${palette.subarray(3 * Math.round(25.5 * i)).slice(0, 3).join()})`);
  colorBar(html(frame, "div", { class: "s4a-matrix-bar" }), { colors, low: -limit, label: "entry of the matrix", high: limit });
  html(parent, "div", { class: "s4a-note" }, note);
  const inside = (at) => at.row >= 0 && at.row < rows && at.column < columns;
  const canvas = html(box, "canvas", { tabindex: 0, role: "application", "aria-label": `${[title, axes[0] && `columns: ${axes[0]}, rows: ${axes[1]}`].filter(Boolean).join("; ")}: arrow keys move, Enter selects the entry` });
  Object.assign(canvas, { width: columns, height: rows });
  const paint = canvas.getContext("2d"), image = paint.createImageData(columns, rows);
  values.forEach((v, i) => {
    const at = Math.round(255 * Math.min(1, Math.max(0, 0.5 + (0.5 * v) / limit)));
    image.data.set([...palette.subarray(3 * at, 3 * at + 3), 255], 4 * i);
  });
  paint.putImageData(image, 0, 0);
  const svg = node(box, "svg", { viewBox: `0 0 ${columns} ${rows}`, preserveAspectRatio: "none" });
  for (const [a, b] of blocks) node(svg, "rect", { x: a, y: a, width: b - a + 1, height: b - a + 1, fill: "none", stroke: "#e69f00", "stroke-width": columns / 120 });
  const cursor = node(svg, "rect", { width: 1, height: 1, fill: "none", stroke: "#000", "stroke-width": columns / 150, x: column, y: row, visibility: inside({ row, column }) ? "visible" : "hidden" });
  const readout = line(parent), here = inside({ row, column }) ? { row, column } : { row: 0, column: 0 };
  const say = () => (readout.textContent = `C[${here.row}, ${here.column}] = ${short(values[here.row * columns + here.column])}   (${label(here)})`);
  const follow = (e) => {
    const r = canvas.getBoundingClientRect();
    here.column = Math.min(columns - 1, Math.max(0, Math.floor(((e.clientX - r.left) / r.width) * columns)));
    here.row = Math.min(rows - 1, Math.max(0, Math.floor(((e.clientY - r.top) / r.height) * rows)));
    say();
  };
  const choose = () => {
    Object.entries({ x: here.column, y: here.row, visibility: "visible" }).forEach(([k, v]) => cursor.setAttribute(k, v));
    pick({ ...here });
  };
  canvas.addEventListener("pointermove", follow);
  canvas.addEventListener("click", (e) => { follow(e); choose(); });
  canvas.addEventListener("keydown", (e) => {
    const step = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowDown: [1, 0], ArrowUp: [-1, 0] }[e.key];
    if (!step && e.key !== "Enter") return;
    e.preventDefault();
    e.stopPropagation();
    if (!step) return choose();
    here.row = Math.min(rows - 1, Math.max(0, here.row + step[0]));
    here.column = Math.min(columns - 1, Math.max(0, here.column + step[1]));
    Object.entries({ x: here.column, y: here.row, visibility: "visible" }).forEach(([k, v]) => cursor.setAttribute(k, v));
    say();
  });
  if (inside({ row, column })) say();
}

const CHARTS = { scatter, bars, lines, graph, matrix };
