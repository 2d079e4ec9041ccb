// What every panel has around its parts: a button for the full screen, its own size of text, a name, and names for its sliders.
export default {
  render({ model, el }) {
    el.classList.add("s4a", "s4a-frame");
    const button = html(el, "button", { type: "button", title: "this panel alone on the whole screen; Escape ends it" }, "Full screen");
    let panel = null, watch = null;
    const named = () => panel.querySelectorAll(".widget-inline-hbox").forEach((control) => {
      const text = control.querySelector("label, .widget-label")?.textContent, handle = control.querySelector("[role=slider]");
      const help = model.get("help")[text];
      if (help && control.title !== help) control.title = help;
      if (text && handle && handle.getAttribute("aria-label") !== text) handle.setAttribute("aria-label", text);
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
      (watch = new MutationObserver(named)).observe(panel, { childList: true, subtree: true });
      named();
      sized();
    };
    const told = () => (button.textContent = panel && document.fullscreenElement === panel ? "Leave full screen" : "Full screen");
    button.addEventListener("click", () => (document.fullscreenElement === panel ? document.exitFullscreen() : panel.requestFullscreen()));
    const observer = new ResizeObserver(attach);
    observer.observe(el);
    document.addEventListener("fullscreenchange", told);
    model.on("change:font", sized);
    return () => {
      observer.disconnect();
      watch?.disconnect();
      document.removeEventListener("fullscreenchange", told);
      model.off("change:font", sized);
    };
  },
};
