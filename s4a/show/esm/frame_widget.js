// What every panel has around its parts: a button for the full screen, its own size of text, a name, and names for its sliders.
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
    return () => {
      observer.disconnect();
      watch?.disconnect();
      document.removeEventListener("fullscreenchange", told);
      model.off("change:font", sized);
    };
  },
};
