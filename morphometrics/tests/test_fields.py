"""Scalar fields transferred to the template, tests of them, and field against shape."""

import logging
import shutil

import numpy as np
import pytest
from simulated import TOP, field_study, with_transferred

import s4a
from s4a import cli, open_study, statistics, verify
from s4a.input.annotations import read_scalars
from s4a_morphometrics import (
    field_classify,
    field_group_map,
    field_group_test,
    field_regression,
    growth,
    with_field,
    within,
    without,
    write_field,
)


@pytest.fixture(scope="module")
def simulated():
    return field_study()


def test_a_field_of_the_coordinates_is_carried_to_where_the_template_was_registered(study):
    meshes = study["original"].children.items()
    heights = {name: mesh["position"].values[:, 2] for name, mesh in meshes}
    found = with_field(study, "height", heights, unit="mm")
    field = found["fields/height"].to_dataset()["transferred_field"]
    assert field.dims == ("shape", "vertex")
    assert field.attrs["units"] == "mm"
    mesh = study["registration"].to_dataset()
    template = mesh.attrs["template"]
    assert np.allclose(field.sel(shape=template), mesh["position"].values[:, 2])
    name = next(n for n in heights if n != template)
    own = mesh.sel(shape=name)
    placed = mesh["position"].values + own["displacement"].values
    expected = ((placed - own["translation"].values) @ own["rotation"].values)[:, 2]
    distance = abs(field.sel(shape=name).values - expected)
    assert np.median(distance) < 0.02 * np.ptp(expected)
    assert "fields" not in study.children


def test_a_field_is_kept_in_the_folder_of_its_study(study_folder, tmp_path, capsys):
    folder = shutil.copytree(study_folder, tmp_path / "study")
    study, files = open_study(folder), tmp_path / "files"
    files.mkdir()
    rng = np.random.default_rng(0)
    for name, mesh in study["original"].children.items():
        np.save(files / f"{name}.npy", rng.normal(size=mesh.sizes["file_vertex_index"]))
    assert cli.main(["fields", str(folder), str(files), "--name", "noise", "--unit", "um"]) == 0
    assert "noise of 4 of 4 shapes" in capsys.readouterr().out
    kept = open_study(folder)["fields/noise"].to_dataset()["transferred_field"]
    assert kept.attrs["units"] == "um"
    assert np.isfinite(kept).all()
    assert set(verify(folder)["state"].values.tolist()) == {"whole"}
    first = folder / "registration" / f"{kept['shape'].values[0]}.nc"
    first.unlink()  # a study that is registered again has no field of the old registration
    assert "fields" not in open_study(folder).children


def test_files_of_fields_are_read_as_they_are_written(tmp_path):
    values = np.array([1.5, -2, 3])
    np.save(tmp_path / "a.npy", values)
    np.savez(tmp_path / "a.npz", thickness=values, other=values[:2])
    (tmp_path / "a.csv").write_text("vertex,thickness\n0,1.5\n1,-2\n2,3\n")
    (tmp_path / "a.txt").write_text("1.5\n-2\n3\n")
    s4a.write_mesh(tmp_path / "a.ply", np.eye(3), [[0, 1, 2]], thickness=values)
    curv = b"\xff\xff\xff" + np.array([3, 1, 1], ">i4").tobytes() + values.astype(">f4").tobytes()
    (tmp_path / "a.thickness").write_bytes(curv)
    s4a.write_mesh(tmp_path / "a.gii", np.eye(3), [[0, 1, 2]], thickness=values)
    for file in sorted(tmp_path.iterdir()):
        assert read_scalars(file, "thickness", 3).tolist() == values.tolist(), file.name
        with pytest.raises(ValueError, match=f"{file.name}: 4 numbers, one per vertex, needed"):
            read_scalars(file, "thickness", 4)
    for wrong, message in {
        "a.npz": "an array 'curv' expected, found thickness, other",
        "a.ply": "a vertex property 'curv' expected",
        "a.csv": "one column 'curv' needed, found vertex, thickness",
    }.items():
        with pytest.raises(ValueError, match=message):
            read_scalars(tmp_path / wrong, "curv")
    (tmp_path / "cut.curv").write_bytes(curv[:-2])
    with pytest.raises(ValueError, match=r"cut.curv cannot be read as a field: one number for"):
        read_scalars(tmp_path / "cut.curv")


def test_rows_of_a_table_are_in_the_order_of_its_vertices(tmp_path):
    file = tmp_path / "thickness.csv"
    file.write_text("vertex,thickness\n2,30\n0,10\n1,20\n")
    assert read_scalars(file, "thickness").tolist() == [10, 20, 30]
    file.write_text("vertex,thickness\n2,30\n0,10\n2,20\n")
    with pytest.raises(ValueError, match="every vertex from 0 to 2 needed once"):
        read_scalars(file, "thickness")


def test_nibabel_reads_and_writes_the_same_files_of_freesurfer(tmp_path):
    from nibabel.freesurfer import io

    values = np.random.default_rng(0).normal(size=50).astype(np.float32)
    io.write_morph_data(tmp_path / "lh.curv", values, 96)
    assert read_scalars(tmp_path / "lh.curv").tolist() == values.astype(float).tolist()


def test_a_field_that_does_not_fit_is_refused_by_shape(study, caplog):
    meshes = study["original"].children
    good = {name: np.arange(mesh.sizes["vertex"]) * 1.0 for name, mesh in meshes.items()}
    first, second, *_ = good
    with pytest.raises(ValueError, match=f"of {first} needs a value for each of the .*vertices"):
        with_field(study, "f", good | {first: np.ones(7)})
    with pytest.raises(ValueError, match=f"lacks {second}: give them, or partial=True"):
        with_field(study, "f", {name: good[name] for name in good if name != second})
    with pytest.raises(ValueError, match=f"of {second} needs finite numbers.* 1 are infinite"):
        with_field(study, "f", good | {second: np.r_[np.inf, good[second][1:]]})
    with pytest.raises(ValueError, match=f"of {second} is NaN everywhere"):
        with_field(study, "f", good | {second: good[second] * np.nan})
    with pytest.raises(ValueError, match="values for nobody, which are not shapes"):
        with_field(study, "f", good | {"nobody": good[first]})
    with pytest.raises(ValueError, match="one array for each of 4 shapes, found 2"):
        with_field(study, "f", [good[first], good[second]])
    with pytest.raises(ValueError, match=r"needs numbers, found <U1"):
        with_field(study, "f", good | {first: np.full(len(good[first]), "a")})
    with pytest.raises(ValueError, match="a name of letters"):
        with_field(study, "a/b", good)
    assert not caplog.records
    with_field(study, "f", good | {first: np.full(len(good[first]), 2.5)})
    assert f"of {first} is 2.5 everywhere: is it the right file?" in caplog.text
    found = with_field(study, "f", good | {first: None}, partial=True)
    assert f"no values for {first}" in caplog.text
    values = found["fields/f"].to_dataset()["transferred_field"]
    assert np.isnan(values.sel(shape=first)).all()
    assert np.isfinite(values.sel(shape=second)).all()
    with pytest.raises(ValueError, match="no field 'g'; with_field adds one"):
        write_field(found, "g", "nowhere")


def test_a_group_difference_in_a_field_is_located(simulated):
    options = {"covariates": ["age", "score"], "n_permutations": 199}
    where = field_group_map(simulated, "thickness", "group", **options)
    assert where["field_effect"].attrs["units"] == "mm"
    assert abs(where["field_effect"].values[TOP].mean() - 4) < 0.5
    assert (where["p_family_wise"].values[TOP] < 0.05).mean() > 0.9
    assert (where["p_family_wise"].values[~TOP] < 0.05).mean() < 0.05
    assert "effect" not in where
    assert field_group_test(simulated, "thickness", "group", **options)["p_value"] < 0.02
    assert statistics.group_test(simulated, "group", **options)["p_value"] > 0.05
    classes = field_classify(simulated, "thickness", "group", n_permutations=9)
    assert classes.attrs["balanced_accuracy"] > 0.8


def test_the_slope_of_a_field_is_that_of_least_squares(simulated):
    fit = field_regression(
        simulated, "thickness", "age", covariates=["group", "score"], n_permutations=199
    )
    table = simulated["subjects"]
    columns = [np.ones(20), table["age"], table["group"] == "b", table["score"]]
    values = simulated["fields/thickness/transferred_field"].values
    slope = np.linalg.lstsq(np.column_stack(columns).astype(float), values, rcond=None)[0][1]
    assert np.allclose(fit["field_effect"], slope)
    assert (fit["p_false_discovery"].values[~TOP] < 0.05).mean() > 0.9
    for refused in (statistics.predict, statistics.regression_modes):
        with pytest.raises(ValueError, match="a regression of displacements is needed"):
            refused(simulated, fit, *([1.0] if refused is statistics.predict else []))
    with pytest.raises(ValueError, match="a field has no normal component"):
        growth(simulated, "age", "group", field="thickness", of="normal")


def test_vertices_and_shapes_without_a_field_are_left_out_and_reported(simulated, caplog):
    caplog.set_level(logging.WARNING)
    values = simulated["fields/thickness/transferred_field"].values.copy()
    values[3, :5] = np.nan
    values[7] = np.nan
    holed = with_transferred(simulated, values)
    where = field_group_map(holed, "thickness", "group", n_permutations=99)
    assert "is missing in some shape at 5 of" in caplog.text
    assert "field 'thickness' has no value for 1 of 20 shapes" in caplog.text
    assert where.attrs["left_out"] == "shape_07"
    assert np.isnan(where["p_family_wise"].values[:5]).all()
    assert np.isfinite(where["p_family_wise"].values[5:]).all()
    with pytest.raises(ValueError, match=r"no field 'curv'; it has thickness"):
        field_group_map(simulated, "curv", "group")
    same = with_transferred(simulated, np.ones_like(values))
    with pytest.raises(ValueError, match="the same in all shapes: no variation to test"):
        field_group_map(same, "thickness", "group")


def test_a_field_follows_its_vertices_into_a_region(simulated):
    part = within(simulated, TOP)
    vertex = part["registration"]["template_vertex"].values
    values = simulated["fields/thickness/transferred_field"].values
    assert np.array_equal(part["fields/thickness/transferred_field"].values, values[:, vertex])
    again = without(part, "age")
    assert again["fields/thickness"].equals(part["fields/thickness"])


def test_the_command_takes_a_field_in_place_of_shape(tmp_path, study_folder):
    folder = shutil.copytree(study_folder, tmp_path / "study")
    study = open_study(folder)
    meshes, rng = study["original"].children.items(), np.random.default_rng(0)
    values = {name: rng.normal(size=mesh.sizes["vertex"]) for name, mesh in meshes}
    write_field(with_field(study, "noise", values), "noise", folder)
    table = tmp_path / "t.csv"
    rows = [f"{name},{i + i * i}" for i, name in enumerate(values)]
    table.write_text("\n".join(["shape,age", *rows]))
    words = ["--regress-on", "age", "--table", str(table), "--permutations", "19"]
    assert cli.main(["field-statistics", str(folder), "noise", *words]) == 0
    out = folder / "statistics"
    assert "field_effect" in (out / "noise_regression.vertex.csv").read_text().splitlines()[0]
    assert not (out / "regression.html").exists()
