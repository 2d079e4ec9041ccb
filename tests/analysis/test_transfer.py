"""Transfer (6.2): labels, landmarks and fields with known correspondences, files, command.

Real templates.
"""

import gzip
import json

import nibabel
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from s4a import (
    clean,
    cli,
    correspondence,
    match_pair,
    register_pairs,
    synthetic,
    transfer_labels,
    transfer_landmarks,
    transfer_scalars,
    write_mesh,
)
from s4a.analysis.transfer import diffuse_votes, majority, votes_of
from s4a.geometry.closest import (
    closest_facing_point,
    closest_point,
    interpolate,
    interpolation_matrix,
)
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.input.annotations import (
    labels_of_file,
    labels_of_mesh,
    read_labels,
    read_landmarks,
    read_scalars,
    write_landmarks,
)
from s4a.input.landmarks import locate
from s4a.schema import dataset
from s4a.study import quality_control
from s4a.study.pair import pair_study

OPTIONS = {"n_coarse": 1200, "k": 60}


@pytest.fixture(scope="module")
def tree():
    return synthetic.brains(3, 5000, seed=2)


@pytest.fixture(scope="module")
def meshes(tree):
    return {name: node.to_dataset() for name, node in tree["original"].children.items()}


@pytest.fixture(scope="module")
def size(meshes):
    return np.sqrt(vertex_areas(*as_arrays(meshes["brain_01"])).sum())


@pytest.fixture(scope="module")
def study(meshes):
    """The first brain registered to the two others, in both directions."""
    others = {name: mesh for name, mesh in meshes.items() if name != "brain_01"}
    return register_pairs(meshes["brain_01"], others, name="brain_01", **OPTIONS)


@pytest.fixture(scope="module")
def moved(meshes):
    """The first brain with its vertices in another order, rotated and shifted; and the order."""
    X, T = as_arrays(meshes["brain_01"])
    order = np.random.default_rng(0).permutation(len(X))
    R = Rotation.from_euler("zyx", [20, 10, -15], degrees=True).as_matrix()
    return clean(as_dataset((X @ R.T + [30, -20, 5])[order], np.argsort(order)[T])), order, R


def distance(a, b):
    return np.linalg.norm(a - b, axis=-1)


def test_labels_and_landmarks_of_a_moved_and_renumbered_copy_are_exact(meshes, moved, size):
    mesh = meshes["brain_01"]
    copy, order, R = moved
    study = pair_study(match_pair(copy, mesh, **OPTIONS), copy, mesh)
    label = np.arange(mesh.sizes["vertex"])  # every vertex its own
    found = transfer_labels(study, label, blur=0)["source"]
    assert (found["label"].values == order).all()
    assert found["label_share"].values == pytest.approx(1, abs=1e-4)
    assert found["confidence"].values == pytest.approx(1, abs=1e-3)
    Y, S = as_arrays(copy)
    for ends, true, X, T in (
        (("target", "source"), np.argsort(order), Y, S),
        (("source", "target"), order, *as_arrays(mesh)),
    ):
        image = correspondence(study, *ends)
        assert distance(image["image_position"].values, X[true]).max() < 1e-4 * size
        corner = image["image_barycentric"].values.argmax(1)
        assert (T[image["image_triangle"].values, corner] == true).all()
    lacking = study.filter(lambda node: node.path != "/original/target")
    with pytest.raises(ValueError, match="meshes of the shapes are needed; /original lacks target"):
        correspondence(lacking, "source", "target")
    landmarks = mesh[["landmark_name", "landmark_position"]]
    marks = transfer_landmarks(study, landmarks)["source"]
    exact = locate(landmarks, mesh)["landmark_position"].values @ R.T + [30, -20, 5]
    assert distance(marks["landmark_position"].values, exact).max() < 1e-4 * size
    assert marks["landmark_name"].values.tolist() == list(synthetic.LANDMARKS)
    back = transfer_landmarks(study, marks, source="source")["target"]["landmark_position"]
    known = locate(landmarks, mesh)["landmark_position"]
    assert distance(back.values, known).max() < 1e-4 * size


def test_labels_of_deformed_brains_are_nearly_right_and_better_than_by_the_nearest_vertex(
    study, meshes
):
    found = transfer_labels(study, meshes["brain_01"]["label"].values)
    assert set(found.children) == {"brain_02", "brain_03"}
    for name, node in found.children.items():
        true = meshes[name]["label"].values
        right = node["label"].values == true
        near = cKDTree(meshes["brain_01"]["position"]).query(meshes[name]["position"])[1]
        assert right.mean() > 0.95
        assert right.mean() > (meshes["brain_01"]["label"].values[near] == true).mean() + 0.1
        assert (
            node["label_share"].values[right].mean()
            > node["label_share"].values[~right].mean() + 0.1
        )
        assert 0 < node["confidence"].values.min() <= node["confidence"].values.max() <= 1


def test_landmarks_are_inside_triangles_of_the_shape_and_accurate(study, meshes, size):
    landmarks = meshes["brain_01"][["landmark_name", "landmark_position"]]
    for name, node in transfer_landmarks(study, landmarks).children.items():
        X, T = as_arrays(meshes[name])
        point = node["landmark_position"].values
        on = interpolate(
            X, T, node["landmark_triangle"].values, node["landmark_barycentric"].values
        )
        assert distance(point, on).max() < 1e-9 * size
        error = distance(point, meshes[name]["landmark_position"].values)
        nearest_vertex = distance(X[cKDTree(X).query(meshes[name]["landmark_position"])[1]], point)
        assert error.mean() < 0.01 * size
        assert nearest_vertex.min() > 0
        assert (node["landmark_disagreement"].values < 0.03 * size).all()


def test_a_shape_gives_its_labels_through_the_template_to_the_others(study, meshes):
    label = meshes["brain_02"]["label"].values
    found = transfer_labels(study, label, source="brain_02", votes=True)
    assert set(found.children) == {"brain_01", "brain_03"}
    for name, node in found.children.items():
        assert (node["label"].values == meshes[name]["label"].values).mean() > 0.93
        assert node["label_vote"].sum("label_value").values == pytest.approx(1, abs=1e-4)
        assert node["label_value"].values.tolist() == np.unique(label).tolist()


def test_several_sources_are_averaged_and_have_equal_votes(study, meshes):
    names = "brain_02", "brain_03"
    labels = {n: meshes[n]["label"].values for n in names}
    marks = {n: meshes[n][["landmark_name", "landmark_position"]] for n in names}
    one, two = ({"label": [], "mark": []} for _ in range(2))
    for given, found in (({names[0]}, one), (set(names), two)):
        few = {n: labels[n] for n in names if n in given}
        label = transfer_labels(study, few, targets=["brain_01"])["brain_01"]
        found["label"] = (label["label"].values == meshes["brain_01"]["label"].values).mean()
        few = {n: marks[n].isel(landmark=slice(None, None, -1)) for n in names[:1]}
        few |= {n: marks[n] for n in names[1:] if n in given}
        found["mark"] = transfer_landmarks(study, few, targets=["brain_01"])["brain_01"]
    true = meshes["brain_01"]["landmark_position"].values[::-1]
    errors = [distance(f["mark"]["landmark_position"].values, true).mean() for f in (one, two)]
    assert errors[1] < errors[0]
    assert two["label"] > one["label"]
    assert (two["mark"]["landmark_disagreement"] > 0).all()
    rest = transfer_labels(study, {n: labels[n] for n in names})
    assert list(rest.children) == ["brain_01"]
    with pytest.raises(ValueError, match="replaces source="):
        transfer_labels(study, labels, source="brain_01")
    with pytest.raises(ValueError, match="the same landmarks"):
        transfer_landmarks(study, marks | {names[1]: marks[names[1]].isel(landmark=slice(3))})


def test_named_labels_travel_too(study, meshes):
    names = np.array(synthetic.LABELS)[meshes["brain_01"]["label"].values]
    found = transfer_labels(study, names, targets=["brain_02"])["brain_02"]["label"].values
    numbers = transfer_labels(study, meshes["brain_01"]["label"].values, targets=["brain_02"])[
        "brain_02"
    ]["label"]
    assert (found == np.array(synthetic.LABELS)[numbers.values]).mean() > 0.999


def test_fields_are_interpolated_and_unknown_values_stay_unknown(study, meshes, tree, size):
    field = meshes["brain_01"]["position"].values[:, 1].copy()
    found = transfer_scalars(study, field)["brain_02"]["field"].values
    u = tree["truth/brain_02/reference_point"].values
    exact = synthetic.position(tree["truth"], "brain_01", u)[:, 1]
    assert np.abs(found - exact).mean() < 0.01 * size
    field[:2500] = np.nan
    some = transfer_scalars(study, field)["brain_02"]["field"].values
    assert 0.2 < np.isnan(some).mean() < 0.8
    known = np.isfinite(some)
    assert np.abs(some - found)[known].mean() < 0.005 * size


def test_bidirectional_matching_is_symmetric_and_can_be_disabled(study, meshes):
    one = register_pairs(
        meshes["brain_01"], {"a": meshes["brain_02"]}, bidirectional=False, **OPTIONS
    )
    assert "reverse" not in one.children
    label = meshes["brain_01"]["label"].values
    a = transfer_labels(one, label)["a"]["label"].values
    b = transfer_labels(study, label)["brain_02"]["label"].values
    assert (a == b).mean() > 0.95


def test_the_label_with_most_votes_wins_and_ties_go_to_the_first():
    W = sp.csr_matrix([[0.5, 0.2, 0.3], [0.3, 0.3, 0.4], [0.5, 0.5, 0.0]])
    vote, value = votes_of(W, np.array(["b", "a", "a"]))
    assert majority(vote, value).tolist() == ["a", "a", "a"]
    assert value.tolist() == ["a", "b"]
    assert vote[1] == pytest.approx([0.7, 0.3])


def test_votes_diffuse_as_far_as_the_blur_and_keep_their_sum():
    X, T = as_arrays(synthetic.sphere(4000))
    area = vertex_areas(X, T)
    one = np.zeros((len(X), 2), np.float32)
    one[7, 0], one[:, 1] = 1, 1
    one[7, 1] = 0
    vote = diffuse_votes(one, X, T, np.full(len(X), 0.03))
    assert vote.sum(axis=1) == pytest.approx(1, abs=1e-4)
    mass = area * vote[:, 0]
    assert mass.sum() == pytest.approx(area[7], rel=1e-3)
    squared = ((X - X[7]) ** 2).sum(axis=1)
    assert np.sqrt(mass @ squared / mass.sum()) == pytest.approx(
        0.03 * np.sqrt(area.sum()), rel=0.05
    )


def test_sure_votes_stay_where_they_fall():
    X, T = as_arrays(synthetic.sphere(4000))
    sides = np.stack([X[:, 0] > 0, X[:, 0] <= 0], axis=1).astype(np.float32)
    radius = np.where(X[:, 1] > 0, 0.03, 1e-6)
    vote = diffuse_votes(sides, X, T, radius)
    unsure = (X[:, 1] > 0.2) & (abs(X[:, 0]) < 0.05)
    sure = (X[:, 1] < -0.2) & (abs(X[:, 0]) < 0.05)
    assert vote[unsure].max(axis=1).mean() < 0.8
    assert vote[sure] == pytest.approx(sides[sure], abs=1e-4)


def test_diffused_votes_are_more_accurate_and_no_label_is_lost(study, meshes):
    label = meshes["brain_01"]["label"].values.copy()
    sharp, blurred = (transfer_labels(study, label, blur=blur) for blur in (0, 1))
    for name in sharp.children:
        true = meshes[name]["label"].values
        right = [(found[name]["label"].values == true).mean() for found in (sharp, blurred)]
        assert right[1] > right[0]
    T = as_arrays(meshes["brain_01"])[1]
    label[T[(T == 100).any(axis=1)]] = 77  # a vertex and those around, which others would outvote
    sharp, blurred = (
        transfer_labels(study, label, blur=blur)["brain_02/label"].values for blur in (0, 10)
    )
    assert 0 < (sharp == 77).sum() == (blurred == 77).sum()
    with pytest.raises(ValueError, match="from 0 to 10; found 20"):
        transfer_labels(study, label, blur=20)


def test_interpolation_is_exact_for_linear_functions_and_walls_are_not_crossed():
    X, T = as_arrays(synthetic.sphere(500))
    P = np.random.default_rng(1).normal(size=(50, 3))
    P /= np.linalg.norm(P, axis=1, keepdims=True)
    found = closest_point(P, X, T)
    assert interpolation_matrix(T, *found, len(X)) @ X == pytest.approx(interpolate(X, T, *found))
    assert distance(interpolate(X, T, *found), P).max() < 0.02
    shell = np.concatenate([X, 0.99 * X])  # a wall, its inner side turned inwards
    both = np.concatenate([T, T[:, ::-1] + len(X)])
    for normal, side in ((1, T.max() + 1), (-1, 2 * len(X))):
        triangle, _ = closest_facing_point(0.994 * P, normal * P, shell, both)
        assert (both[triangle].max(1) < side).all()
        assert (both[triangle].min(1) >= side - len(X)).all()


def test_wrong_sources_targets_and_lengths_are_refused(study, meshes):
    label = meshes["brain_01"]["label"].values
    with pytest.raises(ValueError, match=r"5000 vertices, shape .5000,.; found shape \(7,\)"):
        transfer_labels(study, label[:7])
    with pytest.raises(ValueError, match=r"must be one of 'brain_01', .*; found 'brain_9'"):
        transfer_labels(study, label, targets=["brain_9"])
    with pytest.raises(ValueError, match="a registered study is needed"):
        transfer_labels(study.drop_nodes("registration"), label)
    with pytest.raises(ValueError, match="are needed; found none"):
        register_pairs(meshes["brain_01"], {}, name="x")
    far = dataset(landmark_name=np.array(["nose"]), landmark_position=np.array([[0.0, 0, 900]]))
    with pytest.raises(ValueError, match=r"'nose' is .* away"):
        transfer_landmarks(study, far)


def test_curves_are_transferred_as_polylines_between_the_vertices(study, meshes, tree, size):
    angle = np.linspace(0, 2 * np.pi, 41)[:-1]
    ring = np.stack([np.cos(angle), 0.3 + 0 * angle, np.sin(angle)], axis=1) / np.sqrt(1.09)
    given = dataset(
        landmark_name=np.array([*(f"p{i}" for i in range(40)), "alone"]),
        landmark_position=synthetic.position(tree["truth"], "brain_01", np.r_[ring, [[0, 1, 0]]]),
        landmark_curve=np.array(["ring"] * 40 + [""]),
        landmark_closed=np.array([True] * 40 + [False]),
    )
    found = transfer_landmarks(study, given, targets=["brain_02"])["brain_02"]
    of_ring = found["landmark_curve"].values == "ring"
    names = found["landmark_name"].values
    assert names[~of_ring].tolist() == ["alone"]
    assert [n for n in names[of_ring] if n] == [
        f"p{i}" for i in range(40)
    ]  # in order, others in between
    assert of_ring.sum() > 60
    line = found["landmark_position"].values[of_ring]
    X, T = as_arrays(meshes["brain_02"])
    assert distance(interpolate(X, T, *closest_point(line, X, T)), line).max() < 1e-6 * size
    dense = np.linspace(0, 2 * np.pi, 2000)
    exact = np.stack([np.cos(dense), 0.3 + 0 * dense, np.sin(dense)], axis=1) / np.sqrt(1.09)
    exact = synthetic.position(tree["truth"], "brain_02", exact)
    assert cKDTree(exact).query(line)[0].mean() < 0.01 * size
    assert (
        cKDTree(line).query(exact)[0].mean() < 0.015 * size
    )  # closed: no part of the true ring is left out


# files


def test_every_label_file_gives_the_same_labels(tmp_path):
    label = np.array([3, 0, 5, 3, 3])
    np.save(tmp_path / "a.npy", label)
    np.save(tmp_path / "float.npy", label.astype(float))
    np.savez(tmp_path / "one.npz", labels=label, other=np.zeros(9))
    np.savez(tmp_path / "two.npz", labels=label, other=label + 1)
    (tmp_path / "plain.csv").write_text("\n".join(map(str, label)))
    (tmp_path / "head.csv").write_text(
        "vertex,label\n" + "\n".join(f"{i},{label[i]}" for i in (4, 3, 2, 1, 0))
    )
    gifti = nibabel.gifti.GiftiImage(
        darrays=[nibabel.gifti.GiftiDataArray(label.astype(np.int32), "NIFTI_INTENT_LABEL")]
    )
    nibabel.save(gifti, tmp_path / "a.label.gii")
    order = np.random.default_rng(0).permutation(len(label)).astype(np.int32)
    arrays = zip((order, label[order].astype(np.int32)), ("NODE_INDEX", "LABEL"), strict=True)
    gifti.darrays = [nibabel.gifti.GiftiDataArray(a, f"NIFTI_INTENT_{of}") for a, of in arrays]
    nibabel.save(gifti, tmp_path / "sparse.label.gii")
    assert (read_labels(tmp_path / "sparse.label.gii", len(label)) == label).all()
    assert (read_scalars(tmp_path / "sparse.label.gii", "", len(label)) == label).all()
    colours = np.array([[i, i, i, 0, 0] for i in range(1, 7)])
    nibabel.freesurfer.write_annot(
        tmp_path / "lh.annot", label, colours, list("abcdef"), fill_ctab=True
    )
    for name in "a.npy float.npy one.npz plain.csv head.csv a.label.gii lh.annot".split():
        (tmp_path / f"{name}.gz").write_bytes(gzip.compress((tmp_path / name).read_bytes()))
        for file in (name, f"{name}.gz"):
            assert read_labels(tmp_path / file, 5).tolist() == label.tolist(), file
    assert read_labels(tmp_path / "two.npz:labels", 5).tolist() == label.tolist()
    (tmp_path / "names.csv").write_text("label\nleft\nright\n")
    assert read_labels(tmp_path / "names.csv", 2).tolist() == ["left", "right"]


def test_labels_of_which_some_are_lost_are_reported(tmp_path, caplog):
    colours = np.array([[1, 2, 3, 0, 0], [1, 2, 3, 0, 0]])
    nibabel.freesurfer.write_annot(
        tmp_path / "lh.annot", np.array([0, 1]), colours, ["a", "b"], fill_ctab=True
    )
    assert read_labels(tmp_path / "lh.annot", 2).tolist() == [0, 0]
    assert (
        "rows 0 and 1 of a colour table have one colour, so the label of both is 0" in caplog.text
    )
    array = nibabel.gifti.GiftiDataArray(np.arange(2, dtype=np.int32), "NIFTI_INTENT_LABEL")
    nibabel.save(nibabel.gifti.GiftiImage(darrays=[array, array]), tmp_path / "a.label.gii")
    assert read_labels(tmp_path / "a.label.gii", 2).tolist() == [0, 1]
    assert "the first of 2 arrays of a GIFTI file is used" in caplog.text


def test_a_wrong_label_file_is_named_with_what_was_expected_and_found(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(4))
    np.save(tmp_path / "half.npy", np.array([0.5, 1]))
    np.savez(tmp_path / "two.npz", p=np.arange(4), q=np.arange(4))
    (tmp_path / "a.csv").write_text("p,q\n1,2\n")
    (tmp_path / "twice.csv").write_text("label,label\n1,2\n")
    (tmp_path / "lh.label").write_text("#!ascii label  , from subject\n1\n99 1 2 3 0\n")
    for name, n, text in (
        ("lh.label", 5, "one label for every vertex expected, found some vertices"),
        ("a.npy", 5, r"a.npy: 5 labels.* found an array of shape \(4,\)"),
        ("half.npy", 2, "half.npy: labels need integers or names, found 0.5"),
        ("two.npz", 4, r"one array of 4 values .* p \(4,\), q \(4,\); name it as two.npz:NAME"),
        ("two.npz:r", 4, "array .r. needed, found p, q"),
        ("a.csv", 1, "one column 'label' needed, found p, q"),
        ("twice.csv", 1, "one column 'label' needed, found label, label"),
        ("none.npy", 1, "no file .*none.npy"),
    ):
        with pytest.raises(ValueError, match=text):
            read_labels(tmp_path / name, n)


def test_landmarks_are_written_as_a_table_and_other_tables_are_refused(tmp_path):
    points = dataset(landmark_name=["a", "b"], landmark_position=[[1.5, 2, 3], [-4, 5.25, 6]])
    numbered = points.assign(landmark_name=("landmark", ["#1", "#2"]))
    write_landmarks(tmp_path / "numbered.csv", numbered)
    assert read_landmarks(tmp_path / "numbered.csv")["landmark_name"].values.tolist() == [
        "#1",
        "#2",
    ]
    write_landmarks(tmp_path / "out.csv", points)
    rows = ["name,x,y,z", "a,1.5,2.0,3.0", "b,-4.0,5.25,6.0"]
    assert (tmp_path / "out.csv").read_text().split() == rows
    (tmp_path / "empty.csv").write_text("p,q\n1,2\n")
    refused = "empty.csv cannot be read as landmarks: the columns name, x, y and z needed"
    with pytest.raises(ValueError, match=refused):
        read_landmarks(tmp_path / "empty.csv")


@pytest.mark.parametrize(
    ("read", "text", "said"),
    [
        (
            read_landmarks,
            "name,x,y,z\n# picked by hand\na,1,2,3\n\nb,1,2\n",
            "line 5 needs 4 cells.* found 3",
        ),
        (
            read_landmarks,
            "name,x,y,z\na,1,2,3\nb,1,5,2,5,3,5\n",
            "line 3 needs 4 cells.* found 7: 'b, 1, 5",
        ),
        (read_landmarks, "a 1 2 3\nb 4\n", "line 2 needs 4 cells.* found 2"),
        (read_landmarks, "name;x;y;z\na;1,5;2;3\n", "line 2 needs a number, found '1,5'"),
        (read_landmarks, "name,x,y,z,curve,closed\na,1,2,3\n", "line 2 needs 6 cells.* found 4"),
        (read_labels, "vertex,label\n0,a\n1\n", "line 3 needs 2 cells.* found 1"),
        (read_labels, "vertex,label\n0,a\nb,a\n", "line 3 needs a number, found 'b'"),
    ],
)
def test_an_invalid_row_is_named_with_its_line(tmp_path, read, text, said):
    (tmp_path / "rows.csv").write_text(text)
    kind = read.__name__.removeprefix("read_")
    with pytest.raises(ValueError, match=rf"rows\.csv cannot be read as {kind}: {said}"):
        read(tmp_path / "rows.csv")


def test_empty_cells_behind_a_row_and_comments_change_no_landmark(tmp_path, caplog):
    (tmp_path / "points.csv").write_text("name,x,y,z\n# by hand, twice\n#1,1,2,3\nb,4,5,6\n")
    assert read_landmarks(tmp_path / "points.csv").sizes["landmark"] == 1
    assert "a row that begins with # is skipped as a comment: #1,1,2,3" in caplog.text
    assert "by hand" not in caplog.text
    (tmp_path / "points.csv").write_text("name,x,y,z,note\n# by hand\na,1,2,3,,\nb,4,5,6\n")
    found = read_landmarks(tmp_path / "points.csv")["landmark_position"].values
    assert found.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_curves_of_slicer_and_of_tables_come_out_of_their_files_in_order(tmp_path):
    def control(*points):
        return [{"label": f"p{i}", "position": p} for i, p in enumerate(points)]

    sulcus, boundary = [[0, 0, 0], [1, 0, 0], [2, 1, 0]], [[0, 0, 1], [1, 0, 1], [1, 1, 1]]
    lists = [
        {"type": "Fiducial", "controlPoints": control([5, 5, 5])},
        {"type": "Curve", "name": "sulcus", "controlPoints": control(*sulcus)},
        {"type": "ClosedCurve", "controlPoints": control(*boundary)},
    ]
    markups = {"markups": [m | {"coordinateSystem": "RAS"} for m in lists]}
    (tmp_path / "a.mrk.json").write_text(json.dumps(markups))
    found = read_landmarks(tmp_path / "a.mrk.json")
    assert found["landmark_curve"].values.tolist() == ["", *["sulcus"] * 3, *["curve_3"] * 3]
    assert found["landmark_closed"].values.tolist() == [False] * 4 + [True] * 3
    write_landmarks(tmp_path / "a.csv", found)
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == "name,x,y,z,curve,closed"
    again = read_landmarks(tmp_path / "a.csv")
    assert again.drop_attrs().identical(found.drop_attrs())
    (tmp_path / "one.csv").write_text("name,x,y,z,curve\na,1,2,3,boundary\n")
    with pytest.raises(
        ValueError, match=r"one.csv .* a curve needs at least two points; 'boundary' has one"
    ):
        read_landmarks(tmp_path / "one.csv")


def test_landmarks_off_the_surface_are_projected_onto_it_and_the_distance_is_reported():
    mesh = synthetic.sphere(2000)
    given = dataset(landmark_name=np.array(["a"]), landmark_position=np.array([[0, 0, 1.05]]))
    found = locate(given, mesh)
    assert found["landmark_distance"].values == pytest.approx(0.05, abs=2e-3)
    assert np.linalg.norm(found["landmark_position"].values) == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("x", [np.nan, np.inf, 1e300, 1e160])
def test_a_landmark_without_a_position_is_named(x):
    given = dataset(landmark_name=["a", "b"], landmark_position=[[0, 0, 1], [0, x, 0]])
    with pytest.raises(ValueError, match="finite positions near the surface; 'b' is at"):
        locate(given, synthetic.sphere(100))


def test_labels_are_numbered_as_in_the_file_and_dropped_vertices_have_the_nearest_label():
    X, T = as_arrays(synthetic.sphere(300))
    small, S = as_arrays(synthetic.sphere(20, radius=0.05))
    points = np.concatenate(
        [[[np.nan] * 3], small + [0, 0, 1.2], X]
    )  # a broken vertex, a loose part, the sphere
    mesh = clean(as_dataset(points, np.concatenate([S + 1, T + 21])))
    height = (mesh["position"].values[:, 2] > 0).astype(int) + 1
    label, dropped = labels_of_file(height, mesh, points)
    assert dropped == 21
    assert (label[1:21] == 2).all()
    assert (label[21:] == (X[:, 2] > 0) + 1).all()
    assert (labels_of_mesh(label, mesh) == height).all()
    with pytest.raises(ValueError, match=r"each of the 321 vertices .* found shape \(300,\)"):
        labels_of_mesh(height, mesh)


def test_the_command_writes_labels_per_vertex_of_the_file_and_landmarks(
    tmp_path, meshes, capsys, monkeypatch
):
    source, target = meshes["brain_01"], meshes["brain_02"]
    loose, L = as_arrays(synthetic.sphere(50, radius=2.0))
    X, T = as_arrays(target)
    points = np.concatenate([loose + X[10] + 20, X])
    write_mesh(tmp_path / "source.ply", *as_arrays(source))
    write_mesh(tmp_path / "target one.obj", points, np.concatenate([L, T + len(loose)]))
    np.save(tmp_path / "labels.npy", source["label"].values)
    write_landmarks(tmp_path / "marks.csv", source)
    files = [tmp_path / "source.ply", tmp_path / "target one.obj"]
    shared = ["--labels", tmp_path / "labels.npy", "--n-coarse", 1200, "--k", 60, "--n-jobs", 1]
    command = [str(a) for a in ["transfer", *files, *shared]]
    marks = ["--source-landmarks", str(tmp_path / "marks.csv"), "--out", str(tmp_path / "out")]
    assert cli.main([*command, *marks]) == 0
    assert "50" in capsys.readouterr().out.splitlines()[-1].split()
    label = np.load(tmp_path / "out" / "target one.labels.npy")
    assert label.shape == (len(points),)
    assert (label[50:] == target["label"].values).mean() > 0.93
    monkeypatch.setattr(quality_control, "FLAGGED", 0.0)
    monkeypatch.setattr(quality_control, "WRONG_RATIO", 0.0)
    sharp = ["--out", str(tmp_path / "sharp"), "--blur", "0", "--fail-on", "flagged"]
    assert cli.main([*command, *sharp]) == 3
    last = capsys.readouterr().out.splitlines()[-1]
    assert "flagged: registration probably wrong (score 0.0" in last
    sharp = np.load(tmp_path / "sharp" / "target one.labels.npy")
    assert 0.95 < (sharp == label).mean() < 1
    sure = np.load(tmp_path / "out" / "target one.confidence.npy")
    assert sure.shape == (len(points),)
    assert 0 < sure.min() <= sure.max() <= 1
    rows = (tmp_path / "out" / "target one.landmarks.csv").read_text().splitlines()
    assert rows[0] == "name,x,y,z"
    marks = read_landmarks(tmp_path / "out" / "target one.landmarks.csv")
    assert (
        distance(marks["landmark_position"].values, target["landmark_position"].values).mean() < 4
    )
    assert cli.main(["transfer", "a.ply", "b.ply", "--out", str(tmp_path)]) == 2
    assert "--labels FILE" in capsys.readouterr().err
    points = ["--source-landmarks", str(tmp_path / "marks.csv"), "--blur", "1"]
    assert cli.main(["transfer", *map(str, files), *points, "--out", str(tmp_path / "no")]) == 2
    assert "--blur needs labels" in capsys.readouterr().err
