"""Suspect shapes of a collection are reported, without false positives."""

import re
import sys

import numpy as np
import pytest
from faults import shapes as faulty

import s4a
from s4a.geometry.mesh import as_dataset
from s4a.input import plausibility
from s4a.input.clean import clean
from s4a.study.quality_control import flagged

SHAPES = {f"s{i}": faulty.shape(200 + i) for i in range(8)}


@pytest.fixture(scope="module")
def descriptors():
    return {name: descriptor(*mesh) for name, mesh in SHAPES.items()}


def descriptor(X, T):
    return plausibility.describe(clean(as_dataset(X, T)), intersections=False)


def flags_of(descriptors, references=None):
    """Name -> flags, and the remarks."""
    names = references or plausibility.pick_references(descriptors)
    chosen = {name: descriptors[name] for name in names}
    compared = {n: plausibility.compare(n, data, chosen) for n, data in descriptors.items()}
    attrs = {name: {"area": data.attrs["surface"]} for name, data in descriptors.items()}
    return plausibility.find_warnings(attrs, compared)


def kinds_of(descriptors):
    """Name -> kinds, flagged ones with an exclamation mark, and the remarks."""
    all_flags, remarks = flags_of(descriptors)
    kinds = {n: [flag.kind + "!" * flag.flagged for flag in all_flags[n]] for n in all_flags}
    return {name: words for name, words in kinds.items() if words}, remarks


def mirrored(X, T):
    return X * [-1, 1, 1], T[:, ::-1]


def test_a_clean_collection_has_no_flags_and_remarks(descriptors):
    assert kinds_of(descriptors) == ({}, [])


@pytest.mark.parametrize("kind", ["mirrored!", "unit!", "kind!", "partial!", "duplicate!"])
def test_each_fault_is_reported_for_its_shape_only(descriptors, kind):
    X, T = SHAPES["s3"]
    fault = {
        "mirrored!": lambda: mirrored(X, T),
        "unit!": lambda: (X / 2.54, T),
        "kind!": lambda: (faulty.SPHERE[0] * [120, 25, 25], faulty.SPHERE[1]),
        "partial!": lambda: (X, T[(X[T, 2] < np.quantile(X[:, 2], 0.7)).all(axis=1)]),
        "duplicate!": lambda: (SHAPES["s1"][0][:, [1, 2, 0]] + 50, SHAPES["s1"][1]),
    }[kind]
    assert kinds_of(descriptors | {"s3": descriptor(*fault())}) == ({"s3": [kind]}, [])


def test_a_copy_of_a_symmetric_shape_is_reported_as_a_possible_mirror_image(descriptors):
    X, T = faulty.SPHERE
    pairs = {"s3": SHAPES["s1"], "e1": (X * [30, 40, 60], T), "e2": mirrored(X * [30, 40, 60], T)}
    flags, _ = flags_of(descriptors | {name: descriptor(*mesh) for name, mesh in pairs.items()})
    words = {n: flag.words for n in flags for flag in flags[n] if flag.kind == "duplicate"}
    assert list(words) == ["s3", "e2"]
    assert words["s3"].startswith("the same surface as s1; ")
    assert words["e2"].startswith("the same surface as e1 (or its mirror image); ")


def test_a_rotated_shape_is_not_reported_as_it_is_aligned(descriptors):
    X, T = SHAPES["s3"]
    assert kinds_of(descriptors | {"s3": descriptor(X * [1, -1, -1], T)}) == ({}, [])


def test_if_half_is_mirrored_the_half_without_the_first_name_is_reported(descriptors):
    half = {name: descriptor(*mirrored(*SHAPES[name])) for name in ("s1", "s3", "s5", "s7")}
    kinds, (remark,) = kinds_of(descriptors | half)
    assert kinds == {name: ["mirrored!"] for name in half}
    assert remark.startswith("mirror images of each other, by ICP: s0, s2, s4, s6 and s1, s3")


def test_the_residuals_of_a_mirror_image_are_those_to_references_of_the_other_side(descriptors):
    half = {name: descriptor(*mirrored(*SHAPES[name])) for name in ("s1", "s3", "s5", "s7")}
    flags, _ = flags_of(descriptors | half, ["s0", "s2", "s1", "s3", "s5"])
    for name in ("s1", "s3", "s5"):
        as_is, reflected = map(float, re.findall(r"0\.\d{3}", flags[name][0].words))
        assert as_is > 1.7 * reflected


def test_if_half_has_another_unit_the_half_without_the_first_name_is_reported(descriptors):
    half = {name: descriptor(SHAPES[name][0] * 10, SHAPES[name][1]) for name in ("s1", "s3", "s5")}
    six = {name: data for name, data in descriptors.items() if name not in ("s6", "s7")}
    kinds, (remark,) = kinds_of(six | half)
    assert kinds == {name: ["unit!"] for name in half}
    assert "with the ratio 9.98: s1, s3, s5, and the others" in remark


def test_few_shapes_are_reported_only_if_no_deviation_is_needed(descriptors):
    X, T = SHAPES["s2"]
    three = {name: descriptors[name] for name in ("s0", "s1", "s2")}
    assert kinds_of(three | {"s2": descriptor(1000 * X, T)})[0] == {"s2": ["unit!"]}
    assert kinds_of(three | {"s2": descriptor(*SHAPES["s0"])})[0] == {"s2": ["duplicate!"]}
    assert kinds_of(three | {"s2": descriptor(X, T[(X[T, 2] < 0).all(axis=1)])})[0] == {}


def test_self_intersections_are_reported_only_if_the_others_have_far_fewer(descriptors):
    def with_shares(*shares):
        crossing = {
            n: data.assign_attrs(intersecting=s, self_intersections=int(1000 * s))
            for (n, data), s in zip(descriptors.items(), shares, strict=False)
        }
        return kinds_of(crossing)[0]

    assert with_shares(0.02, 0.01, 0.011, 0.004) == {}
    assert with_shares(0.02, 0.0, 0.001, 0.0) == {"s0": ["intersections"]}


def test_a_registration_is_flagged_by_error_times_distortion_if_neither_alone_suffices():
    names = ["template", "good", "far", "odd", "stretched", "fine"]
    error = dict(zip(names, [0.0, 0.03, 0.038, 0.025, 0.01, 0.02], strict=True))
    distortion = dict(zip(names, [0.0, 0.1, 0.21, 0.19, 0.3, 0.1], strict=True))
    flags, _ = flagged(error, distortion)
    assert {n: [flag.flagged for flag in flags[n]] for n in flags} == {
        "far": [True],
        "odd": [False],
    }


def test_without_pymeshlab_all_defaults_run_and_wrapping_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    brains = s4a.synthetic.brains(3, 200)
    shapes = {name: node.to_dataset() for name, node in brains["original"].children.items()}
    small = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 3}
    study = s4a.analyse(shapes, **small)
    assert study["report"]["self_intersections"].values.tolist() == [0, 0, 0]
    for wrap in (
        lambda: s4a.coarsen(shapes["brain_01"], wrap=True),
        lambda: s4a.analyse({}, wrap=True),
    ):
        with pytest.raises(ValueError, match=r"pip install 's4a\[wrap\]'"):
            wrap()
