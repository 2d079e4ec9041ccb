// Helpers of all scripts.

// Bytes from the kernel as numbers; copied, because their offset in the buffer may not be aligned.
const numbers = (Kind, view) =>
  view && view.byteLength ? new Kind(view.buffer.slice(view.byteOffset, view.byteOffset + view.byteLength)) : null;

function node(parent, tag, attributes = {}, text = "") {
  const it = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value);
  if (text !== "") it.textContent = text;
  parent.append(it);
  return it;
}

function html(parent, tag, attributes = {}, text = "") {
  const it = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value);
  if (text !== "") it.textContent = text;
  parent.append(it);
  return it;
}

// The focused element keeps its keys: Notebook 7 would use the arrow keys for its cells before the page gets them.
const ownKeys = (box) => box.addEventListener("focusin", ({ target }) => target.setAttribute("data-lm-suppress-shortcuts", "true"));

const short = (x) => (x === null || x === undefined || Number.isNaN(x) ? "none" : String(Number(x.toPrecision(3))));

// Format the numbers of a column with the same number of decimals.
function sameDecimals(values) {
  const texts = values.map(short), decimals = Math.max(...texts.map((text) => (/^-?[0-9.]+$/.test(text) ? text.split(".")[1] || "" : "").length));
  return texts.map((text, i) => (/^-?[0-9.]+$/.test(text) ? values[i].toFixed(decimals) : text));
}

// A horizontal bar of colours with its numbers: {colors: [css], low, middle, high, label}.
function colorBar(parent, bar) {
  parent.replaceChildren();
  if (!bar || !bar.colors) return;
  const box = html(parent, "div", { class: "s4a-bar" });
  html(box, "div", { class: "s4a-colors", style: `background:linear-gradient(90deg,${bar.colors.join(",")})`, role: "img", "aria-label": `colours from ${bar.low} to ${bar.high}` });
  const row = html(box, "div", { class: "s4a-numbers" });
  for (const text of [bar.low, bar.label, bar.high]) html(row, "span", {}, typeof text === "number" ? short(text) : text);
}
