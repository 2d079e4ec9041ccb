"""Left and right: shapes are mirrored by name, by a table, or automatically."""

import numpy as np
import pytest
from faults import shapes as faulty
from paths import DATA

import s4a
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_normals, volume
from s4a.input import plausibility
from s4a.input.chirality import (
    in_file,
    mean_chirality,
    mirror_image,
    mirrored_shapes,
    signs,
    to_reflect,
)
from s4a.input.clean import clean
from s4a.input.subjects import subjects

NAMES = ["a", "b", "c"]


@pytest.fixture(scope="module")
def chiral():
    """Six clearly chiral shapes, the second and the fifth mirrored."""
    shapes = {f"s{i}": clean(as_dataset(*faulty.shape(200 + i))) for i in range(6)}
    return shapes | {name: mirror_image(shapes[name]) for name in ("s1", "s4")}


def test_a_mirror_image_has_outward_normals_and_mirroring_it_again_returns_the_shape():
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
    true_sign = np.where(np.arange(12) % 3 == 1, -1, 1)
    similarity = np.outer(true_sign, true_sign) * rng.uniform(0.5, 2, (12, 12))
    similarity[rng.random((12, 12)) < 0.4] = np.nan  # not compared
    similarity[2, 5] = -4  # one pair is wrong
    assert signs(similarity).tolist() == (true_sign * true_sign[0]).tolist()
    order = rng.permutation(12)
    permuted = signs(similarity[np.ix_(order, order)])
    assert permuted.tolist() == (true_sign * true_sign[order[0]])[order].tolist()


@pytest.fixture(scope="module")
def comparisons(chiral):
    return plausibility.examine(chiral, intersections=False)


def test_shapes_of_the_less_common_side_are_detected_with_clear_evidence(comparisons):
    assert mirrored_shapes(comparisons) == (["s1", "s4"], [])
    mean = dict(zip(comparisons, mean_chirality(comparisons), strict=True))
    assert all(abs(value) > 0.8 for value in mean.values())
    assert {name for name, value in mean.items() if value < 0} == {"s1", "s4"}


def test_on_a_tie_the_side_of_the_first_name_stays(chiral):
    four = {name: chiral[name] for name in ("s0", "s1", "s2", "s4")}
    assert mirrored_shapes(plausibility.examine(four, intersections=False)) == (["s1", "s4"], [])


def test_mirror_symmetric_shapes_are_left_as_they_are_with_a_remark():
    X, T = as_arrays(s4a.synthetic.sphere(400))
    alike = {f"e{i}": as_dataset(X * [10, 20 + i, 30], T) for i in range(4)}
    names, (remark,) = mirrored_shapes(plausibility.examine(alike, intersections=False))
    assert names == []
    assert "mirrored no shape: the shapes are too symmetric" in remark


def test_a_shape_that_fits_as_well_as_it_is_is_not_mirrored(comparisons):
    alike = comparisons["s4"].assign(fit_mirrored=comparisons["s4"]["fit"])
    comparisons = comparisons | {"s4": alike}
    flags, _ = plausibility.find_warnings({name: {} for name in comparisons}, comparisons)
    assert [n for n in flags if "mirrored" in {flag.kind for flag in flags[n]}] == ["s1"]
    names, (remark,) = mirrored_shapes(comparisons)
    assert names == ["s1"]
    assert "cannot determine the side of s4" in remark


def test_a_shape_with_weak_evidence_is_named_and_left_as_it_is(comparisons):
    weak = comparisons["s4"].assign(chirality=0.1 * comparisons["s4"]["chirality"])
    names, (remark,) = mirrored_shapes(comparisons | {"s4": weak})
    assert names == ["s1"]
    assert "cannot determine the side of s4, left as it is: look at it" in remark
    assert mirrored_shapes({"s0": comparisons["s0"]})[0] == []


@pytest.mark.parametrize(
    "reflect, chosen", [("c,a", ["a", "c"]), ("side=l", ["a", "b"]), ("left", ["b"]), ("no", ["a"])]
)
def test_names_and_columns_choose(reflect, chosen):
    columns = {"side": ["l", "l", "r"], "left": [0, 1, 0], "no": ["Yes", "no", "no"]}
    assert to_reflect(reflect, NAMES, subjects(columns, NAMES)) == chosen


@pytest.mark.parametrize(
    "reflect, words",
    [
        ("a,d", r"'d' is not a shape \(a, b, c\) or a column of the table"),
        ("none", "selects none of the 3 shapes"),
        ("side=x", "no shape has 'x' in the column 'side', which has l, r"),
        ("arm=l", r"needs a table with the column 'arm'; found side, gap, none"),
        ("gap=l", "the column 'gap' has no value for b"),
        ("side", "needs a column of 1 and 0, or a value, side=l"),
    ],
)
def test_an_invalid_choice_to_mirror_is_an_error_that_says_why(reflect, words):
    columns = {"side": ["l", "l", "r"], "gap": ["l", "", "r"], "none": [0, 0, 0]}
    with pytest.raises(ValueError, match=words):
        to_reflect(reflect, NAMES, subjects(columns, NAMES))


def test_left_and_right_are_distinguished_in_all_pairs_of_six_femurs():
    files = sorted((DATA / "lower_limb_bones").glob("*femur*.npz"))
    if len(files) < 6:
        pytest.skip("no femurs next to the repository")
    meshes = {}
    for file in files:
        with np.load(file) as arrays:
            meshes[file.stem] = clean(as_dataset(arrays["V"], arrays["F"]))
    descriptors = {
        n: plausibility.describe(mesh, intersections=False) for n, mesh in meshes.items()
    }
    is_left = {name: name.endswith("_l") for name in descriptors}
    comparisons = {n: plausibility.compare(n, data, descriptors) for n, data in descriptors.items()}
    for name, comparison in comparisons.items():
        for other in set(descriptors) - {name}:
            chirality = comparison["chirality"].sel(reference=other).item()
            assert (chirality > 0) == (is_left[name] == is_left[other])
            assert abs(chirality) > 1
    names, remarks = mirrored_shapes(comparisons)
    assert names == [name for name in descriptors if is_left[name]]
    assert remarks == []
