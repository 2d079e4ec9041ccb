"""The whole analysis (4, 6.1).

End to end, the same on any number of workers, failures named.
"""

import shutil
from typing import get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small import OPTIONS

from s4a import analyse, statistics, synthesize, synthetic
from s4a.evaluation import accuracy
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.options import DECLARED, Options
from s4a.schema import dataset
from s4a.study import store, tasks

RESULTS = ("network", "latent", "registration", "pca")


@pytest.fixture(scope="module")
def arrays(meshes):
    """The brains as points and triangles."""
    return {name: as_arrays(mesh) for name, mesh in meshes.items()}


def assert_same(one, other):
    """All results equal, bit for bit; times and file keys aside."""
    for stage in RESULTS:
        a, b = (t[stage].to_dataset().drop_attrs(deep=False) for t in (one, other))
        assert a.identical(b), stage


def files(folder):
    """Time and size of every result in a folder, without the files that each run assembles."""
    again = ("report.nc", "registration.nc", "pca.nc", ".lock", ".progress.json")
    return {
        p: (p.stat().st_mtime_ns, p.stat().st_size)
        for p in folder.rglob("*")
        if p.is_file() and p.name not in again
    }


def test_a_study_has_all_stages_and_says_what_it_did(study, brains):
    names = brains["truth"]["shape"].values.tolist()
    assert {*RESULTS, "original", "coarse", "report"} == set(study.children)
    assert list(study["original"].children) == list(study["coarse"].children) == names
    registration, report = study["registration"].to_dataset(), study["report"].to_dataset()
    template = registration.attrs["template"]
    assert template == study["latent"].attrs["median"]
    assert template == study["latent"]["distance_to_limit"].idxmin().item()
    assert registration["displacement"].sizes == {"shape": 4, "vertex": 1500, "xyz": 3}
    assert (registration["displacement"].sel(shape=template) == 0).all()
    assert (registration["confidence"].sel(shape=template) == 1).all()
    assert report["status"].values.tolist() == ["ok"] * 4
    assert report["seconds"].values.min() > 0
    assert report["peak_memory"].values.min() > 10
    assert Options.from_report(report).k_init == 10
    assert study["network"].sizes["pair"] == 12
    assert study["network"]["fmap"].shape == (12, 24, 24)
    assert registration["vertex_area"].sum() == pytest.approx(
        vertex_areas(*as_arrays(study["original"][template].to_dataset())).sum()
    )
    assert set(registration["initialisation"].values) >= {"template"}


def test_lengths_have_the_unit_that_all_shapes_say(study):
    for node, name, unit in (
        ("original/brain_02", "position", "mm"),
        ("coarse/brain_02", "vertex_area", "mm^2"),
        ("registration", "displacement", "mm"),
        ("registration", "position", "mm"),
        ("pca", "deformation", "mm"),
    ):
        assert study[node][name].attrs["units"] == unit, (node, name)


def test_both_resolutions_are_as_smooth_when_their_variance_is_compared(study):
    pca, registration = study["pca"].to_dataset(), study["registration"].to_dataset()
    coarse = study["coarse"][registration.attrs["template"]].to_dataset()
    root = np.sqrt(coarse["vertex_area"].values)[:, None]
    B = root * coarse["eigenfunction"].values
    raw = root * registration["displacement_low"].values
    smooth = np.stack([B @ np.linalg.lstsq(B, d, rcond=None)[0] for d in raw])
    for name, fields in (("low", smooth), ("raw", raw)):
        rows = (fields - fields.mean(0)).reshape(len(fields), -1)
        variance = np.linalg.svd(rows, compute_uv=False)[:-1] ** 2
        result = pca[f"explained_variance_ratio_{name}"].values
        assert result == pytest.approx(variance / variance.sum(), abs=1e-6)
    full, low, noisy = (pca[f"explained_variance_ratio{n}"].values[0] for n in ("", "_low", "_raw"))
    assert noisy < low
    assert abs(low - full) < abs(noisy - full)


def test_the_template_plus_displacement_is_the_aligned_shape(study):
    registration = study["registration"].to_dataset()
    for name in registration["shape"].values:
        one = registration.sel(shape=name)
        X = study[f"original/{name}/position"].values[one["registered_match"].values]
        moved = one["scale"].item() * X @ one["rotation"].values.T + one["translation"].values
        raw = one["position"].values + one["displacement_raw"].values
        assert np.abs(moved - raw).max() < 1e-4
        assert np.linalg.norm(one["displacement"] - one["displacement_raw"], axis=1).mean() < 4


def test_two_workers_give_the_bits_of_one(brains, study):
    assert_same(analyse(brains, **OPTIONS | {"n_jobs": 2}), study)


def test_labels_and_landmarks_stay_with_the_shapes(brains, study):
    for name, mesh in brains["original"].children.items():
        assert np.array_equal(study[f"original/{name}/label"], mesh["label"])
        assert np.array_equal(
            study[f"original/{name}/landmark_position"], mesh["landmark_position"]
        )


def test_labels_stay_with_a_mesh_in_memory_that_is_cleaned(meshes):
    mesh = next(iter(meshes.values()))
    X, T = as_arrays(mesh)
    more = np.concatenate([[[900.0, 0, 0]], X])  # a vertex of no triangle: cleaning drops it
    given = dataset(position=more, corner_vertex=T + 1, label=[99, *mesh["label"].values])
    cleaned = tasks.cleaned(given, "", Options().of("cleaning"))
    assert cleaned["label"].values.tolist() == mesh["label"].values.tolist()


def test_a_study_of_files_knows_their_paths(brain_files, study_of_files):
    assert study_of_files["report"]["path"].values.tolist() == [str(p) for p in brain_files]


def test_meshes_in_memory_in_another_order_give_what_their_files_give(arrays, study_of_files):
    rounded = {  # as PLY holds them
        n: (X.astype(np.float32).astype(float), T) for n, (X, T) in reversed(arrays.items())
    }
    assert_same(analyse(rounded, **OPTIONS), study_of_files)


def test_a_finished_study_is_not_computed_again(brains, study_folder, study, tmp_path):
    work = shutil.copytree(study_folder, tmp_path / "study")
    before = files(work)
    with analyse(brains, store=work, **OPTIONS) as again:
        assert_same(again, study)
    assert files(work) == before


def copied(folder, to):
    for path in folder.rglob("*.nc"):
        target = to / path.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    return to


def test_lost_and_broken_files_are_computed_again_and_no_others(
    brains, study_folder, study, tmp_path
):
    work = copied(study_folder, tmp_path / "study")
    lost = work / "registration" / "brain_01.nc"
    broken, empty = work / "coarse" / "brain_02.nc", work / "latent.nc"
    lost.unlink()
    broken.write_bytes(broken.read_bytes()[:5000])
    empty.write_bytes(b"")
    before = files(work)
    with analyse(brains, store=work, **OPTIONS) as again:
        assert_same(again, study)
    changed = {p for p, state in files(work).items() if before.get(p) != state}
    assert changed == {
        lost,
        broken,
        empty,
        work / "network.nc",
    }  # the network is written with the latent basis


def test_an_option_changes_what_depends_on_it_and_nothing_else(brains, study_folder, tmp_path):
    work = copied(study_folder, tmp_path / "study")
    before = files(work)
    with analyse(brains, store=work, **OPTIONS | {"refine": "intrinsic"}) as other:
        assert set(other["registration"]["initialisation"].values) == {"template", "intrinsic"}
    changed = {
        p.relative_to(work).parts[0] for p, state in files(work).items() if before.get(p) != state
    }
    assert changed == {"registration"}


def test_the_standard_way_runs(brains):
    tree = analyse(
        brains,
        dense_match="fmap",
        refine="intrinsic",
        template="brain_02",
        n_latent=20,
        remove_size=True,
        **OPTIONS,
    )
    assert tree["latent"].sizes["latent"] == 20
    assert tree["registration"].attrs["template"] == "brain_02"
    others = tree["registration"]["scale"].drop_sel(shape="brain_02")
    assert ((others - 1).__abs__() > 1e-6).all()
    assert np.abs(others - 1).max() < 0.2


def test_an_unknown_template_is_refused_with_the_names_before_a_shape_is_read(brains, monkeypatch):
    monkeypatch.setattr("s4a.study.pipeline.clean_shape", None)
    with pytest.raises(ValueError, match="template 'x' is not one of the shapes: brain_01"):
        analyse(brains, template="x", **OPTIONS)


def test_shapes_that_differ_in_pose_alone_do_not_differ(arrays):
    X, T = arrays["brain_01"]
    R = Rotation.from_rotvec([0.05, 0.1, 0]).as_matrix()
    tree = analyse({"a": (X, T), "b": (X, T), "c": (X @ R.T + 9, T)}, **OPTIONS)
    assert np.abs(tree["registration"]["displacement"]).max() < 1e-3
    assert tree["latent"]["distance_to_limit"].max() < 1e-3
    assert tree["network"]["cycle_error"].max() < 1e-3


@pytest.mark.parametrize(
    "given, no_modes",
    [
        ("aa", "PCA needs at least 3 shapes; found 2"),
        ("aaa", "PCA needs shapes that differ; all displacements are equal"),
        (
            "aab",
            "PCA needs at least 3 shapes; found 2; 1 flagged shapes are excluded: "
            "include_flagged=True includes them",
        ),
    ],
)
def test_identical_shapes_give_finite_results_and_modes_only_with_a_shape_that_differs(
    arrays, given, no_modes
):
    mesh = {"a": arrays["brain_01"], "b": arrays["brain_02"]}
    tree = analyse({f"s{i}": mesh[one] for i, one in enumerate(given)}, **OPTIONS)
    for node in tree.subtree:
        for name, data in node.to_dataset(inherit=False).data_vars.items():
            # two shapes make no 3-cycle; of three, the second of two equal ones is excluded
            if data.dtype.kind == "f" and (
                tree["network"].sizes["pair"] > 2 or "cycle" not in name
            ):
                assert np.isfinite(data).all(), f"{node.path} {name}"
    assert (
        np.abs(tree["registration"]["displacement"].sel(shape=["s0", "s1"]).diff("shape")).max()
        < 1e-3
    )
    assert tree["report"].attrs["no_modes"] == no_modes
    assert ("pca" in tree) == (not no_modes)
    assert "the median is not unique" in tree["report"].attrs["remarks"]
    with pytest.raises(ValueError, match="statistics need at least 4 shapes"):
        statistics.evaluate(tree)
    why = f"a study with /pca is needed; this one has none: {no_modes[:27]}"
    with pytest.raises(ValueError, match=why):
        synthesize(tree, [1.0])


def test_one_usable_shape_is_not_enough_and_the_reasons_are_named(arrays):
    X, T = arrays["brain_01"]
    with pytest.raises(ValueError, match=r"at least 2 usable shapes, found 1 \(bad: .*\)"):
        analyse({"good": (X, T), "bad": (X, T[:0])}, **OPTIONS)


def out_of_range():
    """A few invalid values of every option, and what the message says."""
    for name, one in DECLARED.items():
        kinds, known = get_args(one.type) or (one.type,), one.metadata
        if known["choices"]:
            choices = ", ".join(map(repr, known["choices"]))
            yield {name: "random"}, f"{name} must be one of (None, )?{choices}; found 'random'"
        elif known["check"] is None and kinds[0] in (bool, int):
            least = known["least"]
            need = "True or False" if kinds[0] is bool else f"an integer of at least {least}"
            for value in (least - 1, 30.5, "no", *([True] if kinds[0] is int else [2])):
                yield {name: value}, f"{name} must be {need}; found {value!r}"
    tree_to_all = r"give an integer from 3 \(a tree\) to 6 \(all pairs\)"
    yield {"n_pairs": 2}, rf"n_pairs = 2 cannot connect 4 shapes: {tree_to_all}"
    yield {"k": 9}, "k must be at least k_init = 10; found 9"
    yield {"n_latent": 25}, "n_latent must be at most k = 24; found 25"
    for value in ("foo", True):
        needs = 'components needs to be "largest", "all" or a number from 1'
        yield {"components": value}, f"{needs}; found {value!r}"
    yield {"pattern": 3}, "pattern must be a text or None; found 3"


def test_an_option_out_of_range_is_refused_with_the_legal_range_before_a_shape_is_read(
    brains, monkeypatch
):
    monkeypatch.setattr("s4a.study.pipeline.clean_shape", None)
    wrong = list(out_of_range())
    assert len(wrong) > 80
    for options, message in wrong:
        with pytest.raises(ValueError, match=message):
            analyse(brains, **OPTIONS | options)


def test_names_that_would_nest_are_refused(arrays):
    X, T = arrays["brain_01"]
    with pytest.raises(ValueError, match=r"1 to 100 letters, digits, _ or -; found \['a/b'\]"):
        analyse({"a/b": (X, T), "c": (X, T)}, **OPTIONS)


def test_a_second_run_in_the_same_folder_is_refused(brains, tmp_path):
    with store.lock(tmp_path), pytest.raises(ValueError, match="another run"):
        analyse(brains, store=tmp_path, **OPTIONS)


def test_the_registered_surface_is_four_times_more_accurate_than_nearest_neighbours():
    tree = synthetic.brains(3, 3000)
    truth = tree["truth"]
    result = analyse(tree, n_coarse=1200, k=60, n_jobs=1)

    def image(shape, template):
        return synthetic.position(truth, shape, truth[template]["reference_point"].values)

    errors, sampled = (accuracy.accuracy(result, image, n_vertices=n)["error"] for n in (None, 750))
    assert sampled.mean("shape").values == pytest.approx(errors.mean("shape").values, rel=0.05)
    methods = (accuracy.SURFACE, accuracy.MATCH, accuracy.ZOOMOUT, accuracy.ICP)
    surface, matched, zoomout, icp = (errors.sel(algorithm=m).values for m in methods)
    assert surface.mean() < icp.mean() / 4
    assert matched.mean() < zoomout.mean() / 2
    assert (surface < matched).all()
    assert (surface < zoomout).all()
