"""Every page of the built documentation in Chromium: what axe finds, and what is too wide.

``pages.py [FOLDER]`` opens each page below FOLDER, ``docs/_build/html`` of ``make docs`` by
default, at 800 pixels, light and dark, lets its panels draw, and prints a row for each page with a
violation or wider than the window; the last line counts all.  It ends with 1 where axe finds
anything serious or critical, or a page says an error.
"""

import sys
from collections import Counter
from pathlib import Path

import chromium
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import sync_playwright

SITE = Path(__file__).parents[1] / "docs" / "_build" / "html"
SERIOUS = ("serious", "critical")
WIDE = 800


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def looked_at(window, page):
    """The violations of a page in light and dark, its width, and the errors that it says."""
    errors = []
    window.on("pageerror", lambda error: errors.append(str(error)))
    found = Counter()
    for scheme in ("light", "dark"):
        window.emulate_media(color_scheme=scheme)
        window.goto(page.as_uri(), wait_until="load")
        window.wait_for_timeout(300)
        for one in Axe().run(window).response["violations"]:
            found[one["id"], one["impact"], scheme] = len(one["nodes"])
    width = window.evaluate("document.documentElement.scrollWidth")
    return found, width, errors


def main(words):
    site = Path(words[0]) if words else SITE
    pages = sorted(path for path in site.rglob("*.html") if "_static" not in path.parts)
    if chromium.PATH is None or not pages:
        sys.stderr.write(f"Chromium and the pages of `make docs` in {site} needed\n")
        return 2
    serious = wide = failed = 0
    say("| page | in | finding | impact | places |")
    say("|---|---|---|---|---|")
    with sync_playwright() as driver:
        browser = chromium.launched(driver)
        for page in pages:
            window = browser.new_page(viewport={"width": WIDE, "height": 700})
            found, width, errors = looked_at(window, page)
            window.close()
            name = page.relative_to(site).as_posix()
            for (what, impact, scheme), places in found.items():
                say(f"| {name} | {scheme} | {what} | {impact} | {places} |")
                serious += impact in SERIOUS
            if width > WIDE:
                say(f"| {name} | | {width} px wide | | |")
            for error in errors:
                say(f"| {name} | | {error} | error | |")
            wide += width > WIDE
            failed += bool(errors)
        browser.close()
    say(
        f"\n{len(pages)} pages in light and dark: {serious} findings that are serious, "
        f"{wide} pages wider than {WIDE} px, {failed} with an error"
    )
    return 1 if serious or failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
