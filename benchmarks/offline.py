"""The lessons of the documentation without a kernel: bytes, what the console says, other hosts.

``offline.py [FOLDER] [NAME ...]`` serves the pages of ``make docs``, in ``docs/_build/html`` by
default, as plain files (as ``python -m http.server`` does), opens each lesson in Chromium, shows
every tab of its panels, moves a slider or another control of each, and prints a row for each page.
It ends with 1 where a page with all that it loads is larger than 5 MB, says an error, asks another
host for anything, has a panel that is not drawn, or shows a widget that needs a kernel.
"""

import contextlib
import functools
import http.server
import re
import sys
import threading
from pathlib import Path

import chromium
from playwright.sync_api import sync_playwright

SITE = Path(__file__).parents[1] / "docs" / "_build" / "html"
LESSONS = ("00", "02", "04", "06", "09")
MOST = 5_000_000  # bytes of a page with all that it loads
WIDGET = re.compile(r"application/vnd\.jupyter\.widget|\b[A-Z]\w+\((children|value)=")
# of a panel: its canvases and charts, as they are seen
SEEN = """(body) => [...body.querySelectorAll("canvas.s4a-view")]
  .map((c) => { c.view.draw(); return c.toDataURL(); })
  .concat([...body.querySelectorAll("svg, output, .text")].map((e) => e.outerHTML)).join()"""
# the first control of a panel that has another value, and that value
MOVE = """(body) => {
  for (const input of body.querySelectorAll("input[type=range], select, input[type=checkbox]")) {
    if (input.disabled || !input.checkVisibility()) continue;
    const before = input.type === "checkbox" ? input.checked : input.value;
    if (input.type === "checkbox") input.checked = !input.checked;
    else if (input.type === "range") input.value = before === input.max ? input.min : input.max;
    else input.value = [...input.options].filter((o) => !o.disabled).at(-1).value;
    if ((input.type === "checkbox" ? input.checked : input.value) === before) continue;
    for (const kind of ["input", "change"]) input.dispatchEvent(new Event(kind, {bubbles: true}));
    return true;
  }
  return false;
}"""


class Files(http.server.SimpleHTTPRequestHandler):
    """Plain files, and no lines about them."""

    def log_message(self, *words):
        """Say nothing."""


@contextlib.contextmanager
def served(folder):
    """The address at which a folder is served as plain files."""
    handler = functools.partial(Files, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def worked(window):
    """The panels of a page: title -> what is wrong, empty where nothing is."""
    found = {}
    for box in window.locator("div.panels").all():
        buttons = box.locator("button").all()
        for i, frame in enumerate(box.locator("iframe.panel").all()):
            if buttons:
                buttons[i].click()
            body = frame.content_frame.locator("body")
            body.locator("canvas.s4a-view, svg").first.wait_for()
            window.wait_for_timeout(500)
            before = body.evaluate(SEEN)
            wrong = [] if body.evaluate(MOVE) else ["nothing can be moved"]
            window.wait_for_timeout(300)
            if not wrong and body.evaluate(SEEN) == before:
                wrong = ["a control changes nothing"]
            found[frame.get_attribute("title")] = "; ".join(wrong)
    return found


def looked_at(browser, base, path):
    """Bytes of a page with all that it loads, its errors, other hosts, and its panels."""
    window = browser.new_page(viewport={"width": 1366, "height": 900})
    errors, hosts, loaded = [], [], []
    window.on("console", lambda m: m.type == "error" and errors.append(m.text))
    window.on("pageerror", lambda error: errors.append(str(error)))
    window.on("requestfailed", lambda request: errors.append(f"failed: {request.url[:80]}"))

    def asked(request):
        if request.url.startswith(base):
            loaded.append(request)
        elif not request.url.startswith(("data:", "blob:", "about:")):
            hosts.append(request.url[:80])

    window.on("request", asked)
    window.goto(base + path, wait_until="load")
    panels = worked(window)
    shown = window.locator(".cell_output").all_inner_texts()
    shown += [s.evaluate("(s) => s.type") for s in window.locator("script[type$='+json']").all()]
    errors += [f"a widget without its kernel: {t[:60]}" for t in shown if WIDGET.search(t)]
    size = sum(len(request.response().body()) for request in loaded)
    window.close()
    return size, errors, hosts, panels


def table(site, names, say):
    """A row for each page whose name begins with one of these; how many fail."""
    say("| page | bytes with all it loads | errors | other hosts | panels that work |")
    say("|---|---|---|---|---|")
    failed = 0
    pages = [path for path in sorted(site.rglob("*.html")) if path.name.startswith(tuple(names))]
    with sync_playwright() as driver, served(site) as base:
        browser = chromium.launched(driver)
        for path in pages:
            name = path.relative_to(site).as_posix()
            size, errors, hosts, panels = looked_at(browser, base, name)
            right = [title for title, wrong in panels.items() if not wrong]
            wrong = [f"NOT {title}: {text}" for title, text in panels.items() if text]
            told = [", ".join(right + wrong) or "none", "; ".join(errors) or "none"]
            say(f"| {name} | {size:,} | {told[1]} | {', '.join(hosts) or 'none'} | {told[0]} |")
            failed += bool(size > MOST or errors or hosts or wrong)
        browser.close()
    return failed if pages else 1


def main(words):
    """Print the table."""
    names = [word for word in words if word[:2].isdigit()] or LESSONS
    folders = [Path(word) for word in words if not word[:2].isdigit()] or [SITE]
    if chromium.PATH is None:
        sys.stderr.write(f"{chromium.LACKS}\n")
        return 2
    failed = table(folders[0], names, lambda line: sys.stdout.write(f"{line}\n"))
    sys.stdout.write(f"\n{failed} of the pages fail\n")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
