"""The preset of the paper and the switches of what is added, wherever shapes are registered."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.distance import cdist
from small import FLAGS, OPTIONS

import s4a
from s4a.analysis import transfer
from s4a.cli import main
from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays
from s4a.options import DECLARED, PRESETS, Options, with_options
from s4a.study import pair

PAPER, FAST = PRESETS["paper"], PRESETS["fast"]
DEFAULTS = {name: PRESETS[None][name] for name in PAPER}
PAIR = {name: OPTIONS[name] for name in ("n_coarse", "k_init", "k")}


@pytest.fixture(scope="module")
def three(meshes):
    """Three of the four brains."""
    return dict(list(meshes.items())[:3])


@pytest.fixture(scope="module")
def paper(three, tmp_path_factory):
    """The folder of their study, as in the paper, with holes closed and iterations kept."""
    folder = tmp_path_factory.mktemp("paper") / "study"
    options = {"preset": "paper", "close_holes": True, "keep_iterations": True}
    s4a.analyse(three, store=folder, **options, **OPTIONS).close()
    return folder


def test_the_fast_preset_sets_what_it_is_for_and_leaves_the_rest():
    options = Options(preset="fast", refine="spectral_icp")
    assert {name: getattr(options, name) for name in FAST} == FAST
    assert options.refine == "spectral_icp"
    with pytest.raises(ValueError, match="preset 'fast' sets n_coarse=3000; found n_coarse=500"):
        Options(preset="fast", n_coarse=500)


@pytest.mark.parametrize(
    ("own", "given", "n_coarse"),
    [
        ({"preset": "fast"}, {"preset": None}, 6000),
        ({"preset": "fast"}, {"preset": "paper"}, 6000),
        ({"n_coarse": 500}, {"preset": "fast"}, 3000),
        ({"n_coarse": 500}, {"preset": "paper"}, 500),
        ({"n_coarse": 500, "preset": "paper"}, {"preset": None}, 500),
        ({"preset": "fast"}, {"k": 50}, 3000),
    ],
)
def test_another_preset_takes_back_what_the_one_before_it_set(own, given, n_coarse):
    options = Options(**own).changed(given)
    assert options.n_coarse == n_coarse
    assert options.preset == given.get("preset", own.get("preset"))


def test_an_option_that_the_preset_fixes_is_refused_by_name(meshes):
    source, target, *_ = meshes.values()
    for name in [name for name in PAPER if PAPER[name] != DEFAULTS[name]]:
        message = f"preset 'paper' sets {name}={PAPER[name]!r}; found {name}={DEFAULTS[name]!r}"
        given = {"preset": "paper", name: DEFAULTS[name]}
        with pytest.raises(ValueError, match=message):
            Options(**given)
        if DECLARED[name].metadata["pair"]:
            with pytest.raises(ValueError, match=message):
                s4a.match_pair(source, target, **given)
            with pytest.raises(ValueError, match=message):
                s4a.register_pairs(source, {"a": target}, **given)


def test_options_are_kept_with_their_types_and_come_back():
    given = {
        "template": "None",
        "features": ["a", "b"],
        "table": Path("t.csv"),
        "seed": np.int64(3),
    }
    options = Options(preset="paper", k=np.int32(50), components=2, remove_size=np.True_, **given)
    report = xr.Dataset(attrs=with_options({"template": "the median"}, vars(options)))
    assert Options.from_report(report) == options
    assert Options.from_report(xr.DataTree.from_dict({"report": report})) == options
    assert Options.from_report(xr.Dataset()) == Options()
    assert (options.template, options.features, options.table) == ("None", "a,b", "t.csv")


def test_a_misspelt_option_is_refused_with_the_one_that_is_meant(three):
    with pytest.raises(TypeError, match=r"unexpected option n_corse; did you mean n_coarse\?"):
        s4a.analyse(three, n_corse=300)


def test_keywords_override_options(three):
    given = Options(n_coarse=200, k=12, k_init=8, n_pairs=3, seed=5)
    study = s4a.analyse(three, options=given, k=16, weights="equal")
    assert Options.from_report(study) == given.changed({"k": 16, "weights": "equal"})


def test_pairs_of_the_paper_are_matched_in_one_direction_after_icp(three):
    (name, template), (other, shape), _ = three.items()
    study = s4a.register_pairs(template, {other: shape}, name=name, preset="paper", **PAIR)
    assert "reverse" not in study.children
    one = study["registration"].to_dataset().sel(shape=other)
    assert one["initialisation"] == "intrinsic"
    assert np.array_equal(one["rotation"], one["icp_rotation"])
    fitted = s4a.match_pair(shape, template, refine="intrinsic", **PAIR)
    assert not np.allclose(fitted["rotation"], fitted["icp_rotation"])


def test_the_readings_of_pyfm_and_rematching_are_options_on_top_of_the_preset(three):
    readings = {"init": "wave_kernels", "isometric": True, "sampling": "geodesic"}
    readings |= {"weights": "linear_program", "n_latent": 21}
    study = s4a.analyse(three, **PAPER | readings, **OPTIONS)
    network = study["network"].to_dataset()
    C = network["fmap"].values
    assert C[0] == pytest.approx(C[1].T)
    assert study["latent"].sizes["latent"] == 21
    assert (study["latent"]["distance_to_limit"] < 1e-3).all()
    for name, coarse in study["coarse"].children.items():
        (X, _), (Y, C) = as_arrays(study["original"][name]), as_arrays(coarse)
        residual = X - s4a.projection_operator(coarse) @ Y
        closest = interpolate(Y, C, *closest_point(X, Y, C))
        assert np.linalg.norm(residual, axis=1) == pytest.approx(
            np.linalg.norm(X - closest, axis=1), abs=1e-6
        )
    with pytest.raises(ValueError, match="has samples of its own"):
        Options(method="scalable", sampling="geodesic")


def test_lifted_functions_are_orthonormal_on_the_original_mesh_and_are_what_is_compared(three):
    study = s4a.analyse(three, refined_eigenfunctions=True, refine="intrinsic", **OPTIONS)
    name = study["registration"].attrs["template"]
    B = study["coarse"][name]["refined_eigenfunction"].values
    area = study["registration"]["vertex_area"].values
    assert B.T @ (area[:, None] / area.sum() * B) == pytest.approx(np.eye(B.shape[1]), abs=0.05)
    Y = study["latent"]["latent_basis"]
    for other in set(three) - {name}:
        F = study["coarse"][other]["refined_eigenfunction"].values @ Y.sel(shape=other).values
        distance = cdist(B @ Y.sel(shape=name).values, F)
        match = study["registration"]["registered_match"].sel(shape=other).values
        assert np.allclose(distance[np.arange(len(B)), match], distance.min(1), rtol=1e-3)


def test_rounds_are_opened_and_go_when_they_are_not_asked_for(three, paper, tmp_path):
    with s4a.open_study(paper) as study:
        assert sorted(study["iterations"].children) == ["k_010", "k_015", "k_020", "k_024"]
        assert study["iterations/k_015/fmap"].shape == (6, 15, 15)
    again = shutil.copytree(paper, tmp_path / "again")
    with s4a.analyse(three, store=again, preset="paper", close_holes=True, **OPTIONS) as study:
        assert "iterations" not in study.children
    assert not list(again.glob("iterations/*"))


def test_a_new_shape_is_cleaned_and_registered_by_the_options_of_the_study(paper, meshes):
    mesh = meshes["brain_04"]
    X, T = mesh["position"].values, mesh["corner_vertex"].values
    with_hole = X, T[~(T == T[0, 0]).any(axis=1)]
    with s4a.open_study(paper) as study:
        new = s4a.insert(study, {"new": with_hole})
    assert new["original/new"].attrs["closed_holes"] == 1
    one = new["registration"].to_dataset().sel(shape="new")
    assert one["initialisation"] == "intrinsic"
    assert np.array_equal(one["rotation"], one["icp_rotation"])


@pytest.fixture
def calls(monkeypatch):
    """The options by which a transfer matches pairs, one after the other."""
    options = []
    match = pair.match_shapes

    def watched(source, target, given):
        options.append(given)
        return match(source, target, given)

    monkeypatch.setattr(pair, "match_shapes", watched)
    return options


def test_an_external_mesh_is_matched_by_the_options_of_the_study(paper, meshes, calls):
    external = meshes["brain_04"]
    with s4a.open_study(paper) as study:
        result = s4a.transfer_labels(
            study, external["label"].values, source=external, targets=["brain_01"]
        )
        assert calls == [Options.from_report(study)]  # one direction
    assert calls[0].preset == "paper"
    assert calls[0].n_coarse == OPTIONS["n_coarse"]
    assert result["brain_01"].sizes["vertex"] == 1500


def transfers(external):
    """Every function of a transfer, of a study and options."""
    label = external["label"].values
    landmarks = external[["landmark_name", "landmark_position"]]
    return {
        "labels": lambda study, **options: s4a.transfer_labels(study, label, **options),
        "scalars": lambda study, **options: s4a.transfer_scalars(study, label, **options),
        "landmarks": lambda study, **options: s4a.transfer_landmarks(study, landmarks, **options),
    }


def test_through_the_median_a_template_is_matched_once_for_all_shapes(paper, meshes, calls):
    external = meshes["brain_04"]
    with s4a.open_study(paper) as study:
        result = s4a.transfer_labels(study, external["label"].values, source=external)
    assert len(result.children) == 3
    assert len(calls) == 1


def test_votes_for_labels_spread_unless_the_study_or_its_pairs_are_of_the_paper(
    study, paper, three, meshes
):
    def shares(tree, mesh, **options):
        result = s4a.transfer_labels(tree, mesh["label"].values, targets=["brain_02"], **options)
        return result["brain_02"]["label_share"].values

    def spreads(tree, mesh, **options):
        default, *sharp_and_spread = (
            shares(tree, mesh, **options | blur) for blur in ({}, {"blur": 0}, {"blur": 1})
        )
        sharp, spread = (np.array_equal(default, other) for other in sharp_and_spread)
        assert sharp != spread
        return spread

    source, external = "brain_01", meshes["brain_04"]
    pairs = [
        s4a.register_pairs(
            three[source], {"brain_02": three["brain_02"]}, name=source, preset=preset, **PAIR
        )
        for preset in (None, "paper")
    ]
    assert [spreads(tree, three[source]) for tree in pairs] == [True, False]
    assert spreads(study, three[source], source=source)
    assert not spreads(study, external, source=external, preset="paper")
    with s4a.open_study(paper) as fixed:
        assert not spreads(fixed, three[source], source=source)
        assert spreads(fixed, external, source=external, preset=None)


@pytest.mark.parametrize("what", ["labels", "scalars", "landmarks"])
def test_a_transfer_refuses_by_name_what_its_preset_fixes(what, study, paper, meshes, calls):
    external = meshes["brain_04"]
    carry = transfers(external)[what]
    message = "preset 'paper' sets bidirectional=False; found bidirectional=True: leave out one"
    with pytest.raises(ValueError, match=message):
        carry(study, source=external, preset="paper", bidirectional=True)
    with s4a.open_study(paper) as fixed:
        with pytest.raises(ValueError, match=message):
            carry(fixed, source=external, bidirectional=True)
        assert calls == []
        carry(
            fixed,
            source=external,
            targets=["brain_01"],
            preset=None,
            bidirectional=False,
            full_resolution_iterations=0,
        )
    assert {name: getattr(calls[0], name) for name in DEFAULTS} == DEFAULTS | {
        "bidirectional": False,
        "full_resolution_iterations": 0,
    }


@pytest.mark.parametrize("what", ["labels", "scalars", "landmarks"])
def test_options_are_refused_where_nothing_is_matched(what, study, meshes):
    external = meshes["brain_04"]
    message = "options preset need an external source.*the shape 'brain_04'"
    with pytest.raises(ValueError, match=message):
        transfers(external)[what](study, source="brain_04", preset="paper")
    with pytest.raises(TypeError, match="unexpected option n_pairs of a pair; there are preset"):
        transfers(external)[what](study, source=external, n_pairs=3)


def test_another_low_resolution_than_that_of_the_study_is_made_for_its_template(
    study, meshes, monkeypatch
):
    made = []
    low = transfer.shape_of
    monkeypatch.setattr(transfer, "shape_of", lambda *given: made.append(given) or low(*given))
    external = meshes["brain_04"]
    carry = transfers(external)["scalars"]
    same = carry(
        study, source=external, targets=["brain_01"], refine="intrinsic", bidirectional=False
    )
    assert len(made) == 1
    coarser = carry(
        study,
        source=external,
        targets=["brain_01"],
        refine="intrinsic",
        bidirectional=False,
        n_coarse=150,
    )
    assert len(made) == 3
    assert made[1][1].n_coarse == made[2][1].n_coarse == 150
    assert not np.allclose(same["brain_01"]["field"], coarser["brain_01"]["field"])


def test_an_external_mesh_needs_more_than_a_study_of_pairs(three):
    (name, template), (other, shape), (_, external) = three.items()
    study = s4a.register_pairs(template, {other: shape}, name=name, bidirectional=False, **PAIR)
    with pytest.raises(ValueError, match="needs /coarse; this study of pairs has none"):
        s4a.transfer_labels(study, external["label"].values, source=external)


def test_the_commands_take_the_preset_between_files_and_to_a_study(
    paper, brain_files, tmp_path, monkeypatch, calls, capsys
):
    source, target, *_ = map(str, brain_files)
    labels = tmp_path / "labels.npy"
    np.save(labels, np.zeros(1500, int))
    to = ["transfer", source, "--labels", str(labels), "--out", str(tmp_path)]
    assert main([*to[:2], target, *to[2:], "--preset", "paper", *FLAGS]) == 0
    assert (calls[0].preset, calls[0].k) == ("paper", OPTIONS["k"])
    into = [*to[:2], str(paper), *to[2:], "--coordinate-system", "RAS", "--unit", "mm"]
    assert main([*into, "--k", "20", "--preset", "paper"]) == 0
    assert (calls[1].preset, calls[1].k) == ("paper", 20)
    assert main([*into, "--full-resolution-iterations", "1"]) == 2
    assert "preset 'paper' sets --full-resolution-iterations 0; found" in capsys.readouterr().err
    assert (
        main([*to[:2], target, *to[2:], "--preset", "paper", "--full-resolution-iterations", "1"])
        == 2
    )
    assert "preset 'paper' sets --full-resolution-iterations 0; found" in capsys.readouterr().err
    assert main(["compare", source, target, "--preset", "paper", "--methods", "registered"]) == 2
    assert "preset 'paper' has the methods kNN, ZO, FMAP+ZO" in capsys.readouterr().err
