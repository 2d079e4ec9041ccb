"""Files for other programs: read back as those programs read them, they hold what the study does.

No function of :mod:`s4a` reads the files, except where stated.
"""

import base64
import json
import logging
import shutil
import xml.etree.ElementTree as ET

import h5py
import nibabel
import numpy as np
import pytest
import xarray as xr
from paths import DOCS

import s4a
from s4a import read_mesh
from s4a.analysis.transfer import image_in_shape
from s4a.cli import main
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input.annotations import read_landmarks, write_landmarks
from s4a.input.subjects import with_table
from s4a.schema import dataset
from s4a_morphometrics import write_for
from s4a_morphometrics.programs import PROGRAMS, R_SCRIPT
from s4a_morphometrics.scalismo import read_scalismo


@pytest.fixture(scope="module")
def tabled(study, tmp_path_factory):
    """The study of the brains, with a table."""
    names = study["registration"]["shape"].values.tolist()
    rows = zip(names, "abab", (31, 40, 22, 35), strict=True)
    table = tmp_path_factory.mktemp("table") / "subjects.csv"
    table.write_text("shape,group,age\n" + "".join(f"{s},{g},{a}\n" for s, g, a in rows))
    return with_table(study, table)


def aligned(study):
    """Registered shapes in the frame of the template (s, n, 3)."""
    data = study["registration"].to_dataset()
    return data["position"].values + data["displacement"].values


# ShapeWorks: a project of JSON, all of whose cells are texts (Libs/Project/JsonProjectReader.cpp)


def test_shapeworks_finds_meshes_and_particles_that_its_alignment_takes_to_the_world(
    tabled, tmp_path
):
    write_for(tabled, tmp_path, "shapeworks", n_points=50)
    project = json.loads((tmp_path / "study.swproj").read_text())
    rows = project["data"]
    assert [row["name"] for row in rows] == tabled["registration"]["shape"].values.tolist()
    assert [row["group_group"] for row in rows] == list("abab")
    assert [float(row["age"]) for row in rows] == [31, 40, 22, 35]
    for row, whole in zip(rows, aligned(tabled), strict=True):
        assert all(isinstance(value, str) for value in row.values())
        M = [np.array(row[f"{kind}_1"].split(), float) for kind in ("alignment", "procrustes")]
        M = M[1].reshape(4, 4) @ M[0].reshape(4, 4)
        local, world = (
            np.loadtxt(tmp_path / row[f"{kind}_particles_1"]) for kind in ("local", "world")
        )
        assert local.shape == (50, 3)
        assert local @ M[:3, :3].T + M[:3, 3] == pytest.approx(world, abs=1e-5)
        near = np.linalg.norm(whole[None] - world[:, None], axis=2)
        assert near.min(1).max() < 1e-4  # each is a vertex of the registered shape
        X, _, _ = read_mesh(tmp_path / row["shape_1"])
        assert X == pytest.approx(tabled["original"][row["name"]]["position"].values, abs=1e-3)
        distance = np.linalg.norm(X[None] - local[:, None], axis=2).min(1)
        assert distance.mean() < 8  # mm: particles lie on the mesh, as well as it was registered
    assert project["optimize"] == {"number_of_particles": "50"}


def test_particles_of_one_number_are_one_vertex_on_all_shapes(study, tmp_path):
    write_for(study, tmp_path, "shapeworks", n_points=40)
    files = sorted((tmp_path / "particles").glob("*_world.particles"))
    world = np.stack([np.loadtxt(file) for file in files])
    whole = aligned(study)
    vertex = np.linalg.norm(whole[0][None] - world[0][:, None], axis=2).argmin(1)
    assert len(set(vertex.tolist())) == 40
    assert whole[:, vertex] == pytest.approx(world, abs=1e-5)


# Scalismo: as its StatismoIO reads


def as_scalismo_reads(path):
    """Points, cells, mean (n, 3), basis (3 n, c) and variances, of the types that it casts to."""
    with h5py.File(path) as file:
        representer = file["representer"]
        assert representer.attrs["datasetType"] == "POLYGON_MESH"
        assert representer.attrs["name"] == "itkStandardMeshRepresenter"
        version = [file[f"version/{part}Version"] for part in ("major", "minor")]
        assert [v.dtype for v in version] == [np.int32] * 2
        assert [int(v[()]) for v in version] == [0, 9]
        points, cells = representer["points"][()], representer["cells"][()]
        arrays = [file[f"model/{name}"][()] for name in ("mean", "pcaBasis", "pcaVariance")]
        assert {a.dtype for a in (points, *arrays)} == {np.dtype(np.float32)}
        assert cells.dtype == np.int32
        assert file["model/noiseVariance"].shape == (1,)
        assert points.shape[0] == cells.shape[0] == 3
        mean, basis, variance = (a.astype(float) for a in arrays)
        return points.T, cells.T, mean.reshape(-1, 3), basis, variance


def test_scalismo_reads_the_gaussian_of_the_modes(study, tmp_path):
    (path,) = write_for(study, tmp_path, "scalismo")
    points, cells, mean, basis, variance = as_scalismo_reads(path)
    data = study["registration"].to_dataset()
    assert points == pytest.approx(data["position"].values, abs=1e-3)
    assert (cells == data["corner_vertex"].values).all()
    assert mean == pytest.approx(s4a.synthesize(study, [0.0])["position"].values, abs=1e-3)
    assert basis.T @ basis == pytest.approx(np.eye(len(variance)), abs=1e-4)
    assert (np.diff(variance) <= 0).all()
    D = study["pca"]["deformation"].values.astype(float).reshape(len(variance), -1)
    some = np.random.default_rng(0).choice(D.shape[1], 200, replace=False)
    covariance = (basis[some] * variance) @ basis[some].T
    assert covariance == pytest.approx(D[:, some].T @ D[:, some], abs=1e-3 * variance[0] / 100)


def test_a_model_of_scalismo_is_read_as_modes_of_the_same_spread(study, tmp_path):
    (path,) = write_for(study, tmp_path, "scalismo", n_modes=2)
    model = read_scalismo(path)
    deviations = model["pca"]["standard_deviation"].values
    assert len(deviations) == 2
    known = study["pca"]["standard_deviation"].values[:2]
    assert (deviations**2).sum() == pytest.approx((known**2).sum(), rel=1e-4)
    moved = s4a.synthesize(model, [1.0])["position"] - s4a.synthesize(model, [0.0])["position"]
    area = vertex_areas(*as_arrays(model["registration"].to_dataset()))
    root = np.sqrt(area @ (moved.values**2).sum(1) / area.sum())
    assert root == pytest.approx(deviations[0], rel=1e-4)


def test_a_model_of_the_first_statismo_has_its_deviations_in_its_basis(study, tmp_path):
    (path,) = write_for(study, tmp_path, "scalismo")
    new = read_scalismo(path)
    with h5py.File(path, "a") as file:
        basis = file["model/pcaBasis"][()] * np.sqrt(file["model/pcaVariance"][()])
        del file["version"], file["model/pcaBasis"]
        file["model/pcaBasis"] = basis
        file["representer"].attrs["name"] = "vtkPolyDataRepresenter"
    old = read_scalismo(path)
    assert old["pca"]["deformation"].values == pytest.approx(
        new["pca"]["deformation"].values, abs=1e-4
    )


def test_invalid_models_are_refused_with_the_missing_part(study, tmp_path):
    (path,) = write_for(study, tmp_path, "scalismo")
    cut, other = tmp_path / "cut.h5", tmp_path / "other.h5"
    shutil.copy(path, cut)
    with h5py.File(cut, "a") as file:
        mean = file["model/mean"][:-3]
        del file["model/mean"]
        file["model/mean"] = mean
    with h5py.File(other, "w") as file:
        file["model/mean"] = h5py.ExternalLink(str(path), "model/mean")
    (tmp_path / "text.h5").write_text("no HDF5")
    n = study["registration"].sizes["vertex"]
    for file, words in {
        cut: rf"cut\.h5 .* points \(3, n\).* found \(3, {n}\), .*\({3 * n - 3},\)",
        other: "other.h5 cannot be read as a statistical shape model: model/mean is a link",
        tmp_path / "text.h5": "text.h5 cannot be read as a statistical shape model",
        tmp_path / "none.h5": "no file .*none.h5",
    }.items():
        with pytest.raises(ValueError, match=words):
            read_scalismo(file)


# ParaView: its collection and VTK's XML


def vtk_array(node):
    """The numbers of a DataArray in base64 after their length, as VTK reads them."""
    kinds = {"Float32": "<f4", "Float64": "<f8", "Int64": "<i8"}
    raw = base64.b64decode(node.text)
    assert int.from_bytes(raw[:8], "little") == len(raw) - 8
    values = np.frombuffer(raw[8:], kinds[node.get("type")])
    width = int(node.get("NumberOfComponents"))
    return values.reshape(-1, width) if width > 1 else values


def test_paraview_plays_a_mode_from_minus_to_plus(study, tmp_path):
    paths = write_for(study, tmp_path, "paraview", n_modes=2, n_steps=5, extent=2.0)
    assert [path.name for path in paths] == ["mode_1.pvd", "mode_2.pvd", "shapes.pvd"]
    root = ET.parse(tmp_path / "mode_2.pvd").getroot()
    assert root.get("type") == "Collection"
    steps = [(float(s.get("timestep")), s.get("file")) for s in root.iter("DataSet")]
    assert [time for time, _ in steps] == [-2, -1, 0, 1, 2]
    mean = s4a.synthesize(study, [0.0])["position"].values
    for time, name in steps:
        tree = ET.parse(tmp_path / name).getroot()
        assert tree.get("header_type") == "UInt64"
        arrays = {node.get("Name"): vtk_array(node) for node in tree.iter("DataArray")}
        known = s4a.synthesize(study, [0.0, time])["position"].values
        assert arrays["Points"] == pytest.approx(known)
        assert arrays["displacement"] == pytest.approx(known - mean, abs=1e-3)
        assert (arrays["offsets"] == np.arange(3, len(arrays["connectivity"]) + 1, 3)).all()
        triangles = study["registration"]["corner_vertex"].values
        assert (arrays["connectivity"].reshape(-1, 3) == triangles).all()
        assert arrays["confidence"].shape == (len(mean),)
        X, T, _ = read_mesh(tmp_path / name)  # and by the reader that knows what VTK writes
        assert (X == arrays["Points"]).all()
        assert (T == triangles).all()


def test_paraview_plays_the_registered_shapes_in_the_order_of_the_study(study, tmp_path):
    write_for(study, tmp_path, "paraview", n_modes=1, n_steps=2)
    for i, known in enumerate(aligned(study)):
        X, _, _ = read_mesh(tmp_path / "shapes" / f"{i:03d}.vtp")
        assert X == pytest.approx(known, abs=1e-4)


# R: the netCDF that ncdf4 reads, and what geomorph's readland.tps looks for


def test_r_has_every_vertex_and_a_row_for_every_shape(tabled, tmp_path):
    write_for(tabled, tmp_path, "r", n_points=30)
    with xr.open_dataset(tmp_path / "shapes.nc", engine="h5netcdf") as data:
        assert data["aligned_position"].dims == ("shape", "vertex", "xyz")
        assert data["aligned_position"].values == pytest.approx(aligned(tabled), abs=1e-4)
        assert data["aligned_position"].attrs["units"] == "mm"
        chosen = data["point_vertex"].values
    lines = (tmp_path / "points.tps").read_text().splitlines()
    assert [line for line in lines if line.startswith("LM3=")] == ["LM3=30"] * 4
    names = [line[3:] for line in lines if line.startswith("ID=")]
    assert names == tabled["registration"]["shape"].values.tolist()
    numbers = np.array([line.split() for line in lines if "=" not in line], float)
    assert numbers.reshape(4, 30, 3) == pytest.approx(aligned(tabled)[:, chosen], abs=1e-4)
    rows = (tmp_path / "subjects.csv").read_text().splitlines()
    assert rows[0].startswith("shape,group,age,component_1")
    assert rows[1].startswith(f"{names[0]},a,31,")


def test_the_page_has_the_lines_that_are_written_for_r(study, tmp_path):
    write_for(study, tmp_path, "r")
    assert (tmp_path / "study.R").read_text() == R_SCRIPT
    assert f"```r\n{R_SCRIPT}```" in (DOCS / "programs.md").read_text(encoding="utf-8")


# 3D Slicer: its markups, and the frame in the title of a VTK file


@pytest.mark.parametrize("system, sign", [("LPS", -1), ("RAS", 1)])
def test_a_file_as_slicer_writes_it_is_read_and_written_again(tmp_path, system, sign):
    def points(*places, **more):
        return [{"label": f"p{i}", "position": p, **more} for i, p in enumerate(places)]

    frame = {"coordinateSystem": system, "coordinateUnits": "mm"}
    later = points([0, 0, 0], positionStatus="undefined")
    theirs = [
        {"type": "Fiducial", "controlPoints": [*points([1.5, -92.25, 30], [61, 4.5, 8]), *later]},
        {"type": "ClosedCurve", "name": "boundary", "controlPoints": points([1, 1, 0], [2, 4, 0])},
        {"type": "ROI", "roiType": "Box", "center": [0, 0, 0], "size": [9, 9, 9]},
    ]
    markups = {"markups": [one | frame for one in theirs]}
    (tmp_path / "slicer.mrk.json").write_text(json.dumps(markups))
    read = read_landmarks(tmp_path / "slicer.mrk.json")
    assert read.attrs["coordinate_system"] == system
    assert read["landmark_position"].values[1].tolist() == [61, 4.5, 8]
    assert read["landmark_closed"].values.tolist() == [False] * 2 + [True] * 2
    write_landmarks(tmp_path / "ours.mrk.json", read)
    assert read_landmarks(tmp_path / "ours.mrk.json").identical(read)
    ours = json.loads((tmp_path / "ours.mrk.json").read_text())["markups"]
    assert [one["type"] for one in ours] == ["Fiducial", "ClosedCurve"]
    # LPS and RAS differ in the signs of two axes
    axes = np.reshape(ours[0]["controlPoints"][0]["orientation"], (3, 3))
    assert np.diag(axes).tolist() == [sign, sign, 1]


def test_markups_without_a_frame_are_lps_as_slicer_takes_them(tmp_path):
    marks = dataset(landmark_name=["a"], landmark_position=[[1.0, 2, 3]])
    write_landmarks(tmp_path / "a.mrk.json", marks)
    found = json.loads((tmp_path / "a.mrk.json").read_text())["markups"][0]
    assert found["coordinateSystem"] == "LPS"
    assert "coordinateUnits" not in found  # no unit is written if the unit is unknown


def test_slicer_has_surfaces_points_and_landmarks_in_the_frames_of_the_files(study, tmp_path):
    write_for(study, tmp_path, "slicer", n_points=25)
    data = study["registration"].to_dataset()
    for name in data["shape"].values.tolist():
        assert b"SPACE=RAS" in (tmp_path / f"{name}.vtk").read_bytes()[:200]
        X, T, attrs = read_mesh(tmp_path / f"{name}.vtk")
        known = image_in_shape(data["position"].values, data.sel(shape=name))
        assert X == pytest.approx(known, abs=1e-5)
        assert (T == data["corner_vertex"].values).all()
        assert attrs["coordinate_system"] == "RAS"
        points = read_landmarks(tmp_path / "points" / f"{name}.mrk.json")
        vertex = points["landmark_name"].values.astype(int)
        assert len(vertex) == 25
        assert points["landmark_position"].values == pytest.approx(known[vertex])
        assert points.attrs["coordinate_system"] == "RAS"
        marks = read_landmarks(tmp_path / "landmarks" / f"{name}.mrk.json")
        own = study["original"][name].to_dataset()
        assert marks["landmark_name"].values.tolist() == own["landmark_name"].values.tolist()
        distance = marks["landmark_position"].values - own["landmark_position"].values
        assert np.linalg.norm(distance, axis=1).mean() < 15  # mm, few vertices


def test_landmarks_of_the_other_frame_are_written_in_the_frame_of_the_template(study, tmp_path):
    name = study["registration"].attrs["template"]
    Y = study["original"][name]["position"].values[[5, 200, 400]]
    given = dataset(
        {"coordinate_system": "LPS"}, landmark_name=list("abc"), landmark_position=Y * [-1, -1, 1]
    )
    write_for(study, tmp_path, "slicer", n_points=5, landmarks=given)
    written = read_landmarks(tmp_path / "landmarks" / f"{name}.mrk.json")
    assert written.attrs["coordinate_system"] == "RAS"
    assert written["landmark_position"].values == pytest.approx(Y, abs=1e-5)


def test_files_without_a_frame_are_reported_for_slicer(study, tmp_path, caplog):
    plain = study.copy(deep=True)
    for node in plain["original"].children.values():
        node.attrs.pop("coordinate_system")
    with caplog.at_level(logging.WARNING):
        write_for(plain, tmp_path, "slicer", n_points=5)
    assert "do not say whether they are RAS or LPS; 3D Slicer takes them as LPS" in caplog.text
    name = plain["registration"]["shape"].values[0]
    assert b"SPACE" not in (tmp_path / f"{name}.vtk").read_bytes()[:200]


def test_axes_that_slicer_does_not_read_are_converted(study, tmp_path):
    other = study.copy(deep=True)
    name = str(other["registration"]["shape"].values[0])
    other["original"][name].attrs["coordinate_system"] = "LAS"
    write_for(other, tmp_path, "slicer", n_points=5)
    X, _, attrs = read_mesh(tmp_path / f"{name}.vtk")
    assert attrs["coordinate_system"] == "RAS"
    data = study["registration"].to_dataset()
    known = image_in_shape(data["position"].values, data.sel(shape=name))
    assert X == pytest.approx(known * [-1, 1, 1], abs=1e-5)


def test_a_mirrored_shape_is_written_in_the_frame_of_its_file(study, tmp_path):
    mirrored = study.copy(deep=True)
    name = study["registration"]["shape"].values[1]
    mirrored["original"][name].attrs["reflected"] = 1
    write_for(study, tmp_path / "a", "slicer", n_points=8)
    write_for(mirrored, tmp_path / "b", "slicer", n_points=8)
    (X, T, _), (Y, S, _) = (read_mesh(tmp_path / way / f"{name}.vtk") for way in "ab")
    assert (Y == X * [-1, 1, 1]).all()
    assert (S == T[:, ::-1]).all()
    for kind in ("points", "landmarks"):
        a, b = (read_landmarks(tmp_path / way / kind / f"{name}.mrk.json") for way in "ab")
        assert b["landmark_position"].values == pytest.approx(
            a["landmark_position"].values * [-1, 1, 1]
        )


# NIfTI: label volumes in the grid of a scan

AFFINE = np.array([[-2.0, 0, 0, 30], [0, 0, 2, -28], [0, 2, 0, -26], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """Four label volumes, rotated and mirrored like scans, and the study of label 2."""
    pytest.importorskip("skimage")
    folder = tmp_path_factory.mktemp("scans")
    place = np.stack(np.meshgrid(*[np.arange(28)] * 3, indexing="ij"), -1) - 14
    for i, axes in enumerate(([11, 8, 7], [10, 9, 7], [11, 9, 6], [10, 8, 8])):
        bump = ((place - [5, 4, 3 + i]) ** 2).sum(-1) < 30
        volume = np.where((((place / axes) ** 2).sum(-1) < 1) | bump, 2, 0)
        volume[:2, :2, :2] = 1  # another structure
        image = nibabel.Nifti1Image(volume.astype(np.uint8), AFFINE)
        nibabel.save(image, folder / f"scan_{i}.nii.gz")
    study = s4a.analyse(folder, label=2, n_coarse=200, k_init=8, k=16, n_jobs=1)
    return folder, study


def sides(study):
    """Labels of the template: 5 where the world's x is positive, else 9."""
    name = study["registration"].attrs["template"]
    X = study["original"][name]["position"].values
    return np.where(X[:, 0] > np.median(X[:, 0]), 5, 9)


def test_labels_fill_the_voxels_that_made_each_shape_in_the_grid_of_its_scan(scans, tmp_path):
    folder, study = scans
    paths = write_for(study, tmp_path, "nifti", label=sides(study))
    assert [path.name for path in paths] == [f"scan_{i}.nii.gz" for i in range(4)]
    template = study["registration"].attrs["template"]
    for path in paths:
        found, scan = nibabel.load(path), nibabel.load(folder / path.name)
        assert np.array_equal(found.affine, scan.affine)
        assert found.header.get_xyzt_units()[0] == "mm"
        values, marked = np.asanyarray(found.dataobj), np.asanyarray(scan.dataobj) == 2
        assert values.dtype == np.int16
        assert (np.isin(values, [5, 9]) == marked).all()  # these voxels, and no others
        x = (np.argwhere(marked) @ AFFINE[:3, :3].T + AFFINE[:3, 3])[:, 0]
        own = study["original"][path.name.removesuffix(".nii.gz")]["position"].values[:, 0]
        far = abs(x - np.median(own)) > (4 if path.name.startswith(template) else 8)  # mm
        assert far.sum() > 500
        assert ((x > np.median(own)) == (values[marked] == 5))[far].mean() > 0.99


def test_labels_fill_the_interior_of_a_shape_in_any_grid(scans, tmp_path):
    folder, study = scans
    other = np.diag([1.5, 1.5, 1.5, 1]).astype(float)
    other[:3, 3] = [-30, -32, -30]
    grid = tmp_path / "grid.nii.gz"
    grey = np.random.default_rng(0).random((40, 44, 42)).astype(np.float32)
    nibabel.save(nibabel.Nifti1Image(grey, other), grid)
    paths = write_for(study, tmp_path / "out", "nifti", label=sides(study), grid=grid)
    for path in paths:
        found, scan = nibabel.load(path), nibabel.load(folder / path.name)
        assert np.array_equal(found.affine, other)
        assert found.shape == grey.shape
        volume = (np.asanyarray(found.dataobj) > 0).sum() * 1.5**3
        assert volume == pytest.approx((np.asanyarray(scan.dataobj) == 2).sum() * 8, rel=0.03)
        inverse = np.linalg.inv(AFFINE)
        place = np.argwhere(np.asanyarray(found.dataobj)) @ other[:3, :3].T + other[:3, 3]
        voxel = np.rint(place @ inverse[:3, :3].T + inverse[:3, 3]).astype(int)
        assert (np.asanyarray(scan.dataobj)[tuple(voxel.T)] == 2).mean() > 0.95


def test_a_mesh_in_lps_and_one_that_was_mirrored_fill_the_same_voxels(scans, tmp_path):
    folder, study = scans
    grid = folder / "scan_0.nii.gz"
    (known, *_) = write_for(study, tmp_path / "a", "nifti", label=sides(study), grid=grid)
    turned = study.copy(deep=True)
    registration, node = turned["registration"], turned["original"]["scan_0"]
    node["position"] = node["position"] * [-1, -1, 1]
    node.attrs["coordinate_system"] = "LPS"
    R = registration["rotation"].values.copy()
    first = registration["shape"].values.tolist().index("scan_0")
    R[first] = R[first] @ np.diag([-1.0, -1, 1])
    registration["rotation"] = registration["rotation"].copy(data=R)
    if registration.attrs["template"] != "scan_0":
        (found, *_) = write_for(turned, tmp_path / "b", "nifti", label=sides(study), grid=grid)
        assert np.array_equal(nibabel.load(found).dataobj, nibabel.load(known).dataobj)


# surfaces of FreeSurfer, which lie c_ras beside the scan


@pytest.fixture(scope="module")
def surfaces(study):
    """The study as if its files were in surface RAS, and c_ras."""
    moved = study.copy(deep=True)
    for node in moved["original"].children.values():
        node.attrs["coordinate_system"] = "surface RAS, c_ras 12 -20 35"
    return moved, np.array([12.0, -20, 35])


def test_exported_points_of_freesurfer_lie_where_the_scan_has_them(surfaces, tmp_path):
    study, offset = surfaces
    data, place = study["registration"].to_dataset(), {}
    for name in data["shape"].values.tolist():
        place[name] = image_in_shape(data["position"].values, data.sel(shape=name)) + offset
    write_for(study, tmp_path, "slicer", n_points=5)
    s4a.write_registered(study, tmp_path, format="gifti", frame="shape")
    for name, scan in place.items():
        assert read_mesh(tmp_path / f"{name}.vtk")[0] == pytest.approx(scan)
        points = read_landmarks(tmp_path / "points" / f"{name}.mrk.json")
        vertex = points["landmark_name"].values.astype(int)
        assert points["landmark_position"].values == pytest.approx(scan[vertex])
        image = nibabel.load(tmp_path / f"{name}.gii")
        assert image.agg_data("pointset") == pytest.approx(scan, abs=1e-4)
    vtk = pytest.importorskip("vtk")
    reader = vtk.vtkPolyDataReader()
    reader.SetFileName(str(tmp_path / f"{name}.vtk"))
    reader.Update()
    assert np.array(reader.GetOutput().GetPoint(7)) == pytest.approx(scan[7])


def test_labels_of_freesurfer_surfaces_are_written_where_the_scan_has_them(
    surfaces, study, tmp_path
):
    moved, offset = surfaces
    affine = np.diag([5.0, 5, 5, 1])
    affine[:3, 3] = -100
    label, found = np.ones(study["registration"].sizes["vertex"], int), []
    for tree, shift in ((study, np.zeros(3)), (moved, offset)):
        affine_of = affine.copy()
        affine_of[:3, 3] += shift
        grid = tmp_path / f"{shift[0]}.mgz"
        nibabel.save(nibabel.MGHImage(np.zeros((40,) * 3, np.uint8), affine_of), grid)
        (path, *_) = write_for(tree, tmp_path / str(shift[0]), "nifti", label=label, grid=grid)
        found.append(np.asanyarray(nibabel.load(path).dataobj))
    assert np.array_equal(*found)
    assert found[0].any()


# what is refused


def test_shapes_that_do_not_say_their_coordinates_are_not_written_into_a_scan(study, tmp_path):
    plain = study.copy(deep=True)
    for node in plain["original"].children.values():
        del node.attrs["coordinate_system"]
    scan = nibabel.Nifti1Image(np.zeros((40,) * 3, np.uint8), np.diag([5.0, 5, 5, 1]))
    nibabel.save(scan, tmp_path / "scan.nii")
    label = np.ones(study["registration"].sizes["vertex"], int)
    options = {"label": label, "grid": tmp_path / "scan.nii"}
    with pytest.raises(
        ValueError, match=r"unknown mm.* cannot be converted to RAS, mm: set coordinate_"
    ):
        write_for(plain, tmp_path / "out", "nifti", **options)
    assert not (tmp_path / "out").exists()
    assert write_for(plain, tmp_path / "out", "nifti", coordinate_system="RAS", **options)


@pytest.mark.parametrize(
    "program, options, words",
    [
        ("excel", {}, "program must be one of slicer, .*; found 'excel'"),
        ("r", {"grid": "a.nii"}, "r takes the options n_points; found grid"),
        ("slicer", {"n_points": 2}, "n_points"),
        ("paraview", {"extent": -1.0}, "extent needs a positive number .* found -1.0"),
        ("paraview", {"n_steps": 1}, "n_steps"),
        ("scalismo", {"n_modes": 0}, "n_modes"),
        ("nifti", {"label": np.array(["a"] * 1500)}, "needs integers .* found <U1"),
        ("nifti", {}, "brain_01 was read from arrays, not from a volume: give a scan"),
        ("nifti", {"grid": "none.nii"}, "no file .*none.nii"),
    ],
)
def test_an_error_names_what_was_expected(study, tmp_path, program, options, words):
    with pytest.raises(ValueError, match=words):
        write_for(study, tmp_path / "out", program, **options)


@pytest.mark.parametrize("program", ["scalismo", "paraview"])
def test_programs_that_play_modes_need_some(study, tmp_path, program):
    nodes = {node.path: node.to_dataset(inherit=False) for node in study.subtree}
    del nodes["/pca"]
    with pytest.raises(ValueError, match="a study with /pca is needed"):
        write_for(xr.DataTree.from_dict(nodes), tmp_path, program)


def test_every_program_needs_a_registered_study(brains, tmp_path):
    for program in PROGRAMS:
        with pytest.raises(ValueError, match="a registered study is needed"):
            write_for(brains, tmp_path, program)


def test_a_grid_elsewhere_is_refused_with_the_position_of_the_surface(scans, tmp_path, caplog):
    _, study = scans
    far = AFFINE.copy()
    far[:3, 3] += 5000
    nibabel.save(nibabel.Nifti1Image(np.zeros((9, 9, 9), np.uint8), far), tmp_path / "far.nii")
    with pytest.raises(ValueError, match=r"no voxel of .*far.nii is inside scan_0, .* mm \(RAS\)"):
        write_for(study, tmp_path, "nifti", label=sides(study), grid=tmp_path / "far.nii")
    assert "cut off" not in caplog.text
    half = nibabel.Nifti1Image(np.zeros((14, 28, 28), np.uint8), AFFINE)
    nibabel.save(half, tmp_path / "half.nii")
    write_for(study, tmp_path, "nifti", label=sides(study), grid=tmp_path / "half.nii")
    assert "scan_0 is cut off: " in caplog.text
    assert f"% lie outside of {tmp_path / 'half.nii'}" in caplog.text


def test_the_command_exports_and_refuses_unknown_options(study_folder, study, tmp_path, capsys):
    out = str(tmp_path / "out")
    assert main(["export", str(study_folder), "--to", "slicer", "--out", out, "--points", "9"]) == 0
    assert "12 files for slicer" in capsys.readouterr().out
    points = read_landmarks(tmp_path / "out" / "points" / "brain_01.mrk.json")
    assert points.sizes["landmark"] == 9
    assert main(["export", str(study_folder), "--to", "r", "--out", out, "--modes", "2"]) == 2
    assert "s4a: r takes the options n_points; found n_modes" in capsys.readouterr().err
    grid = tmp_path / "grid.nii.gz"
    affine = np.diag([4.0, 4, 4, 1])
    affine[:3, 3] = -120
    nibabel.save(nibabel.Nifti1Image(np.zeros((60, 60, 60), np.uint8), affine), grid)
    template = study["registration"].attrs["template"]
    np.save(tmp_path / "ones.npy", np.full(study["original"][template].sizes["vertex"], 3))
    words = ["--labels", str(tmp_path / "ones.npy"), "--grid", str(grid)]
    assert main(["export", str(study_folder), "--to", "nifti", "--out", out, *words]) == 0
    found = np.asanyarray(nibabel.load(tmp_path / "out" / "brain_01.nii.gz").dataobj)
    assert np.unique(found).tolist() == [0, 3]
