// Save picture and Save film: the views of a panel with titles and colour bars as a file, made in the browser, so that they
// also work in a page without kernel.

const SECONDS = 4; // of a film
const WEBM = typeof MediaRecorder === "function" && "captureStream" in HTMLCanvasElement.prototype && MediaRecorder.isTypeSupported("video/webm");

// The rotation of a camera after a rotation around the axis that points up, which is perpendicular to x in the initial view.
function rotated({ rotation, home }, angle) {
  const [up = 1] = [0, 1, 2].filter((i) => Math.abs(home[i]) < 1e-6).sort((i, j) => Math.abs(home[3 + j]) - Math.abs(home[3 + i]));
  const a = (up + 1) % 3, b = (up + 2) % 3, c = Math.cos(angle), s = Math.sin(angle);
  return rotation.map((v, i) => (i % 3 === up ? v : i % 3 === a ? c * v + s * rotation[i + b - a] : c * v - s * rotation[i + a - b]));
}

// Draw views side by side on a canvas: titles above, and a colour bar below each or one for all.
function compose(views, { width, ground = "#fff", angle = 0, score = null }, canvas = document.createElement("canvas")) {
  const columns = views.length < 5 ? views.length : Math.ceil(views.length / 2), cell = Math.floor(width / columns);
  const text = Math.max(10, Math.round(Math.min(width / 40, cell / 18))), line = Math.round(1.7 * text);
  const tall = Math.max(...views.map(({ canvas: { clientWidth, clientHeight } }) => Math.round((cell * clientHeight) / clientWidth)));
  const bars = views.map((view) => view.bar?.()), oneBar = bars.every((bar) => JSON.stringify(bar) === JSON.stringify(bars[0]));
  const below = bars.some((bar) => bar?.colors) ? 2 * line : 0, row = line + tall + (oneBar ? 0 : below), rows = Math.ceil(views.length / columns);
  Object.assign(canvas, { width, height: 2 * Math.ceil((rows * row + (oneBar ? below : 0)) / 2) }); // films need an even height
  const on = canvas.getContext("2d", { willReadFrequently: true });
  const write = (label, x, y, maxWidth, align = "center") => {
    const font = (size) => (on.font = `${size}px system-ui, sans-serif`);
    font(text);
    font(Math.min(text, (text * maxWidth) / on.measureText(label).width));
    Object.assign(on, { fillStyle: "#222", textAlign: align, textBaseline: "middle" });
    on.fillText(label, x, y);
  };
  const drawBar = (bar, x, y, maxWidth) => {
    if (!bar?.colors) return;
    const barWidth = Math.min(maxWidth, 40 * text), left = x - barWidth / 2, colours = on.createLinearGradient(left, 0, left + barWidth, 0);
    bar.colors.forEach((colour, i) => colours.addColorStop(i / (bar.colors.length - 1), colour));
    on.fillStyle = colours;
    on.fillRect(left, y + 0.3 * text, barWidth, text);
    write(String(typeof bar.low === "number" ? short(bar.low) : bar.low), left, y + 1.5 * line, barWidth / 4, "left");
    write(String(typeof bar.high === "number" ? short(bar.high) : bar.high), left + barWidth, y + 1.5 * line, barWidth / 4, "right");
    write(bar.label, x, y + 1.5 * line, Math.max(barWidth - 10 * text, barWidth / 3));
  };
  if (ground) Object.assign(on, { fillStyle: ground }).fillRect(0, 0, canvas.width, canvas.height);
  views.forEach((view, i) => {
    const x = (i % columns) * cell, y = Math.floor(i / columns) * row;
    const moved = score !== null && view.slider ? view.slider().at(score) : { title: view.heading(), surfaces: view.surfaces };
    write(moved.title, x + cell / 2, y + line / 2, 0.96 * cell);
    const height = Math.round((cell * view.canvas.clientHeight) / view.canvas.clientWidth);
    view.paint(on, [x, y + line, cell, height], { surfaces: moved.surfaces, rotation: rotated(view.camera, angle) });
    if (!oneBar) drawBar(bars[i], x + cell / 2, y + line + tall, 0.9 * cell);
  });
  if (oneBar) drawBar(bars[0], width / 2, rows * row, 0.9 * width);
  return canvas;
}

// A film of views: `motion` maps the time, from 0 to 1, to options of `compose`.
async function film(views, width, kind, motion, progress) {
  const canvas = compose(views, { width, ...motion(0) }), later = (ms) => new Promise((done) => setTimeout(done, ms));
  const draw = (share) => compose(views, { width, ...motion(share) }, canvas);
  if (kind === "gif") {
    const n = 50, { height } = canvas;
    const frame = async (i) => {
      progress(i / n);
      await later(0);
      return draw(i / n).getContext("2d").getImageData(0, 0, width, height).data;
    };
    return gif({ width, height, n, hundredths: (100 * SECONDS) / n, frame });
  }
  // a browser records in real time, so the pictures are drawn in advance
  const n = 50, pictures = [], on = canvas.getContext("2d"), parts = [];
  for (let i = 0; i <= n; i++) {
    progress(i / n);
    pictures.push(await createImageBitmap(draw(i / n)));
    await later(0);
  }
  const recorder = new MediaRecorder(canvas.captureStream(), { mimeType: "video/webm", videoBitsPerSecond: 12e6 });
  let bytes = 0;
  recorder.ondataavailable = ({ data }) => { parts.push(data); bytes += data.size; };
  const ended = new Promise((done) => (recorder.onstop = done));
  recorder.start(200);
  try {
    for (const picture of pictures) {
      on.drawImage(picture, 0, 0);
      await later((1000 * SECONDS) / n);
    }
    for (let before = -1, tries = 0; (before < bytes || !bytes) && tries < 20; tries++) { // wait until the last picture is encoded
      before = bytes;
      await later(1200);
    }
  } finally {
    recorder.stop();
    pictures.forEach((picture) => picture.close());
  }
  await ended;
  return new Blob(parts, { type: "video/webm" });
}

function download(blob, name) {
  const link = html(document.body, "a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

// Open the save dialog of a view.
function openSaveDialog(view) {
  const box = html(view.box, "dialog", { class: "s4a-save", "aria-label": `save ${view.label}` });
  const panel = view.box.closest(".s4a-panel"), seen = (other) => other.frame && other.canvas.clientWidth && other.box.closest(".s4a-panel") === panel;
  const all = [...view.camera.views].filter(seen), slider = view.slider?.();
  const choice = (row, text, options) => {
    const field = html(row, "label", {}, `${text} `), it = html(field, "select");
    for (const [value, label] of options) html(it, "option", { value }, label);
    return it;
  };
  const part = (title) => {
    const it = html(box, "fieldset");
    html(it, "legend", {}, title);
    return it;
  };
  const widths = (most) => [600, 800, 1200, 1920, 2560, 3840].filter((w) => w <= most).map((w) => [w, `${w} pixels${w === 3840 ? " (4K)" : ""}`]);
  const which = all.length > 1 && choice(html(box, "p"), "surfaces", [["one", view.heading() || "this view"], ["all", `all ${all.length}, side by side`]]);
  const views = () => (which && which.value === "all" ? all : [view]), name = (end, of = "") => `${(of || views()[0].heading()).toLowerCase().replace(/−/g, "minus ").replace(/\+/g, "plus ").replace(/[^\p{L}\p{N}]+/gu, "-").replace(/^-|-$/g, "") || "surface"}.${end}`;
  if (which && !view.alone) which.value = "all";

  const still = part("Picture (PNG)"), width = choice(still, "width", widths(3840)), ground = choice(still, "background", [["#fff", "white"], ["", "transparent"]]);
  width.value = 1920;
  const moving = part("Film"), filmWidth = choice(moving, "width", widths(1920));
  const kind = choice(moving, "format", [["gif", "GIF"], ...(WEBM ? [["webm", "WebM"]] : [])]);
  const motion = choice(moving, "motion", [...(slider ? [["slider", slider.name]] : []), ["turn", "one turn"]]);
  const progress = html(box, "output", { role: "status" }), buttons = [];
  const button = (row, text, act) => {
    const it = html(row, "button", { type: "button" }, text);
    buttons.push(it);
    it.addEventListener("click", async () => {
      buttons.forEach((other) => (other.disabled = true));
      try {
        const [blob, file] = await act();
        if (!box.open) return;
        download(blob, file);
        progress.textContent = `saved: ${file}, ${(blob.size / 1e6).toFixed(1)} MB`;
      } catch (error) {
        progress.textContent = `not saved: ${error.message}`;
      }
      buttons.forEach((other) => (other.disabled = false));
    });
  };
  button(still, "Save picture", () => new Promise((done, fail) => {
    compose(views(), { width: Number(width.value), ground: ground.value }).toBlob((blob) => (blob ? done([blob, name("png")]) : fail(new Error("the picture is too large for this browser"))));
  }));
  button(moving, "Save film", async () => {
    const slides = motion.value === "slider", [from, to] = slides ? slider.ends : [0, 2 * Math.PI];
    const at = (share) => (slides ? { score: (from + to) / 2 - ((to - from) / 2) * Math.cos(2 * Math.PI * share) } : { angle: 2 * Math.PI * share });
    if (slides) slider.ends.forEach((end) => slider.at(end)); // so that all frames have one scale
    const end = kind.value, shown = views();
    const made = await film(shown, Number(filmWidth.value), end, at, (share) => {
      if (!box.open || !view.box.isConnected) throw new Error("the dialog was closed");
      progress.textContent = `${Math.round(100 * share)} %`;
    });
    return [made, name(end, slides ? slider.name : "")];
  });
  html(box, "button", { type: "button" }, "Close").addEventListener("click", () => box.close());
  box.addEventListener("close", () => box.remove());
  box.addEventListener("keydown", (e) => e.stopPropagation()); // not for the notebook
  box.showModal();
}
