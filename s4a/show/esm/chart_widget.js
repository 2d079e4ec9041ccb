export default {
  render({ model, el }) {
    el.classList.add("s4a");
    ownKeys(el);
    let asked = 0; // the number of the last mark that was picked
    const draw = () => {
      if (model.get("answer") >= 0 && model.get("answer") < asked) return; // of an older mark: the answer to the last one comes
      const spec = { ...model.get("spec") };
      if (spec.kind === "matrix") {
        spec.values = numbers(Float32Array, model.get("values"));
        if (spec.values.length !== spec.rows * spec.columns) return; // the other half of the message is on its way
        spec.palette = numbers(Uint8Array, model.get("palette"));
        spec.label = ({ row, column }) => `source φ${column} to target ψ${row}`;
      }
      redrawn(el, () => {
        el.replaceChildren();
        if (spec.kind) CHARTS[spec.kind](el, spec, (mark) => {
          asked = (model.get("picked").count || 0) + 1;
          model.set("picked", { ...mark, count: asked });
          model.save_changes();
        });
      });
    };
    draw();
    const stop = onRoom(el, draw);
    for (const name of ["spec", "values", "answer"]) model.on(`change:${name}`, draw);
    return () => { stop(); for (const name of ["spec", "values", "answer"]) model.off(`change:${name}`, draw); };
  },
};
