"""Thumbnails at the top of the gallery: a small picture of each section, with a link.

A section is shown by the first picture that its cells make; a panel by the picture that its page
has for a browser without WebGL.
"""

import base64
import gzip
import html
import io
import re
from pathlib import Path

from docutils import nodes
from jinja2 import Environment
from PIL import Image

SIZE = (200, 130)  # pixels
DATA = re.compile(r'src="data:image/[a-z]+;base64,([^"]+)"')
PAGE = re.compile(r'data-page="([^"]+)"')
STILL = re.compile(r'"still": \{"base64": "([^"]+)"\}')
GRID = """
<nav class="thumbnails" aria-label="Pictures">
{% for name, title, picture in shown %}
<a href="#{{ name }}">
<img alt="" src="data:image/webp;base64,{{ picture }}"><span>{{ title }}</span></a>
{% endfor %}
</nav>
"""


def small(content: bytes) -> str:
    """Thumbnail of a picture, as WebP in base 64."""
    file = io.BytesIO()
    with Image.open(io.BytesIO(content)) as picture:
        opened = picture.convert("RGBA")
    white = Image.new("RGBA", opened.size, "white")
    white.alpha_composite(opened)
    white.thumbnail(SIZE)
    white.convert("RGB").save(file, "webp", quality=80)
    return base64.b64encode(file.getvalue()).decode()


def picture_of(section: nodes.section, folder: Path) -> str | None:
    """Thumbnail of a section, or None if it shows no picture."""
    for node in section.findall():
        if isinstance(node, nodes.image) and (folder / node["uri"]).is_file():
            return small((folder / node["uri"]).read_bytes())
        if not isinstance(node, nodes.raw):
            continue
        text = node.astext()
        if page := PAGE.search(text):
            text = gzip.decompress(base64.b64decode(page[1])).decode()
        if found := DATA.search(text) or STILL.search(html.unescape(text)):
            return small(base64.b64decode(found[1]))
    return None


def add(app, doctree, docname):
    """Insert the thumbnails; Sphinx calls this for each page."""
    if docname != "gallery":
        return
    shown = [
        (one["ids"][0], one.next_node(nodes.title).astext(), picture)
        for one in doctree.findall(nodes.section)
        if not any(isinstance(child, nodes.section) for child in one.children)
        and (picture := picture_of(one, Path(app.srcdir)))
    ]
    if shown:
        grid = Environment(autoescape=True).from_string(GRID).render(shown=shown)
        doctree.next_node(nodes.section).insert(1, nodes.raw("", grid, format="html"))
