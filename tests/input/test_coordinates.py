"""Coordinate systems: read from every format, converted in one place, refused where unknown."""

import gzip
import zlib
from base64 import b64encode
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from nibabel.gifti import GiftiCoordSystem, GiftiDataArray, GiftiImage, GiftiMetaData

import s4a
from s4a import read_mesh, read_shapes, write_mesh
from s4a.geometry.mesh import as_arrays, as_dataset, volume
from s4a.input.annotations import read_landmarks, write_landmarks
from s4a.input.chirality import in_file
from s4a.input.coordinates import CoordinateSystem, common, in_one_system, transform
from s4a.input.formats import vtk_bytes, vtp_bytes
from s4a.input.landmarks import locate
from s4a.schema import dataset, in_unit
from s4a.study.pair import pair_study

X, T = as_arrays(s4a.synthetic.sphere(200))
X = (X + 0.3 * np.exp(X * [1, -1, 1])) * [9, 6, 4]  # without symmetry
CRAS = np.array([12.0, -20, 35])
DIRECTIONS = np.array([[-1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # of a conformed volume
LIKE_SLICER = "3D Slicer output. SPACE={}"


def system(text, unit="mm"):
    return CoordinateSystem.of({"coordinate_system": text, "unit": unit})


def freesurfer(path, points=X, directions=DIRECTIONS, cras=CRAS, real=0, valid=1):
    info = {
        "head": np.array([2, 0, 20]), "valid": f"{valid}  # volume info valid",
        "filename": "../mri/orig.mgz", "volume": np.array([256] * 3), "voxelsize": np.ones(3),
        "xras": directions[0], "yras": directions[1], "zras": directions[2], "cras": cras,
    }  # fmt: skip
    nib.freesurfer.write_geometry(path, points, T, volume_info=info)
    flag = b"\0\0\0\2\0\0\0"  # useRealRAS
    path.write_bytes(path.read_bytes().replace(flag + b"\0\0\0", flag + bytes([real]) + b"\0\0"))
    return path


def gifti(path, spaces=(0, 0), matrix=None, sets=1, **meta):
    cs = GiftiCoordSystem(*spaces, np.eye(4) if matrix is None else matrix)
    image = GiftiImage()
    for _ in range(sets):
        points = X.astype(np.float32)
        intent, words = "NIFTI_INTENT_POINTSET", GiftiMetaData(meta)
        image.add_gifti_data_array(GiftiDataArray(points, intent, coordsys=cs, meta=words))
    triangles = T.astype(np.int32)
    image.add_gifti_data_array(GiftiDataArray(triangles, "NIFTI_INTENT_TRIANGLE"))
    nib.save(image, path)
    return path


def vtp(how):
    """A .vtp file with SPACE in its field data: ascii, in base64, or appended and by zlib."""
    text, values = b"LPS\0", vtp_bytes(X, T, {}).decode()
    kinds = {"ascii": " ".join(map(str, text)), "appended": ""}
    whole = np.array(len(text), "<u8").tobytes() + text
    kinds["binary"] = b64encode(whole).decode()
    at = 'offset="0" ' if how == "appended" else ""
    field = f'<Array type="String" Name="SPACE" NumberOfTuples="1" {at}format="{how}">'
    field = f"<FieldData>{field}{kinds[how]}</Array></FieldData>"
    values = values.replace("<PolyData>", f"<PolyData>{field}", 1)
    if how == "appended":
        end = f'<AppendedData encoding="raw">_{whole.decode("latin-1")}</AppendedData></VTKFile>'
        values = values.replace("</VTKFile>", end)
    return values.encode("latin-1")


def test_every_format_says_its_coordinate_system(tmp_path):
    moved = np.eye(4)
    moved[:3, 3] = CRAS
    axes = {f"VolGeom{a}_{b}": str(DIRECTIONS[i][j]) for i, a in enumerate("XYZ")
            for j, b in enumerate("RAS")}  # fmt: skip
    axes |= {f"VolGeomC_{b}": str(c) for b, c in zip("RAS", CRAS, strict=True)}
    surface = "surface RAS, c_ras 12 -20 35"
    known = {
        freesurfer(tmp_path / "a.pial"): surface,
        freesurfer(tmp_path / "b.pial", real=1): "scanner RAS",
        freesurfer(tmp_path / "c.pial", valid=0): "surface RAS",
        gifti(tmp_path / "a.gii"): "RAS, origin unknown",
        gifti(tmp_path / "b.gii", (1, 1)): "scanner RAS",
        gifti(tmp_path / "c.gii", (2, 4)): "RAS",
        gifti(tmp_path / "d.gii", (4, 4)): "MNI152 RAS",
        gifti(tmp_path / "k.gii", (3, 3), **axes): "RAS, origin unknown",  # of Workbench
        gifti(tmp_path / "e.gii", (0, 1), moved): surface,
        gifti(tmp_path / "f.gii", (0, 3), **axes): surface,
        gifti(tmp_path / "h.gii", (0, 1), moved, **axes): surface,
        gifti(tmp_path / "i.gii", (0, 1), np.eye(4), **axes): "RAS, origin unknown",  # two origins
        # of left-handed volumes: a mirror image
        gifti(tmp_path / "j.gii", (0, 1), np.diag([-1, 1, 1, 1])): "surface LAS, c_ras 0 0 0",
        freesurfer(tmp_path / "d.pial", directions=DIRECTIONS * [[-1], [1], [1]]): surface.replace(
            "RAS", "LAS", 1
        ),
    }
    files = {
        "a.vtk": (vtk_bytes(X, T, {}, LIKE_SLICER.format("LPS")), "LPS"),
        "b.vtk": (
            vtk_bytes(X, T, {}).replace(
                b"POLYDATA\n", b"POLYDATA\nFIELD FieldData 1\nSPACE 1 1 string\n\xc3LPS\n", 1
            ),
            "LPS",
        ),
        **{f"{how}.vtp": (vtp(how), "LPS") for how in ("ascii", "binary", "appended")},
        "a.obj": (b"# " + LIKE_SLICER.format("RAS").encode() + b"\nv 0 0 0\nv 1 0 0\nv 0 1 0\n"
                  b"f 1 2 3\n", "RAS"),
    }  # fmt: skip
    for name, (data, text) in files.items():
        (tmp_path / name).write_bytes(data)
        known[tmp_path / name] = text
    for path, text in known.items():
        points, _, attrs = read_mesh(path)
        assert (attrs["coordinate_system"], attrs["unit"]) == (text, "mm"), path.name
        if path.suffix != ".obj":
            assert points == pytest.approx(X, abs=1e-4), path.name
    image = nib.load(tmp_path / "a.gii")
    image.darrays[1].coordsys = GiftiCoordSystem(1, 1)  # of the triangles, which have none
    nib.save(image, tmp_path / "g.gii")
    assert read_mesh(tmp_path / "g.gii")[2]["coordinate_system"] == "RAS, origin unknown"
    with pytest.raises(ValueError, match=r"one set of points .* found 2 and 1: save each surface"):
        read_mesh(gifti(tmp_path / "two.gii", sets=2))
    metres = np.diag([1000, 1000, 1000, 1.0]) @ moved
    attrs = read_mesh(gifti(tmp_path / "m.gii", (0, 1), metres))[2]
    assert transform(CoordinateSystem.of(attrs), system("RAS")) == pytest.approx(metres)
    assert attrs["unit"] == "m"


def test_a_file_that_states_two_coordinate_systems_is_refused(tmp_path):
    field = b"POLYDATA\nFIELD FieldData 1\nSPACE 1 1 string\n\xc3LPS\n"
    data = vtk_bytes(X, T, {}, LIKE_SLICER.format("%s")).replace(b"POLYDATA\n", field, 1)
    files = {
        "a.vtk": data.replace(b"%s", b"RAS"),
        "a.vtp": vtp("ascii").replace(b"<VTKFile", b"<!-- SPACE=RAS --><VTKFile"),
        "a.csv": b"# SPACE=RAS\nname,l,p,s\na,1,2,3\n",
        "b.csv": b"coordinate_system,x,y,z\nRAS,1,2,3\nLPS,1,2,3\n",
        "c.csv": b"# SPACE=RAS\n# SPACE=LPS\nname,x,y,z\na,1,2,3\n",
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"one (SPACE|coordinate system) .* LPS and RAS"):
            (read_landmarks if "csv" in name else read_mesh)(tmp_path / name)
    (tmp_path / "a.vtk").write_bytes(data.replace(b"%s", b"LPS"))
    assert read_mesh(tmp_path / "a.vtk")[2]["coordinate_system"] == "LPS"
    both = with_matrix(gifti(tmp_path / "a.gii", (1, 1)), (4, 4), np.eye(4))
    with pytest.raises(ValueError, match="one DataSpace expected, found MNI_152 and SCANNER_ANAT"):
        read_mesh(both)


def with_matrix(path, spaces, matrix):
    """A GIFTI file with a second CoordinateSystemTransformMatrix of its points."""
    more, end = GiftiCoordSystem(*spaces, matrix).to_xml(), b"</CoordinateSystemTransformMatrix>"
    path.write_bytes(path.read_bytes().replace(end, end + more, 1))
    return path


def test_matrices_of_a_gifti_file_that_differ_leave_the_origin_unknown(tmp_path):
    moved, transposed = np.eye(4), np.eye(4)
    moved[:3, 3] = transposed[3, :3] = CRAS
    path = tmp_path / "a.gii"
    for more, text in (
        (((0, 4), np.eye(4)), "surface RAS, c_ras 12 -20 35"),  # to another space
        (((0, 1), moved), "surface RAS, c_ras 12 -20 35"),
        (((0, 1), np.eye(4)), "RAS, origin unknown"),
    ):
        found = with_matrix(gifti(path, (0, 1), moved), *more)
        assert read_mesh(found)[2]["coordinate_system"] == text
    found = read_mesh(gifti(path, (0, 1), transposed))[2]["coordinate_system"]
    assert found == "RAS, origin unknown"


def test_surface_ras_becomes_scanner_ras_for_any_direction_of_the_voxels(tmp_path):
    # FreeSurfer: scanner RAS = Norig inv(Torig) surface RAS, both of the voxels
    directions = DIRECTIONS @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    voxels, size = np.array([256, 200, 180]), np.array([1.0, 0.8, 1.2])
    norig, torig = np.eye(4), np.eye(4)
    for affine, rows, centre in ((norig, directions, CRAS), (torig, DIRECTIONS, np.zeros(3))):
        affine[:3, :3] = np.transpose(rows) * size
        affine[:3, 3] = centre - affine[:3, :3] @ (voxels / 2)
    attrs = read_mesh(freesurfer(tmp_path / "a.pial", directions=directions))[2]
    M = transform(CoordinateSystem.of(attrs), CoordinateSystem("RAS", "scanner", "mm"))
    assert pytest.approx(norig @ np.linalg.inv(torig), abs=1e-6) == M


def test_two_known_systems_are_converted_and_back():
    texts = ["RAS", "LPS", "PIR", "LAS", "scanner RAS", "surface RAS, c_ras 1.5 -20 35"]
    P = np.c_[X[:5], np.ones(5)]
    for a in texts:
        for b in texts:
            there, back = transform(system(a), system(b, "m")), transform(system(b, "m"), system(a))
            assert P @ there.T @ back.T == pytest.approx(P)
    assert (transform(system("RAS"), system("LPS", "cm")) @ [10, 20, 30, 1])[:3].tolist() == [
        -1, -2, 3]  # fmt: skip
    assert np.linalg.det(transform(system("RAS"), system("LAS"))) < 0


def test_what_is_unknown_is_not_converted():
    unknown = [("", ""), ("RAS", ""), ("", "mm"), ("RAS, origin unknown", "mm"),
               ("surface RAS", "mm"), ("MNI152 RAS", "mm")]  # fmt: skip
    scanner = system("scanner RAS")
    for text, unit in unknown:
        assert transform(system(text, unit), scanner) is None
        assert transform(system(text, unit), system(text, unit)).tolist() == np.eye(4).tolist()
        with pytest.raises(ValueError, match=r"scanner RAS, mm: a; .*: b: set coordinate_system="):
            common({"a": scanner, "b": system(text, unit)}, origin=True)
    assert transform(system("MNI152 RAS"), system("LPS")) is not None  # of Slicer: any image
    filled = [system(text, unit).filled(system("scanner RAS")) for text, unit in unknown[:4]]
    assert {str(one) for one in filled} == {"scanner RAS, mm", "RAS, mm"}
    with pytest.raises(ValueError, match=r"one coordinate system of RAS, .* needed, found 'RAR'"):
        system("RAR")


def test_a_mesh_is_converted_with_its_landmarks_and_faces_outward():
    mesh = as_dataset(X, T, {"coordinate_system": "LAS", "unit": "m", "area": 2.0})
    mesh = s4a.with_landmarks(
        in_unit(mesh, "m"), dataset(landmark_name=["a"], landmark_position=X[:1])
    )
    ras = as_dataset(X, T, {"coordinate_system": "RAS", "unit": "mm"})
    found = in_one_system({"a": ras, "b": ras, "c": mesh})["c"]
    assert found["position"].values == pytest.approx(X * [-1000, 1000, 1000])
    assert found["guide_position"].values == pytest.approx(found["position"].values[:1])
    assert found["position"].attrs["units"] == "mm"
    assert found.attrs["area"] == pytest.approx(2e6)
    assert volume(found["position"].values, found["corner_vertex"].values) > 0
    assert "converted from LAS, m to RAS, mm" in found.attrs["reason"]
    assert in_file(found, found["position"].values) == pytest.approx(X)
    assert in_file(found, X, back=True) == pytest.approx(X * [-1000, 1000, 1000])


def test_a_collection_is_converted_or_told_what_is_missing(tmp_path):
    meshes = {f"s{i}": as_dataset(X * [-1, -1, 1] if i == 2 else X, T) for i in range(3)}
    for name, text in {"s0": "RAS", "s1": "RAS", "s2": "LPS"}.items():
        meshes[name].attrs |= system(text).attrs
    tree = read_shapes(meshes, compare=False)
    assert tree["original/s2/position"].values == pytest.approx(X)
    assert tree["report/coordinate_system"].values.tolist() == ["RAS, mm", "RAS, mm", "LPS, mm"]
    write_mesh(tmp_path / "s2.ply", X, T)
    with pytest.raises(ValueError, match=r"RAS, mm: s0, s1; unknown: s2: set coordinate_system="):
        s4a.analyse(meshes | {"s2": tmp_path / "s2.ply"})
    with pytest.raises(ValueError, match="RAS, mm: source; unknown: target: set coordinate_system"):
        s4a.match_pair(meshes["s0"], tmp_path / "s2.ply")
    with pytest.raises(ValueError, match="unit must be one of um, mm, cm, m, in; found 'inch'"):
        s4a.analyse(meshes, unit="inch")


def test_a_study_of_files_in_two_systems_is_that_of_files_in_one(tmp_path):
    brains = s4a.synthetic.brains(3, 200)["original"]
    options = {"n_coarse": 100, "k": 10, "k_init": 6, "quality_control": "off"}
    score, remarks = [], []
    for folder, texts in {"one": ["RAS"] * 3, "two": ["RAS", "RAS", "LPS"]}.items():
        (tmp_path / folder).mkdir()
        for (name, mesh), text in zip(brains.items(), texts, strict=True):
            Y = mesh["position"].values * ([-1, -1, 1] if text == "LPS" else 1)
            faces = mesh["corner_vertex"].values
            write_mesh(tmp_path / folder / f"{name}.vtk", Y, faces, coordinate_system=text)
        study = s4a.analyse(tmp_path / folder, **options)
        score.append(study["pca/score"].values)
        remarks.append(study["report"].attrs["remarks"])
    assert score[0] == pytest.approx(score[1], abs=1e-9)
    assert "1 of 3 shapes were converted to RAS: brain_03 (LPS)" in remarks[1]
    assert "converted" not in remarks[0]
    labels = []
    for text, flip in (("RAS", [1, 1, 1]), ("LAS", [-1, 1, 1])):  # an external source
        mesh = brains["brain_02"].to_dataset()
        turned = mesh["corner_vertex"].values[:, :: 1 if text == "RAS" else -1]
        source = as_dataset(mesh["position"].values * flip, turned, system(text, "").attrs)
        found = s4a.transfer_labels(study, mesh["label"].values, source=source)
        labels.append(found["brain_01/label"].values)
    assert (labels[0] == labels[1]).all()


def test_a_pair_and_its_study_have_one_coordinate_system():
    ras = as_dataset(X, T, system("RAS").attrs)
    lps = as_dataset(X * [-1, -1, 1], T, system("LPS").attrs)
    result = s4a.match_pair(ras, lps, n_coarse=100, k=10, k_init=6)
    found = s4a.correspondence(pair_study(result, ras, lps), "source", "target")
    assert found["image_position"].values == pytest.approx(X, abs=1e-6)
    las = as_dataset(X * [-1, 1, 1], T[:, ::-1], system("LAS").attrs)
    table = s4a.compare(ras, las, methods=["kNN"], n_coarse=100, k=10, k_init=6)
    assert table["chamfer"].item() == pytest.approx(0, abs=1e-9)


def test_landmarks_lie_on_the_surface_whatever_the_two_files_say(tmp_path):
    def marks(text, points, unit="mm"):
        return dataset(system(text, unit).attrs, landmark_name=list("abcd"),
                       landmark_position=points[[3, 40, 90, 150]])  # fmt: skip

    surface = as_dataset(X, T, read_mesh(freesurfer(tmp_path / "a.pial"))[2])
    cases = [
        (marks("LPS", (X + CRAS) * [-1, -1, 1]), surface),  # as Slicer has them of the scan
        (marks("", X, ""), surface),
        (marks("", X + CRAS, ""), surface),  # of FreeView: reported
        (marks("LPS", X), as_dataset(X, T)),
        (marks("LPS", X * [-1, -1, 1]), as_dataset(X, T)),
        (marks("RAS", X / 10, "cm"), as_dataset(X, T, system("RAS").attrs)),
    ]
    for points, mesh in cases:
        assert locate(points, mesh)["landmark_distance"].values == pytest.approx(0, abs=1e-4)
    with pytest.raises(ValueError, match="RAS, LPS"):
        locate(marks("RAS", X * [-1, -1, 1]), as_dataset(X, T, system("RAS").attrs), farthest=1e-3)


HEAD = "# Markups fiducial file version = 4.11\n"
MARKUPS = '{"markups": [{"coordinateSystem": %s, "controlPoints": [%s]}]}'
COLUMNS = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
FCSV = "n_{0},{1},{2},{3},0,0,0,1,1,1,0,{4},,\n"


def test_landmarks_that_fit_a_mesh_in_two_directions_are_reported(caplog):
    points = {"landmark_name": list("ab"), "landmark_position": X[[3, 40]]}
    both = as_dataset(np.r_[X, X * [-1, -1, 1]], np.r_[T, T + len(X)])
    locate(dataset(system("LPS").attrs, **points), both)
    assert "and a mesh in RAS with" in caplog.text
    caplog.clear()
    locate(dataset(system("LPS").attrs, **points), as_dataset(X, T))
    assert not caplog.text


def test_a_landmark_file_that_states_the_wrong_system_is_reported(caplog):
    both = as_dataset(np.r_[X, 1.08 * X * [-1, -1, 1]], np.r_[T, T + len(X)])  # fits in both
    both = both.assign_attrs(system("RAS").attrs, path="a.ply")
    for axes in ("RAS", "LPS"):
        points = {"landmark_name": list("ab"), "landmark_position": X[[3, 40]]}
        found = locate(dataset(system(axes).attrs, **points), both)
        assert (
            "a.ply: the coordinate system of the landmarks or of the mesh may be wrong"
            in (caplog.text)
        ) == (axes == "LPS")
    assert found["landmark_distance"].values.max() > 0.1  # as stated, nevertheless


def test_landmark_files_of_other_programs_are_read(tmp_path, caplog):
    P, names = np.array([[1.5, 2, 3], [-4, 5.25, 6]]), ["a", "b"]
    rows = list(zip(range(2), *P.T.tolist(), names, strict=True))
    fcsv = "".join(FCSV.format(*row) for row in rows)
    plain = "".join("{1} {2} {3}\n".format(*row) for row in rows)
    named = "".join("{4} {1} {2} {3}\n".format(*row) for row in rows)
    csv = "".join("{4},{1},{2},{3},{5},1\n".format(*row, int(row[0] < 2)) for row in rows)
    files = {
        "lps.fcsv": (f"{HEAD}# CoordinateSystem = LPS\n{COLUMNS}{fcsv}", "LPS", names),
        "one.fcsv": (f"{HEAD}# CoordinateSystem = 1\n{COLUMNS}{fcsv}", "LPS", names),
        "five.fcsv": (  # of 3D Slicer 5: 2 for a position, 0, 1 and 3 for none
            HEAD + "# CoordinateSystem = LPS\n" + COLUMNS + fcsv.replace("\n", ",2,0\n")
            + "".join(FCSV.format(i, 0, 0, 0, "c").replace("\n", f",{i},0\n") for i in (0, 1, 3)),
            "LPS", names),
        "stated.csv": (f"# SPACE=LPS UNIT=mm\nlabel,x,y,z,defined,selected\n{csv}", "LPS", names),
        "units.mrk.json": (MARKUPS % ('"1", "coordinateUnits": ["mm", "UCUM", "millimeter"]',
            ", ".join(f'{{"label": "{n}", "position": {p}}}'
                      for n, p in zip(names, P.tolist(), strict=True))), "LPS", names),
        "set.json": (MARKUPS % ('"LPS"', ", ".join(
            f'{{"position": {p}, "positionStatus": "{s}"}}' for s, p in (
                ("preview", [0] * 3), ("defined", P[0].tolist()),
                ("missing", [0] * 3), ("defined", P[1].tolist())))), "LPS", ["2", "4"]),
        "index.csv": (",x,y,z\na,1.5,2,3\nb,-4,5.25,6\n", "", names),
        "plain.csv": ("a 1.5 2 3\nb -4 5.25 6\n", "", names),
        "a.pp": ('<!DOCTYPE PickedPoints><PickedPoints><point x="1.5" y="2" z="3" name="a"/>'
                 '<point name="b" x="-4" y="5.25" z="6" active="1"/>'
                 '<point x="0" y="0" z="0" name="c" active="0"/></PickedPoints>', "", names),
        "unit.csv": ("name,x,y,z,unit,coordinate_system\na,1.5,2,3,mm,LPS\nb,-4,5.25,6,,\n",
                     "LPS", names),
        "old.fcsv": (f"{HEAD}# CoordinateSystem = 0\n{COLUMNS}{fcsv}", "RAS", names),
        "lps.csv": (f"label,l,p,s,defined,selected\n{csv}c,0,0,0,0,1\n", "LPS", names),
        "ras.csv": (f"label,r,a,s,defined,selected\n{csv}", "RAS", names),
        "a.tps": (f"LM3=2\n{plain}ID=x\n", "", ["1", "2"]),
        "scaled.tps": (f"LM3=2\n{plain}SCALE=1.0\n", "", ["1", "2"]),
        "two.tps:x": (f"LM3=2\n{plain}ID=x\n\nLM3=1\n0 0 0\nID=y\n", "", ["1", "2"]),
        "a.pts": (f"Version 1.0\n2\n{named}", "", names),
        "b.pts": (f"version: 1\nn_points:  2\n{{\n{plain}}}\n", "", ["1", "2"]),
        "a.json": (
            str([{"id": n, "coordinates": p} for n, p in zip(names, P.tolist(), strict=True)])
            .replace("'", '"'), "", names),
    }  # fmt: skip
    for name, (text, axes, expected) in files.items():
        (tmp_path / name.partition(":")[0]).write_text(text)
        found = read_landmarks(tmp_path / name)
        assert found["landmark_position"].values == pytest.approx(P), name
        assert found["landmark_name"].values.tolist() == expected, name
        assert found.attrs == (system(axes).attrs if axes else {}), name
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress((tmp_path / "index.csv").read_bytes()))
    assert read_landmarks(tmp_path / "a.csv.gz")["landmark_position"].values == pytest.approx(P)
    left_out = [record.getMessage().rpartition(": ")[::2] for record in caplog.records]
    assert [(Path(text.partition(":")[0]).name, names) for text, names in left_out] == [
        ("five.fcsv", "c, c, c"), ("set.json", "1, 3"), ("a.pp", "c"), ("lps.csv", "c"),
    ]  # fmt: skip
    wrong = {
        "two.tps": "one specimen needed, found x, y: choose one as FILE.tps:x",
        "a.tps": "2 points needed, found 1",
        "a.pts": "3 points needed, found 2",
        "lps.fcsv": "found 'XYZ'",
    }
    (tmp_path / "a.tps").write_text("LM=2\n1 2\nID=x\n")
    (tmp_path / "a.pts").write_text(f"Version 1.0\n3\n{plain}")
    (tmp_path / "lps.fcsv").write_text(f"# CoordinateSystem = XYZ\n{COLUMNS}{fcsv}")
    point = '{"position": [1, 2, 3], "coordinateSystem": "RAS"}'
    (tmp_path / "a.mrk.json").write_text(MARKUPS % ('"LPS"', point))
    (tmp_path / "b.json").write_text("{}")
    (tmp_path / "twice.csv").write_text("name,x,y,z,x,y,z\na,1,2,3,4,5,6\n")
    wrong["b.json"] = "'markups' expected, found none"
    wrong["twice.csv"] = "the columns name, x, y and z needed, found name, x, y, z, x, y, z"
    wrong["a.mrk.json"] = "one coordinate system expected, found LPS and RAS"
    for name, words in wrong.items():
        with pytest.raises(ValueError, match=words):
            read_landmarks(tmp_path / name)


def test_a_written_mesh_lies_where_the_scan_has_it(tmp_path):
    given = {
        "RAS": X, "LPS": X * [-1, -1, 1], "LAS": X * [-1, 1, 1],
        "surface RAS, c_ras 12 -20 35": X - CRAS,
    }  # fmt: skip
    for text, points in given.items():
        triangles = T[:, ::-1] if text == "LAS" else T
        for end in ("ply", "obj", "off", "stl", "vtk", "vtp", "gii"):
            path = tmp_path / f"a.{end}"
            write_mesh(path, points / 10, triangles, coordinate_system=text, unit="cm")
            Y, S, attrs = read_mesh(path)
            M = transform(CoordinateSystem.of(attrs), system("RAS"))
            scan = Y @ M[:3, :3].T + M[:3, 3]
            assert np.sort(scan, 0) == pytest.approx(np.sort(X, 0), abs=1e-4), (text, end)
            S = S[:, ::-1] if np.linalg.det(M) < 0 else S
            assert volume(scan, S) == pytest.approx(volume(X, T), rel=1e-5), (text, end)
        image = nib.load(tmp_path / "a.gii")
        assert image.agg_data("pointset") == pytest.approx(X, abs=1e-4)
    for text in ("RAS", "scanner RAS", "MNI152 RAS", "RAS, origin unknown"):  # the origin is kept
        for end in ("ply", "stl", "vtp", "gii"):
            write_mesh(tmp_path / f"a.{end}", X, T, coordinate_system=text, unit="mm")
            assert read_mesh(tmp_path / f"a.{end}")[2]["coordinate_system"] == text, end


def test_an_unknown_unit_or_system_is_an_error_of_the_options():
    for given in ({"unit": "inch"}, {"coordinate_system": "tkRAS"}):
        with pytest.raises(ValueError, match=r"^(unit must be one of|one coordinate system of)"):
            read_shapes({"a": (X, T)}, **given)


def test_written_markups_lie_where_the_scan_has_them(tmp_path):
    for text, unit, factor in (("surface RAS, c_ras 12 -20 35", "mm", 1), ("PIR", "m", 0.001)):
        own = system(text, unit)
        M = transform(system("scanner RAS"), own)
        given = X[:3] @ M[:3, :3].T + M[:3, 3]
        marks = dataset(own.attrs, landmark_name=list("abc"), landmark_position=given)
        write_landmarks(tmp_path / "a.mrk.json", marks)
        found = read_landmarks(tmp_path / "a.mrk.json")
        assert found.attrs == system("RAS").attrs
        assert found["landmark_position"].values == pytest.approx(X[:3])
        assert np.linalg.det(M[:3, :3]) == pytest.approx(factor**3)


def test_the_command_prints_the_system_of_each_file(tmp_path, capsys):
    freesurfer(tmp_path / "a.pial")
    write_mesh(tmp_path / "b.vtk", X, T, coordinate_system="LPS", unit="mm")
    write_mesh(tmp_path / "c.ply", X, T)
    from s4a.cli import main

    assert main(["check", str(tmp_path)]) == 2  # as a run
    out, error = capsys.readouterr()
    assert "set --coordinate-system and --unit for files that lack them" in error
    assert "surface RAS, c_ras 12 -20 35, mm" in out
    assert "LPS, mm" in out
    assert "needed, found" in " ".join(out.split())
    assert main(["check", str(tmp_path), "--coordinate-system", "RAS", "--unit", "mm"]) == 0
    assert "found" not in capsys.readouterr().out


def test_a_compressed_field_is_read(tmp_path):
    text = b"LPS\0"
    packed = zlib.compress(text)
    sizes = np.array([1, len(text), 0, len(packed)], "<u8").tobytes()
    field = (
        '<FieldData><Array type="String" Name="SPACE" format="binary">'
        f"{b64encode(sizes).decode()}{b64encode(packed).decode()}</Array></FieldData>"
    )
    from s4a.input.formats import VtkXml

    head = '<VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt64" '
    file = f'{head}compressor="vtkZLibDataCompressor"><PolyData>{field}</PolyData></VTKFile>'
    assert VtkXml(file.encode()).strings("SPACE")[0] == "LPS"
