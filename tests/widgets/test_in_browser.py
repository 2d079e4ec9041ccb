"""A kernel in the browser: everything works with the compiled packages of Pyodide."""

import json
import os
import subprocess
import sys

import pytest
from paths import ROOT, TESTS

pytest.importorskip("anywidget")


@pytest.fixture(scope="module")
def done(study_folder, structures_folder, tmp_path_factory):
    """Return the results of the script, run in its own process and temporary folder."""
    place = str(tmp_path_factory.mktemp("browser"))
    environment = os.environ | {"TMPDIR": place, "TEMP": place, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(TESTS / "widgets" / "in_browser.py")]
    command += [str(study_folder), str(structures_folder)]
    run = subprocess.run(
        command, env=environment, cwd=place, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr, run.stderr  # of what is raised where nobody can catch it
    return json.loads(run.stdout)


def test_every_panel_and_a_lesson_work_on_a_ready_study(done):
    from s4a import widgets

    without = {"Explore", "Panel", "Progress"}  # all together, their class, that of a process
    panels = set(done["panels"]) - {"Structures", "Region"}  # of the extension
    classes = {name for name, value in vars(widgets).items() if hasattr(value, "_model_name")}
    assert len(panels) == len(classes - without)
    assert done["lesson"].startswith("00")


def test_a_small_collection_is_made_and_analysed(done):
    assert done["modes"] == 2


def test_what_cannot_be_done_says_what_it_needs_and_what_to_do(done):
    said = done["refusals"]
    assert "pip install robust_laplacian" in said["robust_laplacian"]
    assert "open_study" in said["robust_laplacian"]
    assert "s4a.analyse" in said["processes"]
