"""Chromium as benchmarks, tests of the browser and figures start it."""

import shutil

from playwright.sync_api import Browser, Playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
PATH = next(filter(None, map(shutil.which, NAMES)), None)
LACKS = "needs Chromium: apt-get install chromium"
# drawn without a graphics card, and nothing is fetched
SWITCHES = (
    "--no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader --disable-quic "
    "--disable-background-networking --no-first-run --disable-component-update --disable-sync"
).split()


def launched(driver: Playwright, *switches: str) -> Browser:
    """A browser, with more switches where given."""
    return driver.chromium.launch(executable_path=PATH, args=[*SWITCHES, *switches])
