"""The wheel as ``uvx s4a demo`` runs it: from a folder as index, in an environment of its own.

What S4A depends on is not copied there: each dependency is a wheel of nothing but a line that names
the packages of this environment.  ``tools/try.sh`` does the same with those of the package index,
by uvx and by pipx, and says after how many seconds there is a picture.
"""

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from importlib.metadata import version

import pytest
from paths import ROOT

hatchling = pytest.importorskip("hatchling.build")
pytest.importorskip("uv")

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def stand_in(name, folder):
    """Write a wheel of this name whose only file makes the packages of this environment known."""
    stem, number = re.sub(r"[-.]", "_", name), version(name)
    info = f"{stem}-{number}.dist-info"
    files = {
        f"{stem}.pth": "".join(f"{sysconfig.get_path(key)}\n" for key in ("purelib", "platlib")),
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {number}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    files[f"{info}/RECORD"] = "".join(f"{file},,\n" for file in [*files, f"{info}/RECORD"])
    with zipfile.ZipFile(folder / f"{stem}-{number}-py3-none-any.whl", "w") as wheel:
        for file, text in files.items():
            wheel.writestr(file, text)


@pytest.fixture
def index(tmp_path, monkeypatch):
    """A folder with the wheel of S4A and of what it depends on."""
    folder = tmp_path / "index"
    folder.mkdir()
    monkeypatch.chdir(ROOT)
    hatchling.build_wheel(str(folder))
    for needed in PROJECT["dependencies"]:
        stand_in(re.match(r"[\w.-]+", needed)[0], folder)
    return folder


def test_uvx_runs_the_demo_of_the_wheel_from_a_local_index(index, tmp_path):
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    own = {"UV_CACHE_DIR": str(tmp_path / "cache"), "UV_NO_CONFIG": "1"}
    run = [sys.executable, "-m", "uv", "tool", "run", "--offline", "--no-index"]
    run += ["--find-links", str(index), "--python", sys.executable, "s4a", "demo"]
    options = ["--shapes", "3", "--vertices", "500", "--n-jobs", "1"]
    found = subprocess.run(
        [*run, *options], cwd=tmp_path, env=env | own, capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stderr
    assert {"modes.png", "study.html"} <= {path.name for path in (tmp_path / "demo").iterdir()}
