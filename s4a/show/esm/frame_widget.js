// The frame of a panel: a button for full screen, the font size, and accessible names of the panel and its sliders.
const PATIENCE = 5000; // ms

// Scripts of widgets also run in a page saved with their state, without a kernel. If a kernel that is not busy does not
// answer, a note says so; a late answer removes the note, as not every front end reports a busy kernel.
function askKernel(model, el) {
  if (model.saved) return () => {}; // a saved page
  const ping = Date.now(), working = ["busy", "starting", "restarting", "autorestarting"];
  const note = html(el, "div", { role: "status", hidden: "", style: "flex: 1" }, "Python does not answer: this panel needs a running kernel; its save_html writes a page that works without one.");
  const wait = setInterval(() => { note.hidden = working.includes(model.widget_manager?.kernel?.status); }, PATIENCE);
  const onPong = () => { if (model.get("pong") >= ping) end(); };
  const end = () => { clearInterval(wait); note.remove(); model.off("change:pong", onPong); };
  model.on("change:pong", onPong);
  model.set("ping", ping);
  model.save_changes();
  return end;
}

export default {
  render({ model, el }) {
    el.classList.add("s4a", "s4a-frame");
    const button = html(el, "button", { type: "button", title: "show this panel on the full screen; Escape leaves it" }, "Full screen");
    let panel = null, watch = null;
    const named = () => panel.querySelectorAll(".widget-inline-hbox").forEach((control) => {
      const labels = [...control.querySelectorAll("label, .widget-label")], text = labels.map((at) => at.textContent.replace("\u200b", "")).find(Boolean); // of a checkbox it is a zero-width space
      const handle = control.querySelector("[role=slider]"), color = control.querySelector("input[type=color]");
      const help = model.get("help")[text] || (color && labels.find((at) => at.title)?.title); // only the hidden label of a colour picker has the tooltip
      if (help && control.title !== help) control.title = help;
      if (help && help !== text) for (const at of control.querySelectorAll("[title]")) if (at.title === text) at.title = help; // a checkbox repeats its name
      if (text && handle && handle.getAttribute("aria-label") !== text) handle.setAttribute("aria-label", text);
      if (help && color && color.getAttribute("aria-label") !== help) color.setAttribute("aria-label", help);
    });
    const sized = () => {
      const font = model.get("font");
      if (font) panel?.style.setProperty("--s4a-font", `${font}px`);
      else panel?.style.removeProperty("--s4a-font");
    };
    const attach = () => { // when the panel is in the page
      if (panel || !(panel = el.closest(".s4a-panel"))) return;
      panel.setAttribute("role", "region");
      panel.setAttribute("aria-label", model.get("title"));
      ownKeys(panel);
      button.hidden = !panel.requestFullscreen || document.fullscreenEnabled === false;
      (watch = new MutationObserver(named)).observe(panel, { childList: true, subtree: true, attributeFilter: ["title"] });
      named();
      sized();
    };
    const updateButton = () => (button.textContent = panel && document.fullscreenElement === panel ? "Leave full screen" : "Full screen");
    button.addEventListener("click", () => (document.fullscreenElement === panel ? document.exitFullscreen() : panel.requestFullscreen()));
    const observer = new ResizeObserver(attach);
    observer.observe(el);
    document.addEventListener("fullscreenchange", updateButton);
    model.on("change:font", sized);
    const end = askKernel(model, el);
    return () => {
      end();
      observer.disconnect();
      watch?.disconnect();
      document.removeEventListener("fullscreenchange", updateButton);
      model.off("change:font", sized);
    };
  },
};
