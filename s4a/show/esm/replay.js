// The controls of a page without Python: they show the recorded output for their values.
// {controls: [{id, labels, at, recorded}], values: [...], groups: [{controls, slots: [[id, name, key]], rows}], clicks: [...]}
globalThis.s4aReplay = ({ controls, values, groups, clicks }) => {
  const value = (i) => (typeof values[i] === "string" ? s4aValue(values[i]) : values[i]);
  const inputs = controls.map((control) => document.getElementById(control.id));
  const apply = (changed) => {
    const changes = {};
    for (const { controls: used, slots, rows } of groups) {
      if (!used.includes(changed)) continue;
      const row = rows[used.map((c) => controls[c].at).join()];
      if (!row) continue;
      slots.forEach(([id, name, key], i) => {
        const now = (changes[id] ||= {});
        if (key === null) now[name] = value(row[i]);
        else now[name] = { ...(now[name] || s4aModels[id].get(name)), [key]: value(row[i]) };
      });
    }
    for (const [id, now] of Object.entries(changes)) {
      const at = document.getElementById(id);
      if ("display" in now) at.hidden = now.display === "none";
      if ("html" in now) at.innerHTML = now.html;
      const { display, html, ...state } = now;
      s4aModels[id]?.update(state);
    }
  };
  const note = document.getElementById("not-recorded");
  const choose = (c, at) => {
    const isRecorded = controls[c].recorded.includes(at);
    note.textContent = isRecorded ? "" : `${controls[c].labels[at]} is not recorded in this page; a notebook shows it.`;
    if (controls[c].at === at || !isRecorded) return;
    controls[c].at = at;
    inputs[c].value = inputs[c].type === "range" ? controls[c].recorded.indexOf(at) : at;
    if (inputs[c].type === "checkbox") inputs[c].checked = Boolean(at);
    const output = inputs[c].parentElement.querySelector("output");
    if (output) output.textContent = controls[c].labels[at];
    if (inputs[c].type === "range") inputs[c].setAttribute("aria-valuetext", controls[c].labels[at]);
    apply(c);
  };
  inputs.forEach((input, c) => input.addEventListener("input", () => {
    const at = input.type === "checkbox" ? Number(input.checked) : Number(input.value);
    choose(c, input.type === "range" ? controls[c].recorded[at] : at);
  }));
  for (const { id, part, control } of clicks) {
    s4aModels[id].on("change:picked", () => {
      const picked = s4aModels[id].get("picked"), at = controls[control].keys.indexOf(JSON.stringify(picked[part]));
      if (picked[part] !== undefined && at >= 0) choose(control, at);
    });
  }
};
