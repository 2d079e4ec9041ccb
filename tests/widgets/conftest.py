"""Browsers, a JupyterLab for each module, and pages without kernel and network."""

import contextlib
import os
import socket
import subprocess
import sys
import time
import urllib.request

import pytest


@pytest.fixture(scope="session", autouse=True)
def small_stills():
    """Let stills of panels, which take most of the time of saving them, have few pixels."""
    views = pytest.importorskip("s4a.widgets.views")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(views, "SIZE", (120, 96))
        yield


@pytest.fixture
def closed_later():
    """Make panels that are closed after the test, when nothing of them may be left."""
    from ipywidgets.widgets import widget as registry  # the open widgets are counted in it

    before, made = len(registry._instances), []

    def make(kind, *values, **options):
        made.append(kind(*values, **options))
        return made[-1]

    yield make
    for panel in made:
        panel.close()
    assert len(registry._instances) == before


@pytest.fixture(scope="module")
def lab(folder):
    """Start a JupyterLab and return its address."""
    with contextlib.closing(socket.socket()) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {
        f"JUPYTER_{name}_DIR": str(folder / name.lower()) for name in ("CONFIG", "DATA", "RUNTIME")
    }
    options = {
        "ServerApp.port": port,
        "ServerApp.root_dir": folder,
        "ServerApp.open_browser": False,
        "IdentityProvider.token": "",
        "LabApp.app_settings_dir": folder / "app",
        "LabApp.expose_app_in_browser": True,  # for its themes
    }
    command = [sys.executable, "-m", "jupyterlab", "--allow-root"]
    command += [f"--{k}={v}" for k, v in options.items()]
    env = os.environ | own | {"IPYTHONDIR": str(folder / "ipython")}
    with open(folder / "lab.log", "w") as log:
        process = subprocess.Popen(command, env=env, stdout=log, stderr=log)
        try:
            wait_for(f"http://127.0.0.1:{port}/api", folder / "lab.log")
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:  # held by a kernel that is busy
                process.kill()
                process.wait()


def wait_for(address, log, seconds=60):
    for _ in range(4 * seconds):
        with contextlib.suppress(OSError), urllib.request.urlopen(address):
            return
        time.sleep(0.25)
    raise TimeoutError(log.read_text())


def chromium():
    """Start Chromium; skip the test if it is not installed."""
    from browsing import chromium

    if chromium.PATH is None:
        pytest.skip(chromium.LACKS)
    return chromium


@pytest.fixture(scope="module")
def driver():
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        yield driver


@pytest.fixture(scope="module")
def browser(driver):
    browser = chromium().launched(driver)
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def flat(driver):
    """A browser that has no WebGL."""
    browser = chromium().launched(driver, "--disable-3d-apis")
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def messages():
    return []


@pytest.fixture(scope="module")
def offline(browser):
    context = browser.new_context(offline=True)
    yield context
    context.close()


@pytest.fixture
def show(offline, tmp_path):
    """Open a saved page, or the page of a panel, which is closed; no page may have an error.

    Of each slider of a panel `n_values` values are recorded, which takes most of the time.
    """
    from browsing import DRAWN, watched

    from s4a.show import panel_page

    pages, errors = [], []

    def opened(what, context=offline, *, drawn=True, n_values=3, **options):
        if hasattr(what, "save_html"):
            panel, what = what, tmp_path / f"panel_{len(pages)}.html"
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(panel_page, "N_VALUES", n_values)
                panel.save_html(what, **options)
            panel.close()
        page = watched(context.new_page(), errors)
        pages.append(page)
        page.set_default_timeout(30_000)
        page.goto(what.as_uri())
        if drawn:
            page.wait_for_function(DRAWN)
        return page

    yield opened
    for page in pages:
        page.close()
    assert errors == []
