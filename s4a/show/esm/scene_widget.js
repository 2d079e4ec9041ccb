export default {
  render({ model, el }) {
    el.classList.add("s4a");
    ownKeys(el);
    const title = html(el, "div", { class: "s4a-title" });
    // Every place that is picked or hovered has a number, of all views of a group; what the kernel answers carries the number
    // of the place that it answers, and is left out where the user is farther by then.
    const send = (name, hit) => {
      model.set(name, { ...(hit || { vertex: -1 }), count: view.camera.asked });
      model.save_changes();
    };
    const ask = () => (view.camera.asked = 1 + Math.max(view.camera.asked || 0, ...["picked", "hovered"].map((name) => model.get(name).count || 0)));
    const current = () => model.get("answer") < 0 || model.get("answer") >= (view.camera.asked || 0);
    let hovered = 0, later = 0, link = null, values = null;
    // Views of one surface with a match each: a vertex is marked on all of them, and on the other surface in their colours.
    const compare = (hit) => {
      const views = [...view.camera.views], ball = (at, colour) => [...at, ...colour, model.get("radius")];
      const here = view.fan, fans = views.filter((one) => one.fan), others = views.filter((one) => !one.fan);
      for (const one of fans) {
        const vertex = here ? hit.vertex : one.fan.back[hit.vertex];
        one.points = vertex < 0 ? [] : [ball(one.at(vertex), one.fan.colour)];
        one.readout.textContent = one.fan.say(vertex);
      }
      for (const one of others) {
        if (!here) one.points = one === view ? [ball(view.at(hit.vertex), [0.9, 0.6, 0])] : [];
        else one.points = fans.filter((fan) => fan.fan.link[hit.vertex] >= 0).map((fan) => ball(one.at(fan.fan.link[hit.vertex]), fan.fan.colour));
      }
      view.moved();
    };
    // The image of a vertex on the other view of the group: marked at once. Whether it needs no kernel.
    const carry = (hit) => {
      const fans = [...view.camera.views].some((one) => one.fan);
      if (fans && hit && hit.vertex >= 0) compare(hit);
      if (fans || !link) return fans;
      if (!hit || hit.vertex < 0 || hit.vertex >= link.length) return true;
      const there = link[hit.vertex], radius = model.get("radius"), ball = (at) => [...at, 0.9, 0.6, 0, radius];
      const sure = values ? `, confidence ${values[hit.vertex].toFixed(2)}` : "";
      view.points = [ball(view.at(hit.vertex))];
      for (const other of view.camera.views) {
        if (other === view) continue;
        other.points = there < 0 ? [] : [ball(other.at(there))];
        other.readout.textContent = readout.textContent = there < 0 ? "nothing is matched to this vertex"
          : model.get("link_text").replace("{here}", hit.vertex).replace("{there}", there) + sure;
      }
      view.moved();
      return true;
    };
    const view = new View(el, {
      turn: model.get("turn"), group: model.get("group"), height: model.get("height"), label: model.get("title"),
      onLasso: (drawn) => { model.set("drawn_around", { ...drawn, count: 1 + (model.get("drawn_around").count || 0) }); model.save_changes(); },
      onPick: model.get("clickable") && ((hit) => { ask(); carry(hit); send("picked", hit); }),
      onHover: model.get("clickable") && ((hit) => {
        if (!model.get("hovering")) return;
        clearTimeout(later);
        ask();
        if (carry(hit)) return; // the kernel hears of what the browser cannot answer: eight places a second, and the last
        later = setTimeout(() => { hovered = Date.now(); send("hovered", hit); }, Math.max(0, 120 + hovered - Date.now()));
      }),
    });
    const still = html(el, "img", { alt: "", class: "s4a-still" }), bar = html(el, "div"), readout = html(el, "div", { class: "s4a-readout", "aria-live": "polite" });
    Object.assign(view, { readout, alone: true, heading: () => model.get("title"), bar: () => model.get("bar") });
    view.told = () => {
      readout.textContent = model.get("caption");
      view.points = model.get("points");
      view.redraw();
    };
    const surface = new Surface(), ghost = new Surface(0.35);
    const geometry = () => {
      const position = numbers(Float32Array, model.get("position")), corner = numbers(Uint32Array, model.get("corner"));
      if (!position || !corner) return;
      surface.setMesh(position, corner);
      view.fit(position);
      view.cursor = -1;
      color();
      links();
    };
    const color = () => {
      surface.setColor(numbers(Uint8Array, model.get("color")));
      surface.setTexture(numbers(Float32Array, model.get("coordinate")), model.get("cell"));
      view.redraw();
    };
    const links = () => {
      link = numbers(Int32Array, model.get("link"));
      const back = numbers(Int32Array, model.get("link_back"));
      values = numbers(Float32Array, model.get("link_values"));
      view.fan = back && link && {
        link, back, colour: model.get("link_color"),
        say: (vertex) => vertex < 0 ? "nothing is matched to this vertex" : model.get("link_text").replace("{here}", vertex)
          .replace("{there}", link[vertex] < 0 ? "unknown" : link[vertex])
          .replace("{value}", values && !Number.isNaN(values[vertex]) ? (100 * values[vertex]).toFixed(2) : "unknown"),
      };
      for (const one of view.camera.views) one.told?.(); // what the browser said and marked by itself was of the links before
    };
    const ghosts = () => {
      const position = numbers(Float32Array, model.get("ghost_position")), corner = numbers(Uint32Array, model.get("ghost_corner"));
      view.surfaces = position && corner ? [surface, ghost] : [surface];
      if (position && corner) ghost.setMesh(position, corner);
      if (position && corner) ghost.setColor(new Uint8Array(position.length).map((_, i) => [90, 110, 160][i % 3]));
      view.redraw();
    };
    const words = () => {
      title.textContent = model.get("title");
      view.name(model.get("title") || "surface");
      colorBar(bar, model.get("bar"));
    };
    const answered = () => current() && view.told(); // not of a place where the user is no longer
    const lasso = () => {
      view.lasso = model.get("lasso");
      view.grip();
      view.canvas.style.cursor = view.lasso ? "crosshair" : "";
    };
    const picture = () => {
      const bytes = numbers(Uint8Array, model.get("still"));
      if (still.src) URL.revokeObjectURL(still.src);
      if (bytes) still.src = URL.createObjectURL(new Blob([bytes], { type: "image/png" }));
      still.alt = `${model.get("title")}, a still picture: this browser has no WebGL2`;
    };
    const on = {
      "change:position": geometry, "change:color": color, "change:coordinate": color, "change:cell": color, "change:link": links, "change:link_values": links, "change:link_back": links, "change:link_color": links, "change:link_text": links,
      "change:ghost_position": ghosts, "change:title": words,
      "change:caption": answered, "change:points": answered, "change:answer": answered, "change:bar": words, "change:still": picture,
      "change:lasso": lasso, "change:turn": () => view.reset(model.get("turn")),
    };
    Object.entries(on).forEach(([event, act]) => model.on(event, act));
    geometry(), ghosts(), words(), answered(), lasso();
    const webgl = context() !== null;
    view.box.hidden = !webgl;
    still.hidden = webgl;
    if (!webgl) picture();
    if (model.get("webgl") !== (webgl ? "yes" : "no")) {
      model.set("webgl", webgl ? "yes" : "no");
      model.save_changes();
    }
    return () => {
      clearTimeout(later);
      Object.entries(on).forEach(([event, act]) => model.off(event, act));
      view.dispose();
    };
  },
};
