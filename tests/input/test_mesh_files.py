import itertools
import struct

import fuzz
import nibabel
import numpy as np
import pytest
from paths import DATA, DOCS

from s4a.input.files import (
    WITH_VALUES,
    WRITERS,
    find_meshes,
    not_meshes,
    read_mesh,
    slug,
    write_mesh,
)
from s4a.input.formats import FORMATS
from s4a.input.polygons import triangulated

X = np.array([[0, 0, 0], [1.5, 0, 0], [1.5, 2, 0], [0, 2, 0], [0.25, 0.5, 3]])
T = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


def same_surface(path, points=X, triangles=T):
    result, corners, attrs = read_mesh(path)
    assert result.dtype == np.float64
    assert corners.dtype == np.int32
    np.testing.assert_array_equal(result[corners], points[triangles])
    return attrs


def file(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_written_mesh_comes_back(tmp_path, suffix):
    write_mesh(tmp_path / f"m{suffix}", X, T)
    same_surface(tmp_path / f"m{suffix}")


def test_text_formats_keep_every_digit(tmp_path):
    points = X + np.random.default_rng(0).random(X.shape)
    for name in ("m.obj", "m.off"):
        write_mesh(tmp_path / name, points, T)
        same_surface(tmp_path / name, points)


def test_scalars_are_written_where_the_format_holds_them(tmp_path):
    height = X[:, 2]
    for suffix in WITH_VALUES:
        write_mesh(tmp_path / f"m{suffix}", X, T, height=height)
        same_surface(tmp_path / f"m{suffix}")
    np.testing.assert_array_equal(nibabel.load(tmp_path / "m.gii").darrays[2].data, height)
    with np.load(tmp_path / "m.npz") as arrays:
        np.testing.assert_array_equal(arrays["height"], height)
    with pytest.raises(ValueError, match=r"cannot hold values"):
        write_mesh(tmp_path / "m.stl", X, T, height=height)
    with pytest.raises(ValueError, match=r"each of the 5 vertices"):
        write_mesh(tmp_path / "m.ply", X, T, height=height[:3])


def ply(order, quads=False):
    """A file with extra vertex and face properties, an element before and, with `quads`.

    Faces of mixed size.
    """
    head = f"ply\nformat {order} 1.0\ncomment SPACE=LPS\nelement camera 1\nproperty float view\n"
    head += (
        f"element vertex {len(X)}\nproperty uchar red\nproperty double x\nproperty double y\n"
        "property double z\n"
    )
    faces = [[0, 3, 2, 1], *T[2:].tolist()] if quads else T.tolist()
    head += (
        f"element face {len(faces)}\nproperty uchar flag\nproperty list uchar int vertex_index\n"
    )
    head += "property list uchar float uv\nend_header\n"
    if order == "ascii":
        rows = ["0.5", *(f"7 {x} {y} {z}" for x, y, z in X)]
        rows += [f"1 {len(f)} {' '.join(map(str, f))} 2 0.5 0.5" for f in faces]
        return (head + "\n".join(rows) + "\n").encode()
    end = "<" if "little" in order else ">"
    body = struct.pack(end + "f", 0.5) + b"".join(struct.pack(end + "B3d", 7, *x) for x in X)
    for f in faces:
        body += struct.pack(f"{end}BB{len(f)}iB2f", 1, len(f), *f, 2, 0.5, np.nan)
    return head.encode() + body


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("quads", [False, True])
def test_ply_is_read_with_other_properties_and_polygons(tmp_path, order, quads):
    expected = np.vstack([[[0, 3, 2], [0, 2, 1]], T[2:]]) if quads else T
    assert (
        same_surface(file(tmp_path, "m.ply", ply(order, quads)), X, expected)["coordinate_system"]
        == "LPS"
    )


def test_obj_is_read_with_textures_negative_indices_and_quads(tmp_path):
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in X)
    text = (
        "# a comment\nmtllib a.mtl\n"
        + vertices
        + "vt 0 0\nvn 0 0 1\ng part\nf 1/1/1 4/1/1 3/1/1 2/1/1\n"
    )
    text += "f 1//1 2//1 5//1\nf 2/1 3/1 5/1\nf -3 -2 \\\n -1\nf 4 1 5\n"
    same_surface(file(tmp_path, "m.obj", text), X, np.vstack([[[0, 3, 2], [0, 2, 1]], T[2:]]))


@pytest.mark.parametrize("head", ["OFF\n# made by hand\n5 5 0\n", "OFF 5 5 0\n", "OFF5 5 0\n"])
def test_off_is_read_with_comments_and_polygons(tmp_path, head):
    faces = "4 0 3 2 1 255 0 0\n3 0 1 4\n3 1 2 4\n\n3 2 3 4 0.5 # red\n3 3 0 4\n"
    text = head + "".join(f"{x} {y} {z}\n" for x, y, z in X) + faces
    same_surface(file(tmp_path, "m.off", text), X, np.vstack([[[0, 3, 2], [0, 2, 1]], T[2:]]))


def test_off_with_colours_and_normals_gives_the_positions(tmp_path):
    faces = "".join(f"3 {a} {b} {c}\n" for a, b, c in T)
    for kind, extra in (("COFF", "255 0 0 255"), ("NOFF", "0 0 1"), ("CNOFF", "0 0 1 255 0 0 255")):
        text = f"{kind}\n5 6 0\n" + "".join(f"{x} {y} {z} {extra}\n" for x, y, z in X) + faces
        same_surface(file(tmp_path, "m.off", text))


def test_a_binary_stl_may_begin_with_solid(tmp_path):
    write_mesh(tmp_path / "b.stl", X, T)
    binary = (tmp_path / "b.stl").read_bytes()
    same_surface(file(tmp_path, "c.stl", b"solid".ljust(80) + binary[80:]))
    assert len(read_mesh(tmp_path / "c.stl")[0]) == len(X)


VTK_HEAD = "# vtk DataFile Version {}\n3D Slicer output. SPACE=RAS\n{}\nDATASET POLYDATA\n"


def test_vtk_is_read_as_text_with_quads_and_metadata(tmp_path):
    text = VTK_HEAD.format("4.2", "ASCII") + "POINTS 5 float\n" + " ".join(map(str, X.ravel()))
    text += "\nMETADATA\nINFORMATION 1\nNAME L2_NORM LOCATION vtkDataArray\nDATA 2 0 1\n\n"
    text += (
        "VERTICES 1 2\n1 0\nPOLYGONS 5 21\n4 0 3 2 1\n3 0 1 4\n3 1 2 4\n3 2 3 4\n3 3 0 4\n\n"
        "POINT_DATA 5\n"
    )
    attrs = same_surface(
        file(tmp_path, "m.vtk", text), X, np.vstack([[[0, 3, 2], [0, 2, 1]], T[2:]])
    )
    assert attrs == {"format": "VTK", "coordinate_system": "RAS", "unit": "mm"}


def test_binary_vtk_5_is_read_with_offsets(tmp_path):
    head = VTK_HEAD.format("5.1", "BINARY") + "POINTS 5 double\n"
    data = head.encode() + X.astype(">f8").tobytes() + b"\nPOLYGONS 7 18\nOFFSETS vtktypeint64\n"
    data += (np.arange(7) * 3).astype(">i8").tobytes() + b"\nCONNECTIVITY vtktypeint64\n"
    same_surface(file(tmp_path, "m.vtk", data + T.astype(">i8").tobytes() + b"\n"))


# a prism over a letter: concave at (20, 20), with a corner on a straight side, of area 8,800
OUTLINE = np.array([[0, 0], [60, 0], [60, 20], [20, 20], [20, 60], [0, 60], [0, 30.0]])


def prism(roll, lift=0.0):
    """Vertices and polygons of a prism, whose first corners are chosen by `roll`."""
    n = len(OUTLINE)
    points = np.r_[np.c_[OUTLINE, np.zeros(n)], np.c_[OUTLINE, np.full(n, 20.0)]]
    points[4, 2] -= lift  # then five polygons are not planar
    sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    faces = [list(range(n))[::-1], list(range(n, 2 * n)), *sides]
    return points, [[*face[roll % len(face) :], *face[: roll % len(face)]] for face in faces]


def polygon_files(points, faces):
    """The prism in every format with polygons."""
    rows = "\n".join("{} {} {}".format(*x) for x in points)
    counted = "\n".join(f"{len(f)} {' '.join(map(str, f))}" for f in faces)
    n, size = len(points), sum(map(len, faces))
    flat = " ".join(str(i) for f in faces for i in f)
    ends = " ".join(map(str, np.cumsum([len(f) for f in faces])))
    obj = "v " + rows.replace("\n", "\nv ") + "\n"
    yield "a.obj", obj + "".join(f"f {' '.join(str(i + 1) for i in f)}\n" for f in faces)
    yield "a.off", f"OFF\n{n} {len(faces)} 0\n{rows}\n{counted}\n"
    head = f"ply\nformat ascii 1.0\nelement vertex {n}\nproperty double x\nproperty double y\n"
    head += f"property double z\nelement face {len(faces)}\n"
    yield "a.ply", f"{head}property list uchar int vertex_indices\nend_header\n{rows}\n{counted}"
    head = VTK_HEAD.format("3.0", "ASCII") + f"POINTS {n} double\n{rows}\nPOLYGONS {len(faces)} "
    yield "a.vtk", f"{head}{size + len(faces)}\n{counted}\n"
    array = '<DataArray type="{}" Name="{}" format="ascii">{}</DataArray>'.format
    polys = array("Int64", "connectivity", flat) + array("Int64", "offsets", ends)
    yield (
        "a.vtp",
        f'<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="{n}" NumberOfPolys='
        f'"{len(faces)}"><Points>{array("Float64", "Points", rows)}</Points><Polys>{polys}'
        "</Polys></Piece></PolyData></VTKFile>",
    )


def area_and_volume(points, triangles):
    a, b, c = points[triangles].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2, (a * np.cross(b, c)).sum() / 6


def test_area_and_volume_do_not_depend_on_the_first_corner_of_a_polygon(tmp_path):
    for lift, expected in ((0.0, (8800, 40_000)), (5.0, None)):
        for roll in range(7):
            for name, content in polygon_files(*prism(roll, lift)):
                points, triangles, attrs = read_mesh(file(tmp_path, name, content))
                found = area_and_volume(points, triangles)
                expected = expected or found
                np.testing.assert_allclose(found, expected, rtol=1e-12, err_msg=f"{name} {roll}")
                assert len(triangles) == 24
                assert "note" not in attrs


def test_any_simple_polygon_is_covered_once():
    rng = np.random.default_rng(0)
    angle, radius = np.linspace(6, 20, 20), np.array([[0.0], [1.5]])
    arms = np.stack([(angle + radius) * np.cos(angle), (angle + radius) * np.sin(angle)], axis=2)
    tenths = np.arange(20) * np.pi / 10
    hole = [[0, 0], [1, 1], [1, 3], [3, 3], [3, 1], [1, 1]]
    outlines = {
        "spiral": np.r_[arms[0], arms[1][::-1]],
        "star": np.tile([3, 0.6], 10)[:, None] * np.c_[np.cos(tenths), np.sin(tenths)],
        "cut to a hole": [[0, 0], [4, 0], [4, 4], [0, 4], *hole],
        "repeated corner": [[0, 0], [1, 0], [2, 0], [2, 0], [2, 2], [1, 0.5], [0, 2]],
        "no area": [[0, 0], [1, 0], [2, 0], [3, 0], [3, 0]],
    }
    for name, outline in outlines.items():
        x, y = np.array(outline, float).T
        expected = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        points = np.c_[x, y, 0 * x] @ turn + 5
        n = len(x)
        for roll in range(0, n, 3):
            T, n_crossing = triangulated(points, np.roll(np.arange(n), roll), np.array([n]))
            assert area_and_volume(points, T)[0] == pytest.approx(abs(expected), abs=1e-9), name
            assert (len(T), n_crossing) == (n - 2, 0)


def test_a_polygon_that_intersects_itself_is_reported(tmp_path):
    text = "OFF\n4 1 0\n0 0 0\n2 2 0\n2 0 0\n0 1 0\n4 0 1 2 3\n"
    assert "1 polygons intersect themselves" in read_mesh(file(tmp_path, "a.off", text))[2]["note"]


def test_triangle_strips_are_read(tmp_path):
    rows = "\n".join("{} {} {}".format(*x) for x in X)
    expected = [[0, 1, 2], [3, 2, 1], [2, 3, 4], [0, 4, 1]]
    head = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
    head += "property float z\nelement tristrips 1\nproperty list int int vertex_indices\n"
    vtk = f"{VTK_HEAD.format('3.0', 'ASCII')}POINTS 5 float\n{rows}\nTRIANGLE_STRIPS 2 10\n"
    array = '<DataArray type="{}" Name="{}" format="ascii">{}</DataArray>'.format
    cells = array("Int64", "connectivity", "0 1 2 3 4 0 4 1") + array("Int64", "offsets", "5 8")
    vtp = '<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="5" NumberOfStrips="2">'
    vtp += f"<Points>{array('Float64', 'Points', rows)}</Points><Strips>{cells}</Strips></Piece>"
    files = {
        "a.ply": f"{head}end_header\n{rows}\n9 0 1 2 3 4 -1 0 4 1\n",
        "a.vtk": f"{vtk}5 0 1 2 3 4\n3 0 4 1\n",
        "a.vtp": f"{vtp}</PolyData></VTKFile>",
    }
    for name, content in files.items():
        same_surface(file(tmp_path, name, content), X, np.array(expected))


SEEDS = fuzz.seeds()
MESHES = [name for name, (_, kind, _) in SEEDS.items() if kind == "mesh" and name != "gzip"]


def wholes(name):
    """Valid files of a format, from which damaged ones are made."""
    return [finish(content) for content, finish in SEEDS[name][2] if finish is fuzz.whole]


def test_every_format_is_documented_and_has_damaged_files():
    assert set(FORMATS) <= set(SEEDS)
    table = (DOCS / "formats.md").read_text(encoding="utf-8").split("\n## ")[1]
    rows = [line.split(" | ") for line in table.splitlines() if "`." in line]
    documented = [(row[1].split("`")[1], row[3][:3] == "yes", "yes" in row[4]) for row in rows]
    formats = FORMATS.values()
    declared = [(kind.suffixes.split()[0], bool(kind.write), kind.scalars) for kind in formats]
    assert sorted(documented) == sorted(declared)


@pytest.mark.parametrize("name", MESHES)
def test_every_encoding_of_a_format_gives_the_same_surface(tmp_path, name):
    points, triangles = fuzz.surface()
    for content in wholes(name):
        result, corners, attrs = read_mesh(file(tmp_path, f"m{SEEDS[name][0]}", content))
        np.testing.assert_allclose(result[corners], points[triangles], atol=1e-6)
        system = {"GIFTI": "RAS, origin unknown", "FreeSurfer": "surface RAS", "MNI": "RAS"}.get(
            name
        )
        known = {"coordinate_system": system, "unit": "mm"} if system else {}
        assert attrs == {"format": name} | known


@pytest.mark.parametrize(
    "keys", ["V F", "vertices faces", "points triangles", "position corner_vertex", "X T"]
)
def test_npz_is_read_by_any_of_its_keys(tmp_path, keys):
    np.savez(tmp_path / "m.npz", **dict(zip(keys.split(), (X, T), strict=True)))
    same_surface(tmp_path / "m.npz")


def test_the_content_counts_and_not_the_name(tmp_path):
    attrs = same_surface(file(tmp_path, "m.stl", ply("binary_little_endian")))
    assert attrs["format"] == "PLY"
    assert attrs["note"] == "named .stl but read as PLY by its content; rename the file"


def test_a_file_cut_anywhere_is_refused_with_its_name(tmp_path):
    for whole in itertools.chain.from_iterable(map(wholes, set(MESHES) - {"OBJ"})):
        for length in range(0, len(whole) - 100, max(1, len(whole) // 50)):
            with pytest.raises(ValueError, match=r"cut\.mesh"):
                read_mesh(file(tmp_path, "cut.mesh", whole[:length]))


def test_counts_beyond_the_file_are_named(tmp_path):
    write_mesh(tmp_path / "m.stl", X, T)
    stl = (tmp_path / "m.stl").read_bytes()
    promise = {
        "a.ply": ply("binary_little_endian").replace(
            b"element vertex 5", b"element vertex 4000000000"
        ),
        "b.ply": ply("ascii").replace(b"element face 6", b"element face 4000000000"),
        "c.off": b"OFF\n5 4000000000 0\n0 0 0\n",
        "d.stl": b"x".ljust(80) + struct.pack("<I", 4_000_000_000) + stl[84:],
        "e.vtk": (VTK_HEAD.format("3.0", "ASCII") + "POINTS 4000000000 float\n0 0 0\n").encode(),
    }
    for name, content in promise.items():
        with pytest.raises(ValueError, match=rf"{name}.*expected \d+000000.*found"):
            read_mesh(file(tmp_path, name, content))


LACKS = "an element vertex with x, y and z expected, found"


@pytest.mark.parametrize(
    "before, after, words",
    [
        ("element vertex", "element point", f"{LACKS} point, face"),
        ("float z", "float w", f"{LACKS} an element vertex with x, y, w"),
        ("float z", "real z", "of a PLY type, expected, found 'property real z'"),
        ("format ascii", "format binary", "one of the formats .* in the header, found binary"),
    ],
)
def test_a_ply_says_what_its_header_lacks(tmp_path, before, after, words):
    head = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\n"
    )
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "m.ply").write_text(head.replace(before, after) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(ValueError, match=f"m.ply cannot be read as PLY: .*{words}"):
        read_mesh(tmp_path / "m.ply")


def test_a_second_mesh_in_a_file_is_named(tmp_path):
    for order in ("ascii", "binary_little_endian"):
        with pytest.raises(ValueError, match=r"one mesh expected, found a second PLY at byte \d+"):
            read_mesh(file(tmp_path, "m.ply", 2 * ply(order)))
        longer = ply(order) + (b"3 0 1 2\n" if order == "ascii" else bytes(26))
        with pytest.raises(ValueError, match=r"found \d+ more rows than the header says"):
            read_mesh(file(tmp_path, "m.ply", longer))
    write_mesh(tmp_path / "m.vtk", X, T, x=X[:, 0])
    with pytest.raises(ValueError, match=r"one mesh expected, found a second VTK at byte \d+"):
        read_mesh(file(tmp_path, "m.vtk", 2 * (tmp_path / "m.vtk").read_bytes()))
    write_mesh(tmp_path / "m.vtk", X, T)
    one = (tmp_path / "m.vtk").read_bytes()
    with pytest.raises(ValueError, match="a section of polydata expected, found b'POINTS'"):
        read_mesh(file(tmp_path, "m.vtk", one + one[one.index(b"POINTS") :]))
    for more in ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "3 0 1 2\n"):
        with pytest.raises(ValueError, match=r"found \d more lines than its counts say"):
            read_mesh(file(tmp_path, "m.off", f"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n{more}"))
    faces = b"element face 1\nproperty list uchar int vertex_indices\n"
    twice = ply("ascii").replace(b"element face", faces + b"element face")
    with pytest.raises(ValueError, match="one mesh expected, found two elements 'face'"):
        read_mesh(file(tmp_path, "m.ply", twice))
    np.savez(tmp_path / "m.npz", V=X, F=T, vertices=X, faces=T)
    with pytest.raises(ValueError, match="V, F, vertices, faces: write each mesh to a file of its"):
        read_mesh(tmp_path / "m.npz")


def test_text_in_utf_16_is_named(tmp_path):
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in X) + "f 1 2 3\n"
    for encoding in ("utf-16", "utf-16-le", "utf-16-be"):
        with pytest.raises(ValueError, match="text in UTF-16 found: save it as UTF-8"):
            read_mesh(file(tmp_path, "m.obj", text.encode(encoding)))


@pytest.mark.parametrize(
    "content, words",
    [
        (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
        (b"MATLAB 5.0 MAT-file, Platform", "a MATLAB file"),
        (b"glTF\2\0\0\0", "a glTF file"),
        (b'{"scenes": [], "asset": {"version": "2.0"}}', "a glTF file"),
        (b"NRRD0004\ntype: uchar\n", r"found a volume \(NRRD\); give a label"),
        (bytes(128) + b"DICM", "a DICOM file"),
        (b"\x89PNG\r\n\x1a\n", "a picture"),
        (b"BZh91AY", "a compressed file: unpack it"),
        (b"<!DOCTYPE html><html>", "a web page: download the file again"),
        (b"<!-- saved from a page -->\n<HEAD>", "a web page"),
        (b"PXR-USDC", "a USD, "),
        (b"\xff\xff\xfd\0\0\x08\0\0\6", "quadrangles, of FreeSurfer"),
        (b" " * 72 + b"S      1\n", "a STEP or IGES file"),
        (b"version https://git-lfs.github.com/spec/v1\n", "a pointer of Git LFS"),
        (b"MZ\x08\0" + struct.pack("<III", 0, 100, 0), "found an overlay of values or colours"),
    ],
)
def test_files_of_other_kinds_are_named(tmp_path, content, words):
    for body in (b"", bytes(400), np.arange(5000, dtype="<i4").tobytes()):
        with pytest.raises(ValueError, match=rf"m\.stl.*{words}"):
            read_mesh(file(tmp_path, "m.stl", content + body))


def test_a_compressor_that_is_not_read_is_named_with_the_remedy(tmp_path):
    _, _, given = SEEDS["VTP"]
    content = next(c for c, finish in given if finish is fuzz.whole and b"ZLibDataComp" in c)
    with pytest.raises(ValueError, match=r"found vtkLZ4DataCompressor: save it with .* ZLib"):
        read_mesh(file(tmp_path, "m.vtp", content.replace(b"vtkZLib", b"vtkLZ4")))


def test_no_other_binary_file_is_read_as_stl(tmp_path):
    rng = np.random.default_rng(0)
    kinds = [
        lambda n: rng.integers(0, 256, n).astype("u1"),
        lambda n: rng.integers(0, 100, n).astype("<i4"),
        lambda n: rng.normal(size=n).astype("<f4"),
        lambda n: rng.normal(size=n),
        lambda n: np.zeros(n, "u1"),
        lambda n: np.r_[np.zeros(20, "<i4"), 5, rng.integers(-500, 500, n)].astype("<i4"),
    ]
    for i in range(120):
        content = kinds[i % len(kinds)](int(rng.integers(1, 4000))).tobytes()
        with pytest.raises(ValueError, match="unknown format"):
            read_mesh(file(tmp_path, "m.stl", content))


@pytest.mark.parametrize(
    "name", ["L4", "L4 facet left", "facet L4", "L4 vertex 1 2 3", "L4 endsolid", "endfacet", ""]
)
def test_the_name_of_an_stl_solid_is_free_text(tmp_path, name):
    facets = "".join(
        " facet normal 0 0 0\n  outer loop\n"
        + "".join("   vertex {} {} {}\n".format(*x) for x in X[t])
        + "  endloop\n endfacet\n"
        for t in T
    )
    for end in ("\n", "\r\n", "\r"):
        text = f"solid {name}\n{facets}endsolid {name}\n".replace("\n", end)
        same_surface(file(tmp_path, "m.stl", text))
    with pytest.raises(ValueError, match="expected 1 endsolid at the end"):
        read_mesh(file(tmp_path, "m.stl", f"{text}solid b\n{facets}"))
    corner, end = "   vertex {} {} {}\n".format(*X[T[0, 2]]), "  endloop\n"
    text = f"solid {name}\n{facets}endsolid\n".replace(corner + end, end, 1)
    with pytest.raises(ValueError, match="three vertices in every facet expected"):  # two and four
        read_mesh(
            file(tmp_path, "m.stl", text.replace(end + " endfacet\nend", corner + end + "end"))
        )


def test_an_stl_file_with_a_second_one_behind_is_refused(tmp_path):
    write_mesh(tmp_path / "m.stl", X, T)
    data = (tmp_path / "m.stl").read_bytes()
    same_surface(file(tmp_path, "m.stl", data + b"made by hand"))
    with pytest.raises(ValueError, match=r"6 triangles of 384 bytes expected, found 768 bytes"):
        read_mesh(file(tmp_path, "m.stl", data + data))


def test_indices_beyond_the_vertices_are_named(tmp_path):
    text = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n"
    with pytest.raises(ValueError, match=r"indices 0\.\.2 expected for 3 vertices, found 0\.\.7"):
        read_mesh(file(tmp_path, "m.off", text))


def test_what_is_no_mesh_says_so(tmp_path):
    with pytest.raises(ValueError, match=r"one of PLY, OBJ.* expected, found"):
        read_mesh(file(tmp_path, "m.ply", "shopping list"))
    with pytest.raises(ValueError, match=r"no file"):
        read_mesh(tmp_path / "absent.ply")
    with pytest.raises(ValueError, match=r"no faces: a surface needs triangles, found 3 points"):
        read_mesh(file(tmp_path, "m.off", "OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n"))


# collections


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return folder


def test_a_pattern_picks_one_structure_of_a_download(tmp_path):
    names = "000003_brain.stl|000003_liver.stl|s0011_brain.stl|readme.txt|._s0011_brain.stl"
    touch(tmp_path, *names.split("|"))
    for pattern in ("*_brain", "*_brain.stl"):
        assert [name for _, name in find_meshes(tmp_path, pattern)] == [
            "000003_brain",
            "s0011_brain",
        ]
    with pytest.raises(ValueError, match=r"no mesh of 3 files matching '\*_heart'"):
        find_meshes(tmp_path, "*_heart")


def test_names_are_unique_and_do_not_depend_on_the_order(tmp_path):
    names = "a/head.ply|b/head.ply|b/head.stl|b/HEAD.off|c/Kopf ä.ply|c/脳.ply|lh.pial|a_b.ply|"
    names += "a/b_c.ply|a_b/c.ply|a b/c.ply|a.b/c.ply|é.ply|e.ply|A/b_c.ply"
    touch(tmp_path, *names.split("|"))
    result = find_meshes(tmp_path)
    names = [name for _, name in result]
    assert len({name.casefold() for name in names}) == len(names) == 15
    assert {"a_head", "b_head_ply", "b_head_stl", "lh_pial", "Kopf_a", slug("脳")} <= set(names)
    assert find_meshes([path for path, _ in result[::-1]]) == result
    assert find_meshes([tmp_path / "c", tmp_path, str(tmp_path / "**" / "*.ply")]) == result


def test_accents_in_either_normal_form_give_one_name():
    assert slug("a\u0308") == slug("\u00e4") == "a"


def test_a_missing_path_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"no file or folder matches .*absent"):
        find_meshes(tmp_path / "absent")
    with pytest.raises(ValueError, match=r"no match|no file or folder matches"):
        find_meshes(str(tmp_path / "*.ply"))
    with pytest.raises(ValueError, match=r"no mesh"):
        find_meshes(tmp_path)


def test_published_brain_templates_are_read():
    folder = DATA / "brain_templates" / "fsaverage5_conte69"
    if not folder.exists():
        pytest.skip("needs the shared data")
    points, triangles, attrs = read_mesh(folder / "fsa5_lh.gii")
    assert (len(points), len(triangles)) == (10242, 20480)
    assert attrs["unit"] == "mm"


def test_other_files_of_a_folder_are_skipped_and_named(tmp_path):
    write_mesh(tmp_path / "a.ply", X, T)
    np.savez(tmp_path / "scores.npz", score=np.zeros(3))
    (tmp_path / "a.json").write_text("{}")
    assert [path.name for path, _ in find_meshes(tmp_path)] == ["a.ply"]
    assert [(path.name, why) for path, why in not_meshes(tmp_path)] == [
        ("scores.npz", "an archive of other arrays")
    ]
    assert [path.name for path, _ in not_meshes(tmp_path / "*")] == ["a.json", "scores.npz"]
    (tmp_path / "volumes").mkdir()
    (tmp_path / "volumes/a.nii").touch()
    assert (tmp_path / "volumes", "a folder without meshes") in not_meshes(
        [tmp_path, tmp_path / "volumes"]
    )
    assert not_meshes(tmp_path, "a") == []
