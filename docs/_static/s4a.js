// What scrolls sideways can be reached and scrolled with the keyboard: tables, formulas, code.
function reach() {
  for (const box of document.querySelectorAll(".table-wrapper, .math-wrapper, pre, .cell_output")) {
    const scrolls = box.scrollWidth > box.clientWidth || box.scrollHeight > box.clientHeight;
    if (scrolls) box.tabIndex = 0;
    else box.removeAttribute("tabindex");
  }
}
addEventListener("load", reach);
addEventListener("resize", reach);
