"""Fields that a user gives guide initial maps and registration, as landmarks do."""

import numpy as np
import pytest
from small import OPTIONS

import s4a
from s4a.analysis.transfer import image_in_shape
from s4a.geometry.mesh import as_arrays, as_dataset
from s4a.method.refined_eigenfunctions import low_resolution
from s4a.method.shape import Shape, common_fields


def egg(twist=0.0, n=1500):
    """An ellipsoid that is twisted within its surface, and a field that follows the twist."""
    axes = np.array([1.0, 1.3, 2.0])
    X, T = as_arrays(s4a.synthetic.ellipsoid(n, axes))
    u = X / axes
    c, s = np.cos(twist * X[:, 2]), np.sin(twist * X[:, 2])
    u = np.stack([c * u[:, 0] - s * u[:, 1], s * u[:, 0] + c * u[:, 1], u[:, 2]], axis=1)
    field = np.sin(2 * X[:, 0]) + X[:, 1] * X[:, 2]
    return s4a.clean(as_dataset(u * axes, T)), field, u * axes


def error(result, template, true):
    image = image_in_shape(template["position"].values, result)
    return np.linalg.norm(image - true, axis=1).mean()


def test_a_field_tells_what_the_surface_does_not():
    template, f, _ = egg()
    shape, g, true = egg(0.2)
    options = {"n_coarse": 500, "k": 40, "k_init": 20}
    without = error(s4a.match_pair(shape, template, **options), template, true)
    guided = {}
    for weight in (1.0, 4.0):
        marked = [
            s4a.with_features(mesh, {"depth": values}, weight=weight)
            for mesh, values in ((shape, g), (template, f))
        ]
        guided[weight] = error(s4a.match_pair(*marked, **options), template, true)
    assert guided[1.0] < 0.95 * without
    assert guided[4.0] < 0.5 * without


def test_a_field_is_standard_at_both_resolutions_and_unknown_values_count_as_the_mean():
    mesh, f, _ = egg()
    values = 7 + 3 * f
    values[:200] = np.nan
    mesh = s4a.with_features(mesh, {"depth": values, "flat": np.ones(len(f))})
    shape = Shape(mesh, low_resolution(mesh, n_coarse=300, k=10))
    for basis in (shape.full, shape.low):
        assert list(basis.fields) == ["depth"]  # constant fields are ignored
        one = basis.fields["depth"]
        assert abs(basis.area @ one) < 0.1
        assert 0.6 < basis.area @ one**2 < 1.05
    assert common_fields(shape.low, shape.low) == ("depth",)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({}, "at least one field"),
        ({"a": np.ones(3)}, "a value for each of the 1500 vertices"),
        ({"a": np.full(1500, np.inf)}, "finite numbers"),
        ({"a": np.full(1500, np.nan)}, "NaN everywhere"),
        ({"a": "nowhere.npy"}, "nowhere.npy"),
    ],
)
def test_a_field_that_does_not_fit_is_refused(given, text):
    mesh, _, _ = egg()
    with pytest.raises(ValueError, match=text):
        s4a.with_features(mesh, given)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Four brains as files, three of them with a file of a field."""
    folder = tmp_path_factory.mktemp("files")
    tree = s4a.synthetic.brains(4, 700, seed=1)
    for path in s4a.synthetic.write(tree, folder)[:3]:
        mesh = s4a.read_mesh(path)
        np.save(folder / f"{path.stem}.height.npy", mesh[0][:, 2])
    return folder


def test_a_study_reads_fields_next_to_its_files_and_names_shapes_without(files, tmp_path):
    options = OPTIONS | {"pattern": "brain*.ply", "store": tmp_path / "study"}
    study = s4a.analyse(files, features=["height"], **options)
    having = [n for n, mesh in study["original"].children.items() if "feature_value" in mesh]
    assert len(having) == 3
    assert all("feature_value" in study["coarse"][name] for name in having)
    (lacking,) = set(study["original"].children) - set(having)
    report = str(study["report"].attrs)
    assert f"1 of 4 shapes have no field 'height' and are registered without: {lacking}" in report
    guided = study["registration"]["displacement"].values
    study.close()
    height = np.load(files / f"{having[0]}.height.npy")
    np.save(files / f"{having[0]}.height.npy", -height)
    again = s4a.analyse(files, features="height", **options)
    assert (again["original"][having[0]]["feature_value"].values[:, 0] == -height).all()
    assert (again["registration"]["displacement"].values != guided).any()
    # a new mesh with a wrong field is left out alone
    new = tmp_path / "new"
    new.mkdir()
    for name, values in {"right": height, "wrong": height[:-1]}.items():
        (new / f"{name}.ply").write_bytes((files / f"{having[0]}.ply").read_bytes())
        np.save(new / f"{name}.height.npy", values)
    inserted = s4a.insert(again, new)
    assert list(inserted["coarse"].children) == ["right"]
    assert np.isfinite(inserted["registration"]["displacement"].values).all()
    text = inserted["report"].to_dataset().sel(shape="wrong")
    assert text["status"].item() == "excluded"
    assert "height" in text["reason"].item()
    again.close()


def test_a_field_that_no_file_has_is_an_error(files):
    with pytest.raises(ValueError, match="no shape has a field 'sulc': a file such as brain_01"):
        s4a.analyse(files, pattern="brain*.ply", features=["sulc"], **OPTIONS)


def test_features_of_label_volumes_are_refused():
    with pytest.raises(ValueError, match="leave out one of the two"):
        s4a.analyse("nowhere", features="sulc", label=1)
