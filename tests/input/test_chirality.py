"""Left and right: who is mirrored by names, by a table, and by the shapes themselves."""

import numpy as np
import pytest
from faults import shapes as faulty
from paths import DATA

import s4a
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_normals, volume
from s4a.input import plausibility
from s4a.input.chirality import hands, in_file, mirror_image, mirrored_shapes, signs, to_reflect
from s4a.input.clean import clean
from s4a.input.subjects import subjects

NAMES = ["a", "b", "c"]


@pytest.fixture(scope="module")
def handed():
    """Six shapes that clearly have a hand, the second and the fifth of the other."""
    shapes = {f"s{i}": clean(as_dataset(*faulty.shape(200 + i))) for i in range(6)}
    return shapes | {name: mirror_image(shapes[name]) for name in ("s1", "s4")}


def test_a_mirror_image_is_that_with_its_normals_outward_and_its_mirror_the_shape_again():
    mesh = s4a.synthetic.ellipsoid(300).assign_attrs(reason="")
    mesh["landmark_position"] = ("landmark", "xyz"), [[1.0, 2, 3]]
    image = mirror_image(mesh)
    (X, T), (Y, S) = as_arrays(mesh), as_arrays(image)
    assert np.array_equal(Y, X * [-1, 1, 1])
    assert volume(Y, S) == pytest.approx(volume(X, T))
    np.testing.assert_allclose(vertex_normals(Y, S), vertex_normals(X, T) * [-1, 1, 1], atol=1e-12)
    assert image["landmark_position"].values.tolist() == [[-1, 2, 3]]
    assert np.array_equal(in_file(image, Y), X)
    assert in_file(mesh, X) is X
    again = mirror_image(image)
    assert again["position"].equals(mesh["position"])
    assert again.attrs["reflected"] == 0


def test_signs_are_those_that_agree_with_most_pairs_whatever_their_order():
    rng = np.random.default_rng(0)
    truth = np.where(np.arange(12) % 3 == 1, -1, 1)
    likeness = np.outer(truth, truth) * rng.uniform(0.5, 2, (12, 12))
    likeness[rng.random((12, 12)) < 0.4] = np.nan  # not held against each other
    likeness[2, 5] = -4  # one pair is wrong
    assert signs(likeness).tolist() == (truth * truth[0]).tolist()
    order = rng.permutation(12)
    turned = signs(likeness[np.ix_(order, order)])
    assert turned.tolist() == (truth * truth[order[0]])[order].tolist()


def test_the_shapes_of_the_rarer_hand_are_found_and_their_evidence_is_clear(handed):
    seen = plausibility.examine(handed, intersections=False)
    assert mirrored_shapes(seen) == (["s1", "s4"], [])
    mean = dict(zip(seen, hands(seen), strict=True))
    assert all(abs(one) > 0.8 for one in mean.values())
    assert {name for name, one in mean.items() if one < 0} == {"s1", "s4"}


def test_of_as_many_left_as_right_those_stay_that_are_of_the_first_name(handed):
    four = {name: handed[name] for name in ("s0", "s1", "s2", "s4")}
    assert mirrored_shapes(plausibility.examine(four, intersections=False)) == (["s1", "s4"], [])


def test_shapes_that_are_their_own_mirror_image_are_left_and_that_is_said():
    X, T = as_arrays(s4a.synthetic.sphere(400))
    alike = {f"e{i}": as_dataset(X * [10, 20 + i, 30], T) for i in range(4)}
    names, (remark,) = mirrored_shapes(plausibility.examine(alike, intersections=False))
    assert names == []
    assert "mirrored none: the shapes are too like their own mirror images" in remark


def test_a_shape_of_weak_evidence_is_named_and_stays(handed):
    seen = plausibility.examine(handed, intersections=False)
    weak = seen["s4"].assign(chirality=0.1 * seen["s4"]["chirality"])
    names, (remark,) = mirrored_shapes(seen | {"s4": weak})
    assert names == ["s1"]
    assert "cannot tell the hand of s4, which stayed as it is: look at it" in remark
    assert mirrored_shapes({"s0": seen["s0"]})[0] == []


@pytest.mark.parametrize(
    "reflect, chosen", [("c,a", ["a", "c"]), ("side=l", ["a", "b"]), ("left", ["b"]), ("no", ["a"])]
)
def test_names_and_columns_choose(reflect, chosen):
    columns = {"side": ["l", "l", "r"], "left": [0, 1, 0], "no": ["Yes", "no", "no"]}
    assert to_reflect(reflect, NAMES, subjects(columns, NAMES)) == chosen


@pytest.mark.parametrize(
    "reflect, words",
    [
        ("a,d", r"reflect names 'd', none of the shapes \(a, b, c\), and no column of the table"),
        ("none", "mirrors none of the 3 shapes"),
        ("side=x", "no shape has 'x' in the column 'side', which has l, r"),
        ("hand=l", r"needs a table with the column 'hand'; it has side, gap, none"),
        ("gap=l", "the column 'gap' has no value for b"),
        ("side", "needs a column of 1 and 0, or a value as side=l"),
    ],
)
def test_what_cannot_be_mirrored_is_an_error_that_says_why(reflect, words):
    columns = {"side": ["l", "l", "r"], "gap": ["l", "", "r"], "none": [0, 0, 0]}
    with pytest.raises(ValueError, match=words):
        to_reflect(reflect, NAMES, subjects(columns, NAMES))


def test_all_fifteen_pairs_of_six_femurs_are_told_apart():
    files = sorted((DATA / "lower_limb_bones").glob("*femur*.npz"))
    if len(files) < 6:
        pytest.skip("no femurs beside the repository")
    meshes = {}
    for file in files:
        with np.load(file) as arrays:
            meshes[file.stem] = clean(as_dataset(arrays["V"], arrays["F"]))
    seen = {name: plausibility.describe(mesh, intersections=False) for name, mesh in meshes.items()}
    is_left = {name: name.endswith("_l") for name in seen}
    for name, one in seen.items():
        beside = plausibility.compare(name, one, {n: seen[n] for n in seen if n != name})
        for other in beside["reference"].values.tolist():
            hand = beside["chirality"].sel(reference=other).item()
            assert (hand > 0) == (is_left[name] == is_left[other])
            assert abs(hand) > 1
    names, remarks = mirrored_shapes(plausibility.examine(meshes, intersections=False))
    assert names == [name for name in seen if is_left[name]]
    assert remarks == []
