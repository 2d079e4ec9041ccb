"""What Binder builds: its files agree with pyproject.toml, the paths of the links exist.

And the study is made.
"""

import os
import re
import shutil
import subprocess
import sys
import tomllib

import h5py
import numpy as np
import pytest
from paths import ROOT, script

import s4a
from s4a.study.tree import open_study

BINDER = ROOT / "binder"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def lines(name):
    return [line for line in (BINDER / name).read_text(encoding="utf-8").splitlines() if line]


def distributions(requirements):
    """Name of each distribution -> the rest of its requirement."""
    return dict(re.match(r"([\w.-]+(?:\[[\w,]+\])?)(.*)", line).groups() for line in requirements)


@pytest.fixture(scope="module")
def prepare():
    return script(BINDER / "prepare.py")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("binder") / "whole"
    options = {"n_coarse": 100, "n_pairs": 3, "k": 20, "keep_doubtful": True}
    s4a.analyse(s4a.synthetic.brains(3, 300), **options, store=folder)
    return folder


@pytest.fixture
def folder(prepare, whole, monkeypatch, tmp_path):
    """What is made where nothing is there yet; the analysis itself is that of `whole`."""
    monkeypatch.setattr(
        s4a, "analyse", lambda shapes, *, store, **options: shutil.copytree(whole, store)
    )
    return prepare.collection(tmp_path / "study", n=3, n_vertices=300)


def test_the_requirements_install_this_project_with_extras_that_it_has():
    (named,) = re.findall(r"^-e \.\[([\w,]+)\]$", "\n".join(lines("requirements.txt")), re.M)
    extras = PROJECT["optional-dependencies"]
    needed = distributions(line for extra in named.split(",") for line in extras[extra])
    assert {"s4a[notebook]", "s4a[labels]", "nilearn", "pymeshlab"} <= set(needed)
    assert {"jupyterlab", "ipywidgets", "anywidget"} <= set(distributions(extras["notebook"]))


def test_what_they_install_besides_has_lower_bounds_only_and_stands_nowhere_else():
    others = distributions(line for line in lines("requirements.txt") if not line.startswith("-e"))
    assert others
    listed = distributions(
        sum(
            (PROJECT["optional-dependencies"][e] for e in ("notebook", "course")),
            PROJECT["dependencies"],
        )
    )
    assert not set(others) & set(listed)
    assert all(re.fullmatch(r">=[\d.]+", bound) for bound in others.values())


def test_the_runtime_is_a_python_that_the_project_allows():
    (runtime,) = lines("runtime.txt")
    major, minor = re.fullmatch(r"python-(\d+)\.(\d+)", runtime).groups()
    least = re.fullmatch(r">=(\d+)\.(\d+)", PROJECT["requires-python"]).groups()
    assert (int(major), int(minor)) >= tuple(map(int, least))


def test_pymeshlab_has_its_libraries_there_and_is_no_dependency_of_the_library_itself():
    # GPL-3: a user installs it, or the image of Binder, but never the library by itself
    checked = re.findall(r"lib\w+\.so\.\d+:(\w+)", (ROOT / ".ci" / "run").read_text())
    assert lines("apt.txt") == checked
    of_extra = PROJECT["optional-dependencies"]
    assert [e for e in of_extra if "pymeshlab" in distributions(of_extra[e])] == ["wrap"]
    assert "pymeshlab" not in distributions(PROJECT["dependencies"])
    assert not any("wrap" in line for line in (*of_extra["course"], *of_extra["notebook"]))


def test_post_build_is_executable_stops_at_an_error_and_runs_what_is_there():
    text = (BINDER / "postBuild").read_text(encoding="utf-8")
    assert os.access(BINDER / "postBuild", os.X_OK)
    assert text.startswith("#!/bin/bash\n")
    assert "set -eu" in text
    paths = re.findall(r"\S+\.(?:py|ipynb)", text)
    assert len(paths) == 2
    assert all((ROOT / path).is_file() for path in paths)


@pytest.mark.skipif(not (shutil.which("bash") and shutil.which("git")), reason="needs bash, git")
def test_the_trial_ends_at_the_first_step_that_fails_and_shows_what_it_said(tmp_path):
    binder = tmp_path / "binder"
    binder.mkdir()
    shutil.copy(BINDER / "try.sh", binder)
    (binder / "requirements.txt").write_text("")
    (binder / "postBuild").write_text("#!/bin/bash\necho it broke\nexit 3\n")
    (binder / "postBuild").chmod(0o755)
    author = "-c user.name=nobody -c user.email=nobody@localhost".split()
    for words in (["init", "-q"], ["add", "-A"], [*author, "commit", "-q", "-m", "all"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    trial = subprocess.run(
        [binder / "try.sh"],
        env=os.environ | {"PYTHON": sys.executable},
        capture_output=True,
        text=True,
        check=False,
    )
    assert trial.returncode != 0
    assert "it broke\n\npostBuild failed (3)" in trial.stdout
    assert "lesson 00" not in trial.stdout + trial.stderr


def test_the_links_of_the_readme_open_notebooks_that_are_there():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    links = re.findall(
        r"^\[[\w -]+\]: https://mybinder\.org/v2/gh/[\w.-]+/[\w.-]+/HEAD\?urlpath=(\S+)$",
        text,
        re.M,
    )
    opened = [re.fullmatch(r"(lab/tree|voila/render)/(.+\.ipynb)", link).groups() for link in links]
    assert {kind for kind, _ in opened} == {"lab/tree", "voila/render"}
    assert all((ROOT / path).is_file() for _, path in opened)
    assert ("lab/tree", "notebooks/00_explore.ipynb") in opened


def test_the_study_of_51_has_what_every_panel_shows(folder):
    panels = pytest.importorskip("s4a.widgets.explore")
    study = open_study(folder)
    shown = panels.explore(study)
    for title in panels.PANELS:
        shown[title]
    assert shown.panels.keys() == panels.PANELS.keys()
    shown.close()


def test_it_is_that_of_the_analysis_to_four_digits(folder, whole):
    study, exact = open_study(folder), open_study(whole)
    for name in (
        "pca/deformation",
        "registration/displacement",
        "latent/area_difference",
        "network/fmap",
    ):
        scale = np.abs(exact[name].values).max()
        assert np.abs(study[name].values - exact[name].values).max() < 2e-4 * scale
    assert study["latent"].attrs["median"] == exact["latent"].attrs["median"]
    assert "displacement_raw" not in study["registration"]


def test_its_larger_variables_are_compressed_on_disk(folder, prepare):
    larger = set()
    for path in folder.rglob("*.nc"):
        with h5py.File(path) as file:
            for name, one in file.items():
                if one.dtype.kind in "iuf" and one.size > 1000:
                    larger.add(name)
                    assert (one.compression, one.shuffle) == ("gzip", True), (path.name, name)
    assert {"eigenfunction", "deformation"} <= larger


def test_at_its_true_size_it_is_small_enough_and_has_ten_modes(prepare, tmp_path):
    study = open_study(prepare.collection(tmp_path / "study"))
    assert study["registration/displacement"].sizes == {"shape": 51, "vertex": 2000, "xyz": 3}
    assert s4a.synthesize(study, [0.0] * 9 + [3.0])["position"].shape == (2000, 3)


def test_rounding_keeps_its_digits_and_what_is_not_finite(prepare):
    values = np.r_[np.random.default_rng(0).normal(size=1000), 0, np.nan, np.inf]
    found = prepare.rounded(values)
    assert (np.abs(found[:1001] - values[:1001]) <= 2.0**-13 * np.abs(values[:1001])).all()
    assert np.isnan(found[1001])
    assert np.isinf(found[1002])


def test_a_study_that_is_there_is_not_computed_again(folder, prepare, monkeypatch):
    monkeypatch.setattr(s4a, "analyse", None)
    assert prepare.collection(folder) == folder


def test_a_study_that_would_be_too_large_is_refused(folder, prepare, monkeypatch):
    monkeypatch.setattr(prepare, "LIMIT", 1000)
    with pytest.raises(ValueError, match="at most 0 MB"):
        prepare.collection(folder.with_name("other"), n=3, n_vertices=300)
    assert list(folder.parent.iterdir()) == [folder]
