"""Generalization with new correspondences: each shape left out of the registration (6.1)."""

import numpy as np
import pytest

from s4a import analyse, cli, open_study, statistics, synthetic
from s4a.geometry.mesh import as_arrays
from s4a_morphometrics import generalization
from s4a_morphometrics.leave_one_out import without

OPTIONS = {"n_coarse": 200, "k_init": 8, "k": 12, "n_jobs": 1}
NAMES = [f"brain_{i:02d}" for i in range(1, 7)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a study of six brains."""
    folder = tmp_path_factory.mktemp("left_out") / "study"
    brains = synthetic.brains(7, 400, seed=3)["original"]
    analyse({n: brains[n].to_dataset() for n in NAMES}, store=folder, **OPTIONS).close()
    return folder


@pytest.fixture(scope="module")
def study(folder):
    with open_study(folder) as tree:
        return tree.load()


def test_recomputed_correspondences_generalize_hardly_better_than_those_that_knew_the_shape(study):
    kept = statistics.evaluate(study, n_samples=20, n_permutations=2, n_points=0)
    again = generalization(study, n_points=100)
    assert "optimistic" in kept.attrs["correspondence"]
    assert "recomputed" in again.attrs["correspondence"]
    assert again["generalization"].attrs["units"] == "mm"
    assert again.sizes["component"] == 4
    assert again.attrs["generalization_0"] > 0.8 * kept.attrs["generalization_0"]
    found, known = (one["generalization"].values[:3].mean() for one in (again, kept))
    assert found > 0.95 * known
    assert (np.diff(again["generalization"]) <= 1e-9).all()
    assert (again["generalization_surface"] < again["generalization"]).all()
    assert (again["generalization_error"] > 0).all()
    with pytest.raises(ValueError, match="lacks original"):
        generalization(study.drop_nodes("original"))


def test_without_its_template_a_study_is_registered_to_the_next(study):
    template = study["registration"].attrs["template"]
    other = without(study, template)
    near = study["latent"]["distance_to_limit"].drop_sel(shape=template).idxmin().item()
    data = other["registration"].to_dataset()
    assert data.attrs["template"] == near
    assert template not in data["shape"]
    assert (data["displacement"].sel(shape=near) == 0).all()
    assert data["confidence"].min() < 1
    kept = next(n for n in NAMES if n not in (template, near))
    same = without(study, kept)["registration"].to_dataset()
    assert same.identical(study["registration"].to_dataset().drop_sel(shape=kept))


def test_flagged_shapes_are_left_out_or_included_on_demand():
    tree, small = synthetic.brains(5, 200, seed=2)["original"], OPTIONS | {"n_coarse": 120}
    good = {name: as_arrays(node.to_dataset()) for name, node in tree.children.items()}
    X, T = good["brain_01"]
    study = analyse(good | {"a_metre": (X / 1000, T)}, **small)
    found, alone = (generalization(one, n_points=0) for one in (study, analyse(good, **small)))
    assert found.identical(alone)
    kept = statistics.with_flagged(study)
    assert generalization(kept, n_points=0).attrs["shapes"] == 6


def test_the_command_prints_errors_with_the_number_of_components(folder, capsys):
    assert cli.main(["generalization", str(folder), "--n-jobs", "1"]) == 0
    printed = capsys.readouterr().out
    assert "lengths in mm" in printed
    assert "to the surface" in printed
    assert (folder / "statistics" / "generalization.nc").is_file()
