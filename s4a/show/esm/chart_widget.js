export default {
  render({ model, el }) {
    el.classList.add("s4a");
    ownKeys(el);
    let last = 0; // number of the last picked mark
    const draw = () => {
      if (model.get("answer") >= 0 && model.get("answer") < last) return; // an answer to an earlier mark
      const spec = { ...model.get("spec") };
      if (spec.kind === "matrix") {
        spec.values = numbers(Float32Array, model.get("values"));
        if (spec.values.length !== spec.rows * spec.columns) return; // the values or the spec are not here yet
        spec.palette = numbers(Uint8Array, model.get("palette"));
        spec.label = ({ row, column }) => `source φ${column} to target ψ${row}`;
      }
      keepFocus(el, () => {
        el.replaceChildren();
        if (spec.kind) CHARTS[spec.kind](el, spec, (mark) => {
          last = (model.get("picked").count || 0) + 1;
          model.set("picked", { ...mark, count: last });
          model.save_changes();
        });
      });
    };
    draw();
    const stop = onResize(el, draw);
    for (const name of ["spec", "values", "answer"]) model.on(`change:${name}`, draw);
    return () => { stop(); for (const name of ["spec", "values", "answer"]) model.off(`change:${name}`, draw); };
  },
};
