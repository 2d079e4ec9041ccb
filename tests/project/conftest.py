"""What several tests of the house need."""

import os
import subprocess
import sys

import pytest
from paths import DOCS, ROOT


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """What the documentation says when it is built, and the folder of its pages."""
    for package in ("furo", "latex2mathml", "myst_nb", "sphinx"):
        pytest.importorskip(package)
    out = tmp_path_factory.mktemp("site")
    options = ["-q", "-W", "--keep-going", "-b", "html", "-d", str(out / "doctrees")]
    command = [sys.executable, "-m", "sphinx", *options, str(DOCS), str(out / "html")]
    found = subprocess.run(
        command,
        env=os.environ | {"S4A_DOCS": "off"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return found, out / "html"
