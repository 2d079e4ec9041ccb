"""What looks wrong with a shape beside its collection is told, and nothing else."""

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


def doubts_of(descriptors, references=None):
    """Name -> flags, and the remarks."""
    chosen = {
        name: descriptors[name] for name in references or plausibility.pick_references(descriptors)
    }
    seen = {name: plausibility.compare(name, one, chosen) for name, one in descriptors.items()}
    attrs = {name: {"area": one.attrs["surface"]} for name, one in descriptors.items()}
    return plausibility.find_warnings(attrs, seen)


def told(descriptors):
    """Name -> kinds, flagged ones with an exclamation mark, and the remarks."""
    found, remarks = doubts_of(descriptors)
    kinds = {n: [one.kind + "!" * one.flagged for one in flags] for n, flags in found.items()}
    return {name: words for name, words in kinds.items() if words}, remarks


def mirrored(X, T):
    return X * [-1, 1, 1], T[:, ::-1]


def test_nothing_is_told_of_a_clean_collection(descriptors):
    assert told(descriptors) == ({}, [])


@pytest.mark.parametrize("kind", ["mirrored!", "unit!", "kind!", "partial!", "duplicate!"])
def test_each_oddity_is_told_of_the_shape_that_has_it_and_of_no_other(descriptors, kind):
    X, T = SHAPES["s3"]
    odd = {
        "mirrored!": lambda: mirrored(X, T),
        "unit!": lambda: (X / 2.54, T),
        "kind!": lambda: (faulty.SPHERE[0] * [120, 25, 25], faulty.SPHERE[1]),
        "partial!": lambda: (X, T[(X[T, 2] < np.quantile(X[:, 2], 0.7)).all(axis=1)]),
        "duplicate!": lambda: (SHAPES["s1"][0][:, [1, 2, 0]] + 50, SHAPES["s1"][1]),
    }[kind]
    assert told(descriptors | {"s3": descriptor(*odd())}) == ({"s3": [kind]}, [])


def test_of_a_symmetric_shape_a_copy_may_be_the_mirror_image_and_that_is_said(descriptors):
    X, T = faulty.SPHERE
    pairs = {"s3": SHAPES["s1"], "e1": (X * [30, 40, 60], T), "e2": mirrored(X * [30, 40, 60], T)}
    found, _ = doubts_of(descriptors | {name: descriptor(*mesh) for name, mesh in pairs.items()})
    words = {n: one.words for n in found for one in found[n] if one.kind == "duplicate"}
    assert list(words) == ["s3", "e2"]
    assert words["s3"].startswith("the same surface as s1, under two names; ")
    assert words["e2"].startswith("the same surface as e1, under two names (or its mirror image)")


def test_a_turned_shape_is_not_told_as_the_alignment_turns_it(descriptors):
    X, T = SHAPES["s3"]
    assert told(descriptors | {"s3": descriptor(X * [1, -1, -1], T)}) == ({}, [])


def test_of_half_a_collection_of_the_other_hand_the_half_without_the_first_name_is_told(
    descriptors,
):
    odd = {name: descriptor(*mirrored(*SHAPES[name])) for name in ("s1", "s3", "s5", "s7")}
    found, (remark,) = told(descriptors | odd)
    assert found == {name: ["mirrored!"] for name in odd}
    assert remark.startswith("mirror images of each other, by ICP: s0, s2, s4, s6 and s1, s3")


def test_the_residuals_of_a_mirror_image_are_those_beside_the_other_hand(descriptors):
    odd = {name: descriptor(*mirrored(*SHAPES[name])) for name in ("s1", "s3", "s5", "s7")}
    found, _ = doubts_of(descriptors | odd, ["s0", "s2", "s1", "s3", "s5"])
    for name in ("s1", "s3", "s5"):
        as_is, reflected = map(float, re.findall(r"0\.\d{3}", found[name][0].words))
        assert as_is > 2 * reflected


def test_of_half_a_collection_in_another_unit_the_half_without_the_first_name_is_told(descriptors):
    odd = {name: descriptor(SHAPES[name][0] * 10, SHAPES[name][1]) for name in ("s1", "s3", "s5")}
    four = {name: one for name, one in descriptors.items() if name not in ("s6", "s7")}
    found, (remark,) = told(four | odd)
    assert found == {name: ["unit!"] for name in odd}
    assert "times apart: s1, s3, s5, and the others" in remark


def test_of_few_shapes_only_what_needs_no_spread_is_told(descriptors):
    X, T = SHAPES["s2"]
    three = {name: descriptors[name] for name in ("s0", "s1", "s2")}
    assert told(three | {"s2": descriptor(1000 * X, T)})[0] == {"s2": ["unit!"]}
    assert told(three | {"s2": descriptor(*SHAPES["s0"])})[0] == {"s2": ["duplicate!"]}
    assert told(three | {"s2": descriptor(X, T[(X[T, 2] < 0).all(axis=1)])})[0] == {}


def test_crossing_triangles_are_told_only_where_the_others_have_far_fewer(descriptors):
    def with_shares(*shares):
        seen = {
            n: one.assign_attrs(intersecting=s, self_intersections=int(1000 * s))
            for (n, one), s in zip(descriptors.items(), shares, strict=False)
        }
        return told(seen)[0]

    assert with_shares(0.02, 0.01, 0.011, 0.004) == {}
    assert with_shares(0.02, 0.0, 0.001, 0.0) == {"s0": ["intersections"]}


def test_a_registration_that_misses_and_distorts_is_told_where_neither_number_alone_is_odd():
    registration_error = {
        "template": 0.0,
        "good": 0.03,
        "far": 0.038,
        "odd": 0.025,
        "stretched": 0.01,
        "fine": 0.02,
    }
    distortion = {
        "template": 0.0,
        "good": 0.1,
        "far": 0.21,
        "odd": 0.19,
        "stretched": 0.3,
        "fine": 0.1,
    }
    found, _ = flagged(registration_error, distortion)
    assert {n: [one.flagged for one in flags] for n, flags in found.items()} == {
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
