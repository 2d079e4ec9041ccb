"""The workflows of hosted checks agree with the project: what they install and run is there."""

import itertools
import re
import tomllib

import pytest
import yaml
from paths import ROOT

FOLDER = ROOT / ".github" / "workflows"
FILES = sorted(FOLDER.glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
each_file = pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)


def jobs(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]


def commands(path):
    """What all jobs of a workflow run, as one text."""
    steps = [step for job in jobs(path).values() for step in job["steps"]]
    return "\n".join(step.get("run", "") for step in steps)


def test_linux_mac_and_windows_and_every_python_of_the_classifiers_are_tried():
    tests = jobs(FOLDER / "tests.yml")
    assert tests["others"]["strategy"]["matrix"]["os"] == ["macos-latest", "windows-latest"]
    tried = tests["whole"]["strategy"]["matrix"]["python"]
    told = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if "Python :: 3." in c]
    assert tried == told
    assert PROJECT["requires-python"] == f">={tried[0]}"


@each_file
def test_what_it_runs_is_there(path):
    text = commands(path)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^make ([\w-]+)", text, re.MULTILINE):
        assert f"\n{target}:" in makefile
    for file in re.findall(r"(?:\.ci|tests)/[\w/.]*", text):
        assert (ROOT / file).exists(), file
    for extra in re.findall(r"\.\[(\w+)\]", text):
        assert extra in PROJECT["optional-dependencies"]
    for installed in re.findall(r"apt-get install \S+ -y (.+)", text):
        checks = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
        assert installed.split() == re.findall(r"lib\w+\.so\.\d+:(\w+)", checks)


@each_file
def test_it_uses_no_secrets_and_may_only_read(path):
    text = path.read_text(encoding="utf-8")
    assert "secrets." not in text
    assert yaml.safe_load(text)["permissions"] == {"contents": "read"}


def test_the_quick_tests_against_oldest_and_newest_dependencies_are_there():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (quick,) = re.findall(r"^QUICK := (.+)$", makefile, re.MULTILINE)
    assert [path for path in quick.split() if not (ROOT / path).exists()] == []
    assert "RESOLUTION := lowest-direct\n" in makefile
    assert "--resolution $(RESOLUTION)" in makefile


def test_every_dependency_has_a_floor_and_no_ceiling():
    extras = PROJECT["optional-dependencies"].values()
    for requirement in [*PROJECT["dependencies"], *itertools.chain(*extras)]:
        if not requirement.startswith("s4a["):
            assert re.fullmatch(r"[\w.-]+(\[\w+\])?>=[\d.]+", requirement), requirement


CONDA = {"libigl": "igl", "robust_laplacian": "robust-laplacian"}  # names of conda-forge


def test_the_conda_recipe_is_of_this_version_and_has_its_floors():
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == PROJECT["version"]
    assert PROJECT["requires-python"] == f">={recipe['context']['python_min']}"
    pairs = [re.split("(?=>=)", needed) for needed in PROJECT["dependencies"]]
    wanted = [f"{CONDA.get(name, name)} {floor}" for name, floor in pairs]
    assert recipe["requirements"]["run"][1:] == wanted
    assert recipe["about"]["license"] == PROJECT["license"]
