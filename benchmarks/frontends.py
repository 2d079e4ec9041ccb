"""Which notebook front ends show the panels: JupyterLab, Notebook 7, Voilà and marimo, in Chromium.

    python benchmarks/frontends.py [NAME ...]

Each that is installed beside S4A (``pip install notebook voila marimo``) gets a notebook that opens
a small study and its panel of modes; looked at is whether the surface is drawn, whether a slider
deforms it, whether Python hears of it, whether an arrow key moves the slider, whether the panel
finds its kernel, and what the console of the page says.
"""

import contextlib
import http.client
import importlib.metadata
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import chromium
from playwright.sync_api import sync_playwright

import s4a

OPENED = "import s4a\nfrom s4a.widgets import Modes\n\npanel = Modes(s4a.open_study({study!r}))\n"
# what Python has heard is written where this script can read it
HEARD = """
def heard(change):
    with open({heard!r}, "w") as file:
        file.write(str(change["new"]))

panel.observe(heard, "scores")
"""
MARIMO = """import marimo

app = marimo.App()


@app.cell
def _():
    import marimo as mo
{code}
    view = mo.ui.anywidget(panel.view)
    view
    return


if __name__ == "__main__":
    app.run()
"""
DRAWN = "(canvas) => canvas.view && canvas.view.frames > 0"
SHOT = """(canvas) => { canvas.view.draw(); return canvas.toDataURL(); }"""
MOVE = """(input) => {
  input.value = 2;
  for (const kind of ["input", "change"]) input.dispatchEvent(new Event(kind, {bubbles: true}));
}"""
# what front ends say by themselves, without any panel; Voila asks for a script from elsewhere and
# says so where there is no network
HARMLESS = (
    "t.on is not a function",
    "Unsatisfied version",
    "getter for the shared module",
    "ERR_NAME_NOT_RESOLVED",
    "favicon",
    "status of 40",
)
COMMANDS = {
    "jupyterlab": (
        "-m jupyterlab --ServerApp.port={port} --LabApp.expose_app_in_browser=True "
        "--allow-root --ServerApp.open_browser=False --IdentityProvider.token=",
        "lab/tree/panel.ipynb",
    ),
    "notebook": (
        "-m notebook --ServerApp.port={port} --JupyterNotebookApp.expose_app_in_browser=True "
        "--allow-root --ServerApp.open_browser=False --IdentityProvider.token=",
        "notebooks/panel.ipynb",
    ),
    "voila": ("-m voila panel.ipynb --no-browser --port={port}", ""),
    "marimo": ("-m marimo run panel.py --headless --port {port} --no-token", ""),
}


def notebooks(folder, study, heard):
    """A notebook for Jupyter and one for marimo, that open the same panel."""
    code = OPENED.format(study=str(study)) + HEARD.format(heard=str(heard))
    cell = {"cell_type": "code", "source": f"{code}\npanel", "metadata": {}, "outputs": []}
    cell |= {"execution_count": None, "id": "panel"}
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    whole = {"cells": [cell], "metadata": {"kernelspec": kernel}, "nbformat": 4}
    text = json.dumps(whole | {"nbformat_minor": 5})
    (folder / "panel.ipynb").write_text(text, encoding="utf-8")
    inner = "\n".join(f"    {line}" if line else "" for line in code.splitlines())
    (folder / "panel.py").write_text(MARIMO.format(code=inner), encoding="utf-8")


@contextlib.contextmanager
def served(name, folder, path=None):
    """The address of a front end on a port of its own, of the notebook or another `path`."""
    with contextlib.closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words, own = COMMANDS[name]
    path = own if path is None else path
    command = [sys.executable, *words.format(port=port).split()]
    with open(folder / f"{name}.log", "w") as log:
        process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, env=os.environ)
        try:
            address = f"http://127.0.0.1:{port}/"
            for _ in range(480):
                with (
                    contextlib.suppress(OSError, http.client.HTTPException),
                    urllib.request.urlopen(address + path),
                ):
                    break
                time.sleep(0.25)
            yield address + path
        finally:
            process.terminate()
            process.wait(30)


def tried(name, folder, browser, heard):
    """Whether it is drawn, moved, heard, moved by a key, finds its kernel; errors of its page."""
    messages = []
    heard.unlink(missing_ok=True)
    with served(name, folder) as address:
        page = browser.new_page(viewport={"width": 1366, "height": 900})
        page.set_default_timeout(180_000)
        page.on("console", lambda m: m.type == "error" and messages.append(m.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.goto(address)
        if name in ("jupyterlab", "notebook"):
            page.wait_for_selector(".jp-Cell")
            page.wait_for_timeout(3000)  # the kernel
            page.evaluate("window.jupyterapp.commands.execute('notebook:run-all-cells')")
        canvas = page.locator("canvas.s4a-view").first  # also in a shadow tree, as marimo's
        canvas.wait_for(state="attached")
        drawn = waited(page, lambda: canvas.evaluate(DRAWN))
        before = canvas.evaluate(SHOT)
        slider = page.locator(".s4a-slider input").first
        slider.evaluate(MOVE)
        moved = waited(page, lambda: canvas.evaluate(SHOT) != before)
        answered = waited(page, lambda: heard.exists() and heard.read_text().startswith("[2"))
        slider.focus()
        value = slider.input_value()
        page.keyboard.press("ArrowRight")
        keyed = waited(page, lambda: float(slider.input_value()) > float(value), 5)
        page.wait_for_timeout(6000)  # a panel waits five seconds for its kernel
        known = page.get_by_text("Python does not answer").count() == 0
        page.close()
    told = [m.splitlines()[0] for m in messages if not any(h in m for h in HARMLESS)]
    return drawn, moved, answered, keyed, known, list(dict.fromkeys(told))


def waited(page, condition, seconds=60):
    """Whether a condition comes to hold."""
    for _ in range(4 * seconds):
        if condition():
            return True
        page.wait_for_timeout(250)
    return False


def main(names):
    say = sys.stdout.write
    heads = "surface drawn | a slider deforms it | Python hears of it | an arrow key moves it"
    heads += " | its kernel is found"
    say(f"| front end | {heads} | errors |\n")
    say("|---|---|---|---|---|---|---|\n")
    with tempfile.TemporaryDirectory() as place, sync_playwright() as driver:
        folder, heard = Path(place), Path(place) / "heard"
        brains = s4a.synthetic.brains(5, 2000, seed=1)
        options = {"n_coarse": 500, "k": 24, "k_init": 10, "n_jobs": 1}
        s4a.analyse(brains, store=folder / "study", **options)
        notebooks(folder, folder / "study", heard)
        browser = chromium.launched(driver)
        for name in names or COMMANDS:
            try:
                version = importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                say(f"| {name} is not installed | | | | | | |\n")
                continue
            *held, errors = tried(name, folder, browser, heard)
            cells = ["yes" if one else "NO" for one in held]
            say(f"| {name} {version} | {' | '.join(cells)} | {'; '.join(errors) or 'none'} |\n")
            sys.stdout.flush()
        browser.close()


if __name__ == "__main__":
    main(sys.argv[1:])
