// Scores of a pythreejs mesh: written to the uniforms of its shader, and shown as sliders.
// Nothing waits for the kernel, which gets a score when its slider is released.

async function meshOf(model) {
  const id = model.get("mesh").replace("IPY_MODEL_", "");
  const mesh = await model.widget_manager.get_model(id);
  await mesh.initPromise;
  return mesh;
}

async function initialize({ model }) {
  const mesh = await meshOf(model);
  const apply = () => {
    const uniforms = mesh.get("material").obj.uniforms;
    if (uniforms?.scores) uniforms.scores.value = [...mesh.get("scores")];
  };
  apply();
  mesh.on("change:scores", apply); // the scenes of the mesh redraw afterwards
  mesh.trigger("childchange", mesh);
  return () => mesh.off("change:scores", apply);
}

const text = (score) => `${score < 0 ? "−" : "+"}${Math.abs(score).toFixed(2)} σ`;

async function render({ model, el }) {
  const mesh = await meshOf(model);
  el.classList.add("s4a-scores");
  const inputs = mesh.get("scores").map((_, mode) => {
    const label = el.appendChild(document.createElement("label"));
    const input = Object.assign(document.createElement("input"), { type: "range" });
    Object.assign(input, { min: -3, max: 3, step: 0.05 });
    const output = document.createElement("output");
    label.append(`mode ${mode + 1}`, input, output);
    input.title = "in standard deviations; a double click resets it to the mean";
    const move = (value) => {
      const scores = [...mesh.get("scores")];
      scores[mode] = value;
      mesh.set({ scores }, "pushFromThree"); // pythreejs sends no message for it
    };
    input.addEventListener("input", () => move(Number(input.value)));
    input.addEventListener("change", () => mesh.save_changes());
    input.addEventListener("dblclick", () => {
      move(0);
      mesh.save_changes();
    });
    input.addEventListener("keydown", (event) => event.stopPropagation()); // not for the notebook
    return [input, output];
  });
  const show = () => {
    mesh.get("scores").forEach((score, mode) => {
      const [input, output] = inputs[mode];
      input.value = score;
      output.textContent = text(score);
    });
  };
  show();
  mesh.on("change:scores", show);
  return () => mesh.off("change:scores", show);
}

export default { initialize, render };
