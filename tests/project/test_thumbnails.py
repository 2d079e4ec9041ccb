"""The gallery's thumbnails: each section with a picture has one, which leads to its code."""

import base64
import gzip
import io
import re
from types import SimpleNamespace

import pytest
from paths import DOCS, script
from PIL import Image

pytest.importorskip("sphinx")
from docutils import nodes

from s4a.show.browser import to_json

thumbnails = script(DOCS / "thumbnails.py")


def png(color):
    file = io.BytesIO()
    Image.new("RGB", (400, 300), color).save(file, "png")
    return file.getvalue()


def section(name, *children):
    return nodes.section("", nodes.title("", name.title()), *children, ids=[name])


def html(text):
    return nodes.raw("", text, format="html")


def resolved(tmp_path, docname="gallery"):
    """A page with a picture in a file, one in HTML, a panel, and a section without any."""
    (tmp_path / "a.png").write_bytes(png("red"))
    inline = base64.b64encode(png("lime")).decode()
    page = f"<script>{to_json({'still': png('blue')})}</script>".encode()
    packed = base64.b64encode(gzip.compress(page)).decode()
    surfaces = section(
        "surfaces",
        section("file", nodes.image(uri="a.png")),
        section("inline", html(f'<img src="data:image/png;base64,{inline}">')),
        section("panel", html(f'<iframe data-page="{packed}"></iframe>')),
    )
    tree = nodes.document(None, None)
    tree += section("gallery", surfaces, section("words", nodes.paragraph("", "none")))
    thumbnails.add(SimpleNamespace(srcdir=tmp_path), tree, docname)
    return tree


def test_each_section_with_a_picture_has_a_thumbnail_that_leads_to_it(tmp_path):
    (grid,) = [node for node in resolved(tmp_path).children[0] if isinstance(node, nodes.raw)]
    found = re.findall(r'href="#(\w+)".*?base64,([^"]+)".*?<span>(\w+)<', grid.astext(), re.DOTALL)
    assert [(name, title) for name, _, title in found] == [
        ("file", "File"), ("inline", "Inline"), ("panel", "Panel")
    ]  # fmt: skip
    for (_, content, _), channel in zip(found, (0, 1, 2), strict=True):
        with Image.open(io.BytesIO(base64.b64decode(content))) as picture:
            assert picture.width <= 200
            assert picture.convert("RGB").getpixel((20, 20))[channel] > 200


def test_other_pages_have_none(tmp_path):
    assert not list(resolved(tmp_path, "method").findall(
        lambda node: isinstance(node, nodes.raw) and "thumbnails" in node.astext()
    ))  # fmt: skip
