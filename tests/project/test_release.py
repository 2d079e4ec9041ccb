"""What is given away: the address, the workflows, the wheel, and what Binder builds.

The wheel runs as by ``uvx s4a demo``, from a folder as index and in an environment of its own.
What S4A depends on is not copied there: each dependency is a wheel of nothing but a line that names
the packages of this environment.  ``tools/try.sh`` does the same with those of the package index.
"""

import itertools
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from importlib.metadata import version

import h5py
import numpy as np
import pytest
import yaml
from paths import ROOT, script

import s4a

release = script(ROOT / "tools" / "release.py")
BINDER = ROOT / "binder"


def text(name, root=ROOT):
    return (root / name).read_text(encoding="utf-8")


PROJECT = tomllib.loads(text("pyproject.toml"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
LIBRARIES = re.findall(r"lib\w+\.so\.\d+:(\w+)", text(".ci/run"))  # of PyMeshLab
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def name_of(requirement):
    return re.match(r"[\w.-]+(\[[\w,]+\])?", requirement)[0]


# ---- the address and the version


@pytest.fixture
def copy(tmp_path):
    """The files with the address and the version, elsewhere."""
    for file in {*release.PLACES, "CHANGELOG.md", "conda/recipe.yaml"}:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    return tmp_path


def files_of(folder):
    return [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]


def test_every_place_has_the_address_of_the_one_value_and_no_other_file_has_it():
    name = release.repository()
    for file, pattern in release.PLACES.items():
        assert re.search(pattern, text(file), re.MULTILINE), file
        assert release.with_address(text(file), pattern, name) == text(file), file
    assert ("after publication" in text("README.md")) == name.startswith(release.UNKNOWN)
    if (ROOT / ".git").exists():
        spared = {*release.PLACES, "tests/project/test_release.py", "tools/release.py"}
        files = [
            f for f in release.tracked() if f.as_posix() not in spared and (ROOT / f).is_file()
        ]
        said = re.compile(rf"(github\.com|v2/gh)/{re.escape(name)}".encode())
        assert [file for file in files if said.search((ROOT / file).read_bytes())] == []


def test_another_address_comes_into_every_place_and_the_versions_have_to_agree(copy):
    release.write_address("someone/shapes-4a", copy)
    urls = tomllib.loads(text("pyproject.toml", copy))["project"]["urls"].values()
    assert all(url.startswith("https://github.com/someone/shapes-4a") for url in urls)
    assert text("README.md", copy).count("mybinder.org/v2/gh/someone/shapes-4a/HEAD?urlpath=") == 2
    found = release.faults("99.0", copy, files_of(copy))
    for file in ("pyproject.toml", "conda/recipe.yaml"):
        assert f"{file}: version {PROJECT['version']}, not 99.0" in found
    cff = text("CITATION.cff", copy) + "date-released: 2026-12-01\n"
    (copy / "CITATION.cff").write_text(cff, "utf-8")
    head = f"\n## {PROJECT['version']}, 2026-12-01\n"
    log = re.sub(r"\n## .*\n", head, text("CHANGELOG.md", copy), count=1)
    (copy / "CHANGELOG.md").write_text(log, "utf-8")
    assert release.faults(PROJECT["version"], copy, files_of(copy)) == []


# ---- what is installed and run elsewhere


def test_workflows_run_what_is_there_may_only_read_and_try_every_python_that_is_promised():
    makefile = text("Makefile")
    for path in WORKFLOWS:
        workflow = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert workflow["permissions"] == {"contents": "read"}
        assert "secrets." not in path.read_text(encoding="utf-8")
        steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
        run = "\n".join(step.get("run", "") for step in steps)
        targets = re.findall(r"^make ([\w-]+)", run, re.MULTILINE)
        assert [target for target in targets if f"\n{target}:" not in makefile] == []
        files = re.findall(r"(?:\.ci|tests|benchmarks)/[\w/.]*", run)
        assert [file for file in files if not (ROOT / file).exists()] == []
        assert {*re.findall(r"\.\[(\w+)\]", run)} <= {*EXTRAS}
        for installed in re.findall(r"apt-get install \S+ -y (.+)", run):
            assert installed.split() == LIBRARIES
    jobs = yaml.safe_load(text(".github/workflows/tests.yml"))["jobs"]
    assert jobs["others"]["strategy"]["matrix"]["os"] == ["macos-latest", "windows-latest"]
    tried = jobs["whole"]["strategy"]["matrix"]["python"]
    assert tried == [c.split()[-1] for c in PROJECT["classifiers"] if "Python :: 3." in c]
    assert PROJECT["requires-python"] == f">={tried[0]}"
    (quick,) = re.findall(r"^QUICK := (.+)$", makefile, re.MULTILINE)
    assert [path for path in quick.split() if not (ROOT / path).exists()] == []


def test_every_dependency_has_a_floor_and_no_ceiling_and_conda_has_the_same():
    for requirement in [*PROJECT["dependencies"], *itertools.chain(*EXTRAS.values())]:
        own = re.match(r"s4a(-morphometrics)?(\[|$)", requirement)
        assert own or re.fullmatch(r"[\w.-]+(\[\w+\])?>=[\d.]+", requirement), requirement
    recipe = yaml.safe_load(text("conda/recipe.yaml"))
    assert PROJECT["requires-python"] == f">={recipe['context']['python_min']}"
    renamed = {"libigl": "igl", "robust_laplacian": "robust-laplacian"}  # in conda-forge
    pairs = [re.split("(?=>=)", needed) for needed in PROJECT["dependencies"]]
    wanted = [f"{renamed.get(name, name)} {floor}" for name, floor in pairs]
    assert recipe["requirements"]["run"][1:] == wanted
    assert recipe["about"]["license"] == PROJECT["license"]
    # GPL-3: a user installs it, or the image of Binder, but never the library by itself
    having = [e for e, needed in EXTRAS.items() if "pymeshlab" in map(name_of, needed)]
    assert having == ["wrap"]
    assert "pymeshlab" not in map(name_of, PROJECT["dependencies"])


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
        for file, content in files.items():
            wheel.writestr(file, content)


def test_the_wheel_holds_the_package_alone_and_uvx_runs_its_demo(tmp_path, monkeypatch):
    hatchling = pytest.importorskip("hatchling.build")
    pytest.importorskip("uv")
    index = tmp_path / "index"
    index.mkdir()
    monkeypatch.chdir(ROOT)
    with zipfile.ZipFile(index / hatchling.build_wheel(str(index))) as wheel:
        names = wheel.namelist()
    there = {f"s4a/{path.as_posix()}" for path in files_of(ROOT / "s4a")}
    assert {n for n in names if ".dist-info/" not in n} == {n for n in there if ".pyc" not in n}
    for needed in PROJECT["dependencies"]:
        stand_in(name_of(needed), index)
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    env |= {"UV_CACHE_DIR": str(tmp_path / "cache"), "UV_NO_CONFIG": "1"}
    run = [sys.executable, "-m", "uv", "tool", "run", "--offline", "--no-index"]
    run += ["--find-links", str(index), "--python", sys.executable, "s4a", "demo"]
    run += ["--shapes", "2", "--vertices", "300", "--n-jobs", "1"]
    found = subprocess.run(run, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    assert (tmp_path / "demo" / "study.html").exists()


# ---- Binder


def test_binder_installs_this_project_and_runs_what_is_there():
    lines = text("binder/requirements.txt").split()
    (extras,) = [re.fullmatch(r"\.\[([\w,]+)\]", line)[1] for line in lines if line[:2] == ".["]
    assert "./morphometrics" in lines  # lessons 15 to 17
    needed = {name_of(one) for extra in extras.split(",") for one in EXTRAS[extra]}
    assert {"s4a[notebook]", "s4a[labels]", "nilearn", "pymeshlab"} <= needed
    others = [line for line in lines if line[0] not in "-."]
    assert all(re.fullmatch(r"[\w-]+>=[\d.]+", other) for other in others)
    runtime = re.fullmatch(r"python-(\d+)\.(\d+)", text("binder/runtime.txt").strip()).groups()
    least = re.fullmatch(r">=(\d+)\.(\d+)", PROJECT["requires-python"]).groups()
    assert [*map(int, runtime)] >= [*map(int, least)]
    assert text("binder/apt.txt").split() == LIBRARIES
    post_build = text("binder/postBuild")
    assert post_build.startswith("#!/bin/bash\n")
    assert "set -eu" in post_build
    assert os.access(BINDER / "postBuild", os.X_OK)
    address = r"^\[[\w -]+\]: https://mybinder\.org/v2/gh/[\w.-]+/[\w.-]+/HEAD\?urlpath=(\S+)$"
    links = re.findall(address, text("README.md"), re.MULTILINE)
    opened = dict(
        re.fullmatch(r"(lab/tree|voila/render)/(.+\.ipynb)", link).groups() for link in links
    )
    assert opened["lab/tree"] == "notebooks/00_explore.ipynb"
    named = [*opened.values(), *re.findall(r"\S+\.(?:py|ipynb)", post_build)]
    assert len(named) == 4
    assert [path for path in named if not (ROOT / path).is_file()] == []


def test_the_study_that_binder_makes_is_compressed_exact_to_four_digits_and_has_its_panels(
    tmp_path, monkeypatch
):
    prepare = script(BINDER / "prepare.py")
    options = {"n_coarse": 100, "n_pairs": 3, "k": 20, "include_flagged": True}
    whole = tmp_path / "whole"
    (tmp_path / "new").mkdir()
    exact = s4a.analyse(s4a.synthetic.brains(3, 300), **options, store=whole)
    monkeypatch.setattr(s4a, "analyse", lambda shapes, *, store, **o: shutil.copytree(whole, store))
    monkeypatch.setattr(prepare, "LIMIT", 1000)
    with pytest.raises(ValueError, match="at most 0 MB"):
        prepare.collection(tmp_path / "new" / "study", n=3, n_vertices=300)
    assert list((tmp_path / "new").iterdir()) == []
    monkeypatch.setattr(prepare, "LIMIT", 10**8)
    folder = prepare.collection(tmp_path / "new" / "study", n=3, n_vertices=300)
    monkeypatch.setattr(s4a, "analyse", None)
    assert prepare.collection(folder) == folder, "it is not computed again"
    study = s4a.open_study(folder)
    for name in ("pca/deformation", "registration/displacement", "network/fmap"):
        scale = np.abs(exact[name].values).max()
        assert np.abs(study[name].values - exact[name].values).max() < 2e-4 * scale, name
    for path in folder.rglob("*.nc"):
        with h5py.File(path) as file:
            sets = [one for one in file.values() if isinstance(one, h5py.Dataset)]
            large = [one for one in sets if one.dtype.kind in "iuf" and one.size > 1000]
            assert all((one.compression, one.shuffle) == ("gzip", True) for one in large), path
    panels = pytest.importorskip("s4a.widgets.explore")
    shown = panels.explore(study)
    assert {*shown.panels} <= {*panels.PANELS} == {title for title in panels.PANELS if shown[title]}
    shown.close()
