export default {
  render({ model, el }) {
    el.classList.add("s4a");
    ownKeys(el);
    const title = html(el, "div", { class: "s4a-title" });
    // Picked and hovered points are numbered over all views of a group. An answer of the kernel has the number of its point,
    // and is ignored if there is a later one.
    const send = (name, hit) => {
      model.set(name, { ...(hit || { vertex: -1 }), count: view.camera.count });
      model.save_changes();
    };
    const nextCount = () => (view.camera.count = 1 + Math.max(view.camera.count || 0, ...["picked", "hovered"].map((name) => model.get(name).count || 0)));
    const current = () => model.get("answer") < 0 || model.get("answer") >= (view.camera.count || 0);
    let hovered = 0, later = 0, link = null, values = null;
    // Views of one surface, each with the match of a method: mark a vertex on all of them, and its matches on the other surface.
    const compare = (hit) => {
      const views = [...view.camera.views], ball = (at, colour) => [...at, ...colour, model.get("radius")];
      const onTarget = view.method, methods = views.filter((other) => other.method), sources = views.filter((other) => !other.method);
      for (const other of methods) {
        const vertex = onTarget ? hit.vertex : other.method.back[hit.vertex];
        other.points = vertex < 0 ? [] : [ball(other.at(vertex), other.method.colour)];
        other.readout.textContent = other.method.text(vertex);
      }
      for (const other of sources) {
        if (!onTarget) other.points = other === view ? [ball(view.at(hit.vertex), [0.9, 0.6, 0])] : [];
        else other.points = methods.filter(({ method }) => method.link[hit.vertex] >= 0).map(({ method }) => ball(other.at(method.link[hit.vertex]), method.colour));
      }
      view.moved();
    };
    // Mark the image of a vertex on the other view of the group; return true if the kernel is not needed.
    const markImage = (hit) => {
      const compares = [...view.camera.views].some((other) => other.method);
      if (compares && hit && hit.vertex >= 0) compare(hit);
      if (compares || !link) return compares;
      if (!hit || hit.vertex < 0 || hit.vertex >= link.length) return true;
      const there = link[hit.vertex], radius = model.get("radius"), ball = (at) => [...at, 0.9, 0.6, 0, radius];
      const confidence = values ? `, confidence ${values[hit.vertex].toFixed(2)}` : "";
      view.points = [ball(view.at(hit.vertex))];
      for (const other of view.camera.views) {
        if (other === view) continue;
        other.points = there < 0 ? [] : [ball(other.at(there))];
        other.readout.textContent = readout.textContent = there < 0 ? "no vertex is matched to this one"
          : model.get("link_text").replace("{here}", hit.vertex).replace("{there}", there) + confidence;
      }
      view.moved();
      return true;
    };
    const view = new View(el, {
      rotation: model.get("rotation"), group: model.get("group"), height: model.get("height"), label: model.get("title"),
      onLasso: (drawn) => { model.set("drawn_around", { ...drawn, count: 1 + (model.get("drawn_around").count || 0) }); model.save_changes(); },
      onPick: model.get("clickable") && ((hit) => { nextCount(); markImage(hit); send("picked", hit); }),
      onHover: model.get("clickable") && ((hit) => {
        if (!model.get("hovering")) return;
        clearTimeout(later);
        nextCount();
        if (markImage(hit)) return; // the kernel gets what the browser cannot answer, at most eight points a second
        later = setTimeout(() => { hovered = Date.now(); send("hovered", hit); }, Math.max(0, 120 + hovered - Date.now()));
      }),
    });
    const still = html(el, "img", { alt: "", class: "s4a-still" }), bar = html(el, "div"), readout = html(el, "div", { class: "s4a-readout", "aria-live": "polite" });
    Object.assign(view, { readout, alone: true, heading: () => model.get("title"), bar: () => model.get("bar") });
    view.update = () => {
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
      view.method = back && link && {
        link, back, colour: model.get("link_color"),
        text: (vertex) => vertex < 0 ? "no vertex is matched to this one" : model.get("link_text").replace("{here}", vertex)
          .replace("{there}", link[vertex] < 0 ? "unknown" : link[vertex])
          .replace("{value}", values && !Number.isNaN(values[vertex]) ? (100 * values[vertex]).toFixed(2) : "unknown"),
      };
      for (const other of view.camera.views) other.update?.(); // remove the marks and captions of the previous match
    };
    const ghosts = () => {
      const position = numbers(Float32Array, model.get("ghost_position")), corner = numbers(Uint32Array, model.get("ghost_corner"));
      view.surfaces = position && corner ? [surface, ghost] : [surface];
      if (position && corner) ghost.setMesh(position, corner);
      if (position && corner) ghost.setColor(new Uint8Array(position.length).map((_, i) => [90, 110, 160][i % 3]));
      view.redraw();
    };
    const texts = () => {
      title.textContent = model.get("title");
      view.name(model.get("title") || "surface");
      colorBar(bar, model.get("bar"));
    };
    const answered = () => current() && view.update(); // not of an earlier point
    const lasso = () => {
      view.lasso = model.get("lasso");
      view.updateTouch();
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
      "change:ghost_position": ghosts, "change:title": texts,
      "change:caption": answered, "change:points": answered, "change:answer": answered, "change:bar": texts, "change:still": picture,
      "change:lasso": lasso, "change:rotation": () => view.reset(model.get("rotation")),
    };
    Object.entries(on).forEach(([event, act]) => model.on(event, act));
    geometry(), ghosts(), texts(), answered(), lasso();
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
