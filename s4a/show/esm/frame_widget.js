// What every panel has around its parts: a button for the full screen, its own size of text, a name, and names for its sliders.
const PATIENCE = 5000; // ms

// Scripts of widgets run in a page that was saved with their state, too, where no kernel is: whoever does not answer
// while it is not at work is not there. It may come late, as a front end need not say that its kernel works.
function askKernel(model, el) {
  if (model.saved) return () => {}; // a page that answers by itself
  const asked = Date.now(), working = ["busy", "starting", "restarting", "autorestarting"];
  const note = html(el, "div", { role: "status", hidden: "", style: "flex: 1" }, "Python does not answer: this panel is interactive with a running kernel; its save_html writes a page that works without one.");
  const wait = setInterval(() => { note.hidden = working.includes(model.widget_manager?.kernel?.status); }, PATIENCE);
  const heard = () => { if (model.get("pong") >= asked) end(); };
  const end = () => { clearInterval(wait); note.remove(); model.off("change:pong", heard); };
  model.on("change:pong", heard);
  model.set("ping", asked);
  model.save_changes();
  return end;
}

export default {
  render({ model, el }) {
    el.classList.add("s4a", "s4a-frame");
    const button = html(el, "button", { type: "button", title: "this panel alone on the whole screen; Escape ends it" }, "Full screen");
    let panel = null, watch = null;
    const named = () => panel.querySelectorAll(".widget-inline-hbox").forEach((control) => {
      const labels = [...control.querySelectorAll("label, .widget-label")], text = labels.map((at) => at.textContent.replace("\u200b", "")).find(Boolean); // that of a box is a space of no width
      const handle = control.querySelector("[role=slider]"), color = control.querySelector("input[type=color]");
      const help = model.get("help")[text] || (color && labels.find((at) => at.title)?.title); // only the hidden label of a colour has it
      if (help && control.title !== help) control.title = help;
      if (help && help !== text) for (const at of control.querySelectorAll("[title]")) if (at.title === text) at.title = help; // a box says its name again
      if (text && handle && handle.getAttribute("aria-label") !== text) handle.setAttribute("aria-label", text);
      if (help && color && color.getAttribute("aria-label") !== help) color.setAttribute("aria-label", help);
    });
    const sized = () => {
      const font = model.get("font");
      if (font) panel?.style.setProperty("--s4a-font", `${font}px`);
      else panel?.style.removeProperty("--s4a-font");
    };
    const attach = () => { // once the panel is a part of the page
      if (panel || !(panel = el.closest(".s4a-panel"))) return;
      panel.setAttribute("role", "region");
      panel.setAttribute("aria-label", model.get("title"));
      ownKeys(panel);
      button.hidden = !panel.requestFullscreen || document.fullscreenEnabled === false;
      (watch = new MutationObserver(named)).observe(panel, { childList: true, subtree: true, attributeFilter: ["title"] });
      named();
      sized();
    };
    const told = () => (button.textContent = panel && document.fullscreenElement === panel ? "Leave full screen" : "Full screen");
    button.addEventListener("click", () => (document.fullscreenElement === panel ? document.exitFullscreen() : panel.requestFullscreen()));
    const observer = new ResizeObserver(attach);
    observer.observe(el);
    document.addEventListener("fullscreenchange", told);
    model.on("change:font", sized);
    const end = askKernel(model, el);
    return () => {
      end();
      observer.disconnect();
      watch?.disconnect();
      document.removeEventListener("fullscreenchange", told);
      model.off("change:font", sized);
    };
  },
};
