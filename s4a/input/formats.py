"""Mesh formats, bytes to arrays and back (5, the data): the one file in which a format is added.

How to add a format:

1. Write ``_read_x(data)``: from all bytes of a file to ``points, triangles, attrs``. Whatever is
   wrong is a ValueError that says what was expected and what was found; ask for memory only after
   the file turned out long enough for its counts (:func:`_need`, :mod:`s4a.input.bounded`). Shapes
   and indices are checked, and the name of the file is put in front, by
   :func:`s4a.input.files.read_mesh`; polygons become triangles by :func:`s4a.input.vtk.fans`.
2. To write it too, write ``_x_bytes(X, T, scalars)``.
3. Enter both in :data:`FORMATS` at the end of this file, with the suffixes and with the pattern
   that the first bytes match.
4. Enter a whole file in ``seeds`` of ``tests/fuzz.py``, where it is damaged in thousands of ways.

Who parses what: this file and :mod:`s4a.input.vtk` parse everything themselves, nibabel
writes GIFTI. Of the libraries that were tried on the files of the tests, trimesh drops two of a
pentagon's three triangles in OBJ, takes quads out of their order, refuses PLY where quads stand
among triangles and reads files cut short as whole ones; meshio knows neither VTK's nor VTP's
polygonal data, negative OBJ indices nor PLY with other elements, and hangs on some damaged files;
igl ends the process on some; nibabel asks for whatever memory a damaged count names.
"""

import base64
import io
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from s4a.geometry.mesh import equal_rows
from s4a.input import bounded
from s4a.input.vtk import fans, number_type, parse_vtk, parse_vtp, vtk_bytes, vtp_bytes

Surface = tuple[np.ndarray, np.ndarray, dict[str, str]]  # points, triangles, attributes
BRAIN = {"coordinate_system": "RAS", "unit": "mm"}  # what GIFTI and FreeSurfer promise


@dataclass(frozen=True)
class Format:
    """How a format is named, told, read and written.

    Parameters
    ----------
    suffixes : str
        In lower case, separated by spaces; the first is the one that is written.
    signature : bytes
        Regular expression for the first bytes, white space left out; empty where bytes further on
        tell, see :func:`format_of`.
    read : callable
        Bytes to :data:`Surface`.
    write : callable, optional
        X ``(n, 3)``, T ``(m, 3)`` and a dict of values per vertex to bytes.
    scalars : bool
        Whether it holds values per vertex.
    """

    suffixes: str
    signature: bytes
    read: Callable[[bytes], Surface]
    write: Callable[[np.ndarray, np.ndarray, dict[str, Any]], bytes] | None = None
    scalars: bool = False


def format_of(data: bytes) -> str:
    """Name of the format that the content shows, a key of :data:`FORMATS`.

    Raises
    ------
    ValueError
        When it shows none.

    Examples
    --------
    >>> from s4a.input.formats import format_of
    >>> format_of(b"OFF 3 1 0"), format_of(b"# made by hand\\nv 0 0 0")
    ('OFF', 'OBJ')
    """
    head = data[:4096].lstrip()
    for name, known in FORMATS.items():
        if known.signature and re.match(known.signature, head, re.DOTALL):
            return name
    if len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        return "STL"
    if re.match(rb"solid\b", head, re.I) and re.search(rb"\bfacet\b|\bendsolid\b", data, re.I):
        return "STL"
    if b"\0" not in head and re.search(rb"^[ \t]*v[ \t]+[-+.\dn]", data, re.M):
        return "OBJ"
    if b"\0" in head and len(data) >= 84:
        return "STL"
    what = f"{len(data)} bytes" + " of something else" * bool(data)
    raise ValueError(f"one of {', '.join(FORMATS)} expected, found {what}")


def _whole(values: np.ndarray) -> np.ndarray:
    """Indices as integers; those of an ascii PLY are floats."""
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    if not (np.abs(values) < 2**53).all():
        raise ValueError("face indices are no numbers, or far too large")
    whole = values.astype(np.int64)
    if (whole != values).any():
        wrong = values[whole != values][0]
        raise ValueError(f"whole numbers expected as face indices, found {wrong}")
    return whole


def _need(expected, found, what):
    if found < expected:
        raise ValueError(
            f"expected {expected} {what}, found {found}: "
            "the file is cut short or its counts are wrong"
        )


# PLY

PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _ply_tables(data):
    """The columns of the elements up to vertices and faces."""
    end = re.search(rb"\bend_header[ \t]*\r?\n", data)
    if not end:
        raise ValueError("the header has no end_header")
    kind, elements = _ply_header(data[: end.start()].decode("latin-1"))
    body = data[end.end() :]
    if kind == "ascii":  # its numbers become eight bytes each, so that one reader does for all
        body = np.array(body.split(), np.float64).tobytes()
    at, table = 0, {}
    for name, count, properties in elements:
        table[name], at = _ply_rows(body, at, name, count, properties)
        if "vertex" in table and "face" in table:
            break
    return table


def ply_properties(data: bytes) -> dict[str, np.ndarray]:
    """The numbers that a PLY file has for its vertices, by name.

    Raises
    ------
    ValueError
        When it is cut short, or is no PLY file.
    """
    return _ply_tables(data).get("vertex", {})


def _read_ply(data):
    table = _ply_tables(data)
    vertex, face = table.get("vertex", {}), table.get("face", {})
    if not all(axis in vertex for axis in "xyz"):
        elements = ", ".join(table) or "no element"
        if "vertex" in table:
            elements = f"an element vertex with {', '.join(vertex) or 'nothing'}"
        raise ValueError(f"an element vertex with x, y and z expected, found {elements}")
    points = np.stack([vertex[axis].astype(np.float64) for axis in "xyz"], axis=1)
    no_triangles = np.empty((0, 3))
    return points, face.get("vertex_indices", face.get("vertex_index", no_triangles)), {}


def _ply_header(text):
    """The kind of file, and its elements: (name, count, [(property, types)]).

    A property has one type; a list has two, of its length and of its values.
    """
    kind, elements = None, []
    for words in map(str.split, text.splitlines()):
        if words[:1] == ["format"]:
            kind = words[1] if words[1:] else None
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            types = [PLY_TYPES.get(word) for word in words[1:-1] if word != "list"]
            if not elements or not all(types):
                line = " ".join(words)[:80]
                raise ValueError(
                    f"properties of elements, of the types of PLY, expected, found {line!r}"
                )
            elements[-1][2].append((words[-1], types))
    if kind not in PLY_ORDERS:
        known = ", ".join(PLY_ORDERS)
        raise ValueError(f"one of the formats {known} expected in the header, found {kind}")
    for _, _, properties in elements:
        for _, types in properties:
            types[:] = [
                np.dtype("f8" if kind == "ascii" else PLY_ORDERS[kind] + code) for code in types
            ]
    return kind, elements


def _ply_rows(body, at, name, count, properties):
    """The columns of an element, and where the next begins.

    The list of a face's corners is given as triangles, other lists are left out; where the rows
    differ in length, so are the numbers beside.
    """
    least = sum(types[0].itemsize for _, types in properties)
    _need(count, (len(body) - at) // max(least, 1), f"rows of {name}")
    if count <= 0:
        return {key: np.empty(0) for key, types in properties if len(types) == 1}, at
    lists, end = _ply_lists(body, at, properties)
    stride = end - at
    if lists is not None and at + count * stride <= len(body):
        rows = np.frombuffer(body, _ply_row_type(properties, lists), count, at)
        if all((rows[f"length {key}"] == length).all() for key, _, length in lists):
            columns = {key: rows[key] for key, types in properties if len(types) == 1}
            for key, _, length in lists:
                if key.startswith("vertex_ind"):
                    corners = _whole(rows[key]).ravel()
                    columns[key] = fans(corners, np.arange(count + 1) * length)
            return columns, at + count * stride
    return _ply_mixed_rows(body, at, name, count, properties)


def _ply_row_type(properties, lists):
    """The structure of a row whose lists have these lengths."""
    lengths = {key: length for key, _, length in lists}
    fields: list[Any] = []
    for key, types in properties:
        if len(types) == 1:
            fields.append((key, types[0]))
        else:
            fields += [(f"length {key}", types[0]), (key, types[1], (lengths[key],))]
    return np.dtype(fields)


def _ply_lists(body, at, properties):
    """(name, begin, length) of each list in the row at `at`, None if cut; and the row's end."""
    lists = []
    for key, types in properties:
        begin = at + types[0].itemsize
        if begin > len(body):
            return None, at
        if len(types) == 2:
            length = int(np.frombuffer(body, types[0], 1, at)[0])
            lists.append((key, begin, length))
            begin += length * types[1].itemsize
            if length < 0 or begin > len(body):
                return None, at
        at = begin
    return lists, at


def _ply_mixed_rows(body, at, name, count, properties):
    """Rows of different length, one after the other: the triangles of the list of corners."""
    wanted = next((key for key, _ in properties if key.startswith("vertex_ind")), None)
    corners, sizes = [], []
    for row in range(count):
        lists, at = _ply_lists(body, at, properties)
        if lists is None:
            _need(count, row, f"rows of {name}")
        for key, begin, length in lists:
            if key == wanted:
                corners.append(np.frombuffer(body, dict(properties)[key][1], length, begin))
                sizes.append(length)
    if wanted is None:
        return {}, at
    return {wanted: fans(_whole(np.concatenate(corners)), np.cumsum([0, *sizes]))}, at


# OBJ, OFF, STL


def _read_obj(data):
    text = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")  # lines that go on
    places, indices, sizes, n_before = [], [], [], []
    for line in text.splitlines():
        words = line.split()
        if words[:1] == [b"v"]:
            places.append(words[1:4])
        elif words[:1] == [b"f"]:
            indices += [word.partition(b"/")[0] for word in words[1:]]
            sizes.append(len(words) - 1)
            n_before.append(len(places))
    points = np.array(places, np.float64)
    short = sum(size < 3 for size in sizes)
    if short:
        raise ValueError(f"faces of 3 corners or more expected, found {short} with fewer")
    corners = np.array(indices, np.int64)
    if (corners == 0).any():
        raise ValueError("face indices from 1, or from -1 backwards, expected; found 0")
    # -1 is the last of the vertices that stand before the face
    corners += np.where(corners > 0, -1, np.repeat(np.array(n_before, np.int64), sizes))
    return points, fans(corners, np.cumsum([0, *sizes])), {}


def _read_off(data):
    text = re.sub(rb"#.*", b"", data)
    header = next(re.finditer(rb"\A\s*(?:ST)?C?N?OFF([ \t]+BINARY)?", text))
    if header[1]:
        raise ValueError("binary OFF is not supported; save it as text, PLY or STL")
    lines = [line for line in text[header.end() :].splitlines() if line.strip()]
    n, m = (int(word) for word in lines[0].split()[:2])
    if min(n, m) < 0:
        raise ValueError(f"counts from 0 expected, found {n} vertices and {m} faces")
    _need(n + m, len(lines) - 1, "lines of vertices and faces")
    points = np.array([line.split()[:3] for line in lines[1 : n + 1]], np.float64)
    corners, sizes = [], []
    for line in lines[n + 1 : n + 1 + m]:
        size, *words = line.split()  # colours may follow
        sizes.append(int(size))
        _need(sizes[-1], len(words), "corners of a face")
        corners += words[: sizes[-1]]
    return points, fans(np.array(corners, np.int64), np.cumsum([0, *sizes])), {}


STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])


def _read_stl(data):
    """The distinct corners in order of appearance, and triangles: STL has no shared vertices."""
    count = int.from_bytes(data[80:84], "little")
    starts_as_text = re.match(rb"\s*solid\b", data, re.I) and b"\0" not in data[:1000]
    if starts_as_text and len(data) != 84 + 50 * count:
        found = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", data, re.I)
        facets = len(re.findall(rb"\bfacet\b", data, re.I))
        _need(3 * facets, len(found), "vertices of facets")
        _need(1, len(re.findall(rb"\bendsolid\b", data, re.I)), "endsolid")
        corners = np.array(found, np.float64)
    else:
        _need(count, (len(data) - 84) // 50, "triangles")
        corners = np.frombuffer(data, STL_TRIANGLE, count, 84)["corner"].reshape(-1, 3)
    first, place = equal_rows(corners)
    rank = np.argsort(np.argsort(first))
    return corners[np.sort(first)], rank[place].reshape(-1, 3), {}


# containers of arrays


def gifti_arrays(data: bytes) -> list[tuple[str, np.ndarray]]:
    """The arrays of a GIFTI file, surfaces and labels of brains, and what each is for.

    Raises
    ------
    ValueError
        When an array is cut short, unpacks to too much, or lies in another file.
    """
    root, arrays, total = bounded.xml(data), [], 0
    if root.tag != "GIFTI":
        raise ValueError(f"GIFTI expected, found {root.tag[:40]}")
    for node in root.findall("DataArray"):
        values = _gifti_values(node, bounded.limit_of(len(data)) - total)
        total += values.nbytes
        arrays.append((node.get("Intent", "").removeprefix("NIFTI_INTENT_"), values))
    promised = root.get("NumberOfDataArrays")
    if promised is not None and promised.strip() != str(len(arrays)):
        raise ValueError(f"expected {promised[:40]} arrays, found {len(arrays)}")
    return arrays


def _gifti_values(node, limit):
    order = ">" if node.get("Endian") == "BigEndian" else "<"
    dtype = number_type(node.get("DataType"), order)
    shape = tuple(int(node.get(f"Dim{i}")) for i in range(6) if node.get(f"Dim{i}") is not None)
    promised = node.get("Dimensionality")
    if str(len(shape)) != promised or not shape or min(shape) < 0:
        raise ValueError(f"{promised} dimensions expected, found the sizes {shape}")
    text, encoding = node.findtext("Data") or "", node.get("Encoding")
    if encoding == "ASCII":
        values = np.array(text.split(), dtype)
    elif encoding in ("Base64Binary", "GZipBase64Binary"):
        raw = base64.b64decode(text)
        raw = bounded.unpack(raw, "zlib", limit) if encoding == "GZipBase64Binary" else raw
        values = np.frombuffer(raw, dtype, len(raw) // dtype.itemsize)
    else:
        where = f"{encoding} {node.get('ExternalFileName') or ''}".rstrip()
        raise ValueError(f"data inside the file expected, found {where}")
    size = math.prod(shape)
    if len(values) != size:
        raise ValueError(
            f"expected {size} values of an array, found {len(values)}: the file is cut short"
        )
    by_column = node.get("ArrayIndexingOrder") == "ColumnMajorOrder"
    return values.reshape(shape, order="F" if by_column else "C")


def _read_gifti(data):
    arrays = gifti_arrays(data)
    points = [values for intent, values in arrays if intent == "POINTSET"]
    triangles = [values for intent, values in arrays if intent == "TRIANGLE"]
    if not points or not triangles:
        raise ValueError(
            "one set of points and one of triangles expected, "
            f"found {len(points)} and {len(triangles)}"
        )
    return points[0], _whole(triangles[0]), BRAIN


def _read_freesurfer(data):
    start = data.index(b"\n\n") + 2  # after two lines that say who made it
    n, m = (int(k) for k in np.frombuffer(data, ">i4", 2, start))
    _need(12 * (n + m), len(data) - start - 8, "bytes of vertices and triangles")
    points = np.frombuffer(data, ">f4", 3 * n, start + 8).reshape(n, 3)
    triangles = np.frombuffer(data, ">i4", 3 * m, start + 8 + 12 * n).reshape(m, 3)
    return points, triangles, BRAIN


NPZ_KEYS = (
    ("V", "F"),
    ("vertices", "faces"),
    ("points", "triangles"),
    ("position", "corner_vertex"),
    ("X", "T"),
)


def _read_npz(data):
    arrays = bounded.npz(data)
    keys = next((keys for keys in NPZ_KEYS if set(keys) <= set(arrays)), None)
    if keys is None:
        wanted = " or ".join(" and ".join(keys) for keys in NPZ_KEYS)
        raise ValueError(f"the keys {wanted} expected, found {', '.join(arrays) or 'none'}")
    points, triangles = (arrays[key]() for key in keys)
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"integer indices expected in {keys[1]}, found {triangles.dtype}")
    if points.dtype.kind not in "iuf":
        raise ValueError(f"numbers expected in {keys[0]}, found {points.dtype}")
    return points, triangles, {}


# writers


def _ply_bytes(X, T, scalars):
    names = ["x", "y", "z", *(re.sub(r"\s", "_", name) for name in scalars)]
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(X)}\n"
    head += "".join(f"property float {name}\n" for name in names)
    head += f"element face {len(T)}\nproperty list uchar int vertex_indices\nend_header\n"
    vertex = np.column_stack([X, *scalars.values()]).astype("<f4")
    face = np.empty(len(T), [("length", "u1"), ("corners", "<i4", 3)])
    face["length"], face["corners"] = 3, T
    return head.encode() + vertex.tobytes() + face.tobytes()


def _obj_bytes(X, T, _):
    vertices = "".join("v {!r} {!r} {!r}\n".format(*x) for x in X.tolist())
    return (vertices + "".join("f {} {} {}\n".format(*t) for t in (T + 1).tolist())).encode()


def _off_bytes(X, T, _):
    vertices = "".join("{!r} {!r} {!r}\n".format(*x) for x in X.tolist())
    faces = "".join("3 {} {} {}\n".format(*t) for t in T.tolist())
    return f"OFF\n{len(X)} {len(T)} 0\n{vertices}{faces}".encode()


def _stl_bytes(X, T, _):
    rows = np.zeros(len(T), STL_TRIANGLE)
    rows["corner"] = X[T]
    return b"binary".ljust(80) + len(T).to_bytes(4, "little") + rows.tobytes()


def _gifti_bytes(X, T, scalars):
    from nibabel.gifti import gifti  # here, as nothing else needs it

    arrays = [("POINTSET", X.astype(np.float32), {}), ("TRIANGLE", T, {})]
    for name, values in scalars.items():
        arrays.append(("SHAPE", values.astype(np.float32), {"Name": name}))
    image = gifti.GiftiImage()
    for intent, values, words in arrays:
        meta = gifti.GiftiMetaData(words)
        image.add_gifti_data_array(
            gifti.GiftiDataArray(values, f"NIFTI_INTENT_{intent}", meta=meta)
        )
    return image.to_bytes()


def _npz_bytes(X, T, scalars):
    out = io.BytesIO()
    np.savez_compressed(out, position=X, corner_vertex=T, **scalars)
    return out.getvalue()


SURFER = ".pial .white .inflated .orig .smoothwm .sphere"  # the name is the suffix: lh.pial
FORMATS = {
    "PLY": Format(".ply", rb"ply[\r\n]", _read_ply, _ply_bytes, scalars=True),
    "OBJ": Format(".obj", b"", _read_obj, _obj_bytes),
    "OFF": Format(".off", rb"(ST)?C?N?OFF", _read_off, _off_bytes),
    "STL": Format(".stl", b"", _read_stl, _stl_bytes),
    "VTK": Format(".vtk", b"# vtk DataFile", parse_vtk, vtk_bytes, scalars=True),
    "VTP": Format(".vtp", b"<(.*<)?VTKFile", parse_vtp, vtp_bytes, scalars=True),
    "GIFTI": Format(".gii", b"<(.*<)?GIFTI", _read_gifti, _gifti_bytes, scalars=True),
    "NPZ": Format(".npz", rb"PK\x03\x04", _read_npz, _npz_bytes, scalars=True),
    "FreeSurfer": Format(SURFER, rb"\xff\xff\xfe", _read_freesurfer),
}
