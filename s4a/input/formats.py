"""Mesh formats, bytes to arrays and back.

PLY, OBJ, OFF, STL, GIFTI, FreeSurfer and NPZ (5, the data).
"""

import io
import re

import nibabel
import numpy as np

from s4a.input import bounded
from s4a.input.gifti import parse_gifti
from s4a.input.vtk import parse_vtk, parse_vtp, vtk_bytes

NPZ_KEYS = (
    ("V", "F"),
    ("vertices", "faces"),
    ("points", "triangles"),
    ("position", "corner_vertex"),
    ("X", "T"),
)


def _fan(polygons):
    """Triangles of polygons ``(m, k)``: corner 0 with each side away from it.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.formats import _fan
    >>> _fan(np.array([[0, 1, 2, 3]])).tolist()
    [[0, 1, 2], [0, 2, 3]]
    """
    k = polygons.shape[1]
    if k < 3:
        return np.empty((0, 3), np.int64)
    first = np.broadcast_to(polygons[:, :1], (len(polygons), k - 2))
    return np.stack([first, polygons[:, 1:-1], polygons[:, 2:]], axis=2).reshape(-1, 3)


def _whole(values):
    """Indices as integers; those of a text file of numbers are floats."""
    values = np.asarray(values)
    if values.dtype.kind == "f" and not (np.abs(values) < 2**53).all():
        raise ValueError("face indices are no numbers, or far too large")
    whole = values.astype(np.int64)
    if values.dtype.kind == "f" and (whole != values).any():
        raise ValueError(
            f"whole numbers expected as face indices, found {values[whole != values][0]}"
        )
    return whole


def _need(expected, found, what):
    if found < expected:
        raise ValueError(
            f"expected {expected} {what}, found {found}: the file is cut short or its counts are wrong"
        )


def _polygons(rows):
    """Triangles of token rows that hold the corners.

    Grouped by their number and put back in order.
    """
    sizes = np.array([len(row) for row in rows], np.int64)
    triangles, order = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for k in np.unique(sizes[sizes > 2]):
        chosen = np.flatnonzero(sizes == k)
        corners = [rows[i] for i in chosen]
        triangles.append(
            _fan(_whole(np.array(corners, np.int64 if isinstance(corners[0], list) else None)))
        )
        order.append(np.repeat(chosen, k - 2))
    return np.concatenate(triangles)[np.argsort(np.concatenate(order), kind="stable")]


# PLY

PLY_TYPES = {
    name: code
    for names, code in (
        ("char int8", "i1"),
        ("uchar uint8", "u1"),
        ("short int16", "i2"),
        ("ushort uint16", "u2"),
        ("int int32", "i4"),
        ("uint uint32", "u4"),
        ("float float32", "f4"),
        ("double float64", "f8"),
    )
    for name in names.split()
}
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _read_ply(data):
    end = re.search(rb"\bend_header[ \t]*\r?\n", data)
    if not end:
        raise ValueError("the header has no end_header")
    elements, kind = [], None
    for words in (line.split() for line in data[: end.start()].decode("latin-1").splitlines()):
        if words[:1] == ["format"]:
            kind = words[1] if words[1:] else None
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            codes = [PLY_TYPES.get(word) for word in words[1:-1] if word != "list"]
            if not elements or not all(codes):
                raise ValueError(
                    f"properties of elements, of the types of PLY, expected, found {' '.join(words)[:80]!r}"
                )
            elements[-1][2].append((words[-1], codes))
    if kind not in PLY_ORDERS:
        raise ValueError(
            f"one of the formats {', '.join(PLY_ORDERS)} expected in the header, found {kind}"
        )
    order = PLY_ORDERS[kind]
    body = data[end.end() :] if order else np.array(data[end.end() :].split(), np.float64)
    at, table = 0, {}
    for name, count, properties in elements:
        properties = [
            (key, [np.dtype(order + code) if order else None for code in codes])
            for key, codes in properties
        ]
        table[name], at = _ply_rows(body, at, name, count, properties)
        if "vertex" in table and "face" in table:
            break
    vertex = table.get("vertex", {})
    if not all(axis in vertex for axis in "xyz"):
        held = (
            f"an element vertex with {', '.join(vertex) or 'nothing'}"
            if "vertex" in table
            else ", ".join(table)
        )
        raise ValueError(
            f"an element vertex with x, y and z expected, found {held or 'no element'}"
        )
    points = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    face = table.get("face", {})
    triangles = face.get("vertex_indices", face.get("vertex_index"))
    return points, np.empty((0, 3)) if triangles is None else triangles, {}


def _ply_rows(body, at, name, count, properties):
    """The columns of an element, lists as triangles, and where the next element begins.

    `body` is bytes, or in an ascii file the array of all values, where each has size 1.
    """
    ascii_ = isinstance(body, np.ndarray)

    def size(dtype):
        return 1 if ascii_ else dtype.itemsize

    least = sum(size(types[0]) for _, types in properties)
    _need(count, (len(body) - at) // max(least, 1), f"rows of {name}")
    lists = [key for key, types in properties if len(types) == 2]
    lengths = _first_lengths(body, at, properties, size) if count else dict.fromkeys(lists, 0)
    stride = least + sum(
        lengths[key] * size(types[1]) for key, types in properties if len(types) == 2
    )
    if not lists or at + count * stride <= len(body):
        block, columns, offset = _reinterpret(body[at : at + count * stride], count, stride), {}, 0
        for key, types in properties:
            columns[key] = _column(block, offset, types[0], 1)[:, 0]
            offset += size(types[0])
            if len(types) == 2:
                if (columns[key] != lengths[key]).any():
                    break
                if key.startswith("vertex_ind"):
                    columns[key] = _fan(_whole(_column(block, offset, types[1], lengths[key])))
                offset += lengths[key] * size(types[1])
        else:
            return columns, at + count * stride
    return _mixed_rows(body, at, name, count, properties, size)


def _reinterpret(body, count, stride):
    flat = body if isinstance(body, np.ndarray) else np.frombuffer(body, np.uint8)
    return flat.reshape(count, stride)


def _column(block, offset, dtype, k):
    """The values from `offset` on in each row, k of them."""
    if dtype is None:
        return block[:, offset : offset + k]
    return (
        np.ascontiguousarray(block[:, offset : offset + k * dtype.itemsize])
        .view(dtype)
        .reshape(len(block), k)
    )


def _first_lengths(body, at, properties, size):
    lengths = {}
    for key, types in properties:
        first = _item(body, at, types[0])
        at += size(types[0])
        if len(types) == 2:
            lengths[key] = max(int(first), 0)
            at += lengths[key] * size(types[1])
    return lengths


def _item(body, at, dtype):
    if dtype is None:
        return body[at]
    return int.from_bytes(
        body[at : at + dtype.itemsize], "big" if dtype.str[0] == ">" else "little"
    )


def _mixed_rows(body, at, name, count, properties, size):
    """Rows of different length: triangles of the list of vertices, other columns left out."""
    rows, wanted = [], next((key for key, _ in properties if key.startswith("vertex_ind")), None)
    for row in range(count):
        for key, types in properties:
            if at + size(types[0]) > len(body):
                _need(count, row, f"rows of {name}")
            if len(types) == 2:
                k = int(_item(body, at, types[0]))
                values = body[at + size(types[0]) : at + size(types[0]) + k * size(types[1])]
                if k < 0 or len(values) < k * size(types[1]):
                    _need(count, row, f"rows of {name}")
                if key == wanted:
                    rows.append(values if types[1] is None else np.frombuffer(values, types[1]))
                at += k * size(types[1])
            at += size(types[0])
    return {wanted: _polygons(rows)} if wanted else {}, at


# OBJ, OFF, STL


def _read_obj(data):
    text = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    lines = text.splitlines()
    words = [line.split() for line in lines if line.lstrip()[:2] in (b"v ", b"f ", b"v\t", b"f\t")]
    vertex = np.array([row[0] == b"v" for row in words], bool)
    points = np.array([row[1:4] for row in words if row[0] == b"v"], np.float64)
    so_far = np.cumsum(vertex)[~vertex]
    faces = [[corner.partition(b"/")[0] for corner in row[1:]] for row in words if row[0] == b"f"]
    short = sum(len(face) < 3 for face in faces)
    if short:
        raise ValueError(f"faces of 3 corners or more expected, found {short} with fewer")
    before = np.repeat(so_far, [len(face) - 2 for face in faces])[:, None]
    triangles = _polygons(faces)
    if (triangles == 0).any():
        raise ValueError("face indices from 1, or from -1 backwards, expected; found 0")
    return points, np.where(triangles > 0, triangles - 1, triangles + before), {}


def _read_off(data):
    text = re.sub(rb"#.*", b"", data)
    header = re.match(rb"\s*(?:ST)?C?N?OFF(?P<binary>[ \t]+BINARY)?", text)
    if header["binary"]:
        raise ValueError("binary OFF is not supported; save it as text, PLY or STL")
    lines = [line for line in text[header.end() :].splitlines() if line.strip()]
    n, m = (int(word) for word in lines[0].split()[:2])
    if min(n, m) < 0:
        raise ValueError(f"counts from 0 expected, found {n} vertices and {m} faces")
    _need(n + m, len(lines) - 1, "lines of vertices and faces")
    points = np.array([line.split()[:3] for line in lines[1 : n + 1]], np.float64)
    faces = []
    for line in lines[n + 1 : n + 1 + m]:
        row = line.split()
        k = int(row[0])
        _need(k, len(row) - 1, "corners of a face")
        faces.append(row[1 : k + 1])
    return points, _polygons(faces), {}


def _read_stl(data):
    count = int.from_bytes(data[80:84], "little")
    if (
        len(data) != 84 + 50 * count
        and re.match(rb"\s*solid\b", data, re.I)
        and b"\0" not in data[:1000]
    ):
        rows = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", data, re.I)
        _need(3 * len(re.findall(rb"\bfacet\b", data, re.I)), len(rows), "vertices of facets")
        _need(1, len(re.findall(rb"\bendsolid\b", data, re.I)), "endsolid")
        points = np.array(rows, np.float64)
    else:
        _need(count, (len(data) - 84) // 50, "triangles")
        points = np.frombuffer(
            data, np.dtype([("n", "<f4", 3), ("x", "<f4", (3, 3)), ("a", "<u2")]), count, 84
        )["x"]
        points = points.reshape(-1, 3)
    return *_distinct(points), {}


def _distinct(points):
    """The distinct rows in order of appearance, and the triangles of every three rows.

    STL has no shared vertices.
    """
    order = np.lexsort(points.T)
    new = np.r_[True, (points[order[1:]] != points[order[:-1]]).any(axis=1)][: len(points)]
    first = order[new]  # the sort is stable
    vertex = np.empty(len(points), np.int64)
    vertex[order] = np.argsort(np.argsort(first))[np.cumsum(new) - 1]
    return points[np.sort(first)], vertex.reshape(-1, 3)


# containers


def _read_gifti(data):
    arrays = parse_gifti(data)
    found = [
        [values for intent, values in arrays if intent == wanted]
        for wanted in ("POINTSET", "TRIANGLE")
    ]
    if not all(found):
        raise ValueError(
            f"one set of points and one of triangles expected, found {len(found[0])} and {len(found[1])}"
        )
    return found[0][0], _whole(found[1][0]), {"coordinate_system": "RAS", "unit": "mm"}


def _read_freesurfer(data):
    start = data.index(b"\n\n") + 2
    n, m = (int(k) for k in np.frombuffer(data, ">i4", 2, start))
    _need(12 * (n + m), len(data) - start - 8, "bytes of vertices and triangles")
    points = np.frombuffer(data, ">f4", 3 * n, start + 8).reshape(n, 3)
    triangles = np.frombuffer(data, ">i4", 3 * m, start + 8 + 12 * n).reshape(m, 3)
    return points, triangles, {"coordinate_system": "RAS", "unit": "mm"}


def _read_npz(data):
    arrays = bounded.npz(data)
    for keys in NPZ_KEYS:
        if all(key in arrays for key in keys):
            points, triangles = (arrays[key]() for key in keys)
            if triangles.dtype.kind not in "iu":
                raise ValueError(f"integer indices expected in {keys[1]}, found {triangles.dtype}")
            if points.dtype.kind not in "iuf":
                raise ValueError(f"numbers expected in {keys[0]}, found {points.dtype}")
            return points, triangles, {}
    wanted = " or ".join(" and ".join(keys) for keys in NPZ_KEYS)
    raise ValueError(f"the keys {wanted} expected, found {', '.join(arrays) or 'none'}")


READERS = {
    "PLY": _read_ply,
    "OBJ": _read_obj,
    "OFF": _read_off,
    "STL": _read_stl,
    "VTK": parse_vtk,
    "VTP": parse_vtp,
    "GIFTI": _read_gifti,
    "NPZ": _read_npz,
    "FreeSurfer": _read_freesurfer,
}


def _ply_bytes(X, T, scalars):
    names = ["x", "y", "z", *(re.sub(r"\s", "_", name) for name in scalars)]
    face = np.empty(len(T), [("n", "u1"), ("v", "<i4", 3)])
    face["n"], face["v"] = 3, T
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(X)}\n"
    head += "".join(f"property float {name}\n" for name in names)
    head += f"element face {len(T)}\nproperty list uchar int vertex_indices\nend_header\n"
    return (
        head.encode()
        + np.column_stack([X, *scalars.values()]).astype("<f4").tobytes()
        + face.tobytes()
    )


def _text(lines):
    return ("\n".join(lines) + "\n").encode()


def _obj_bytes(X, T, _):
    return _text(
        [
            *("v {!r} {!r} {!r}".format(*x) for x in X.tolist()),
            *("f {} {} {}".format(*t) for t in (T + 1).tolist()),
        ]
    )


def _off_bytes(X, T, _):
    head = ["OFF", f"{len(X)} {len(T)} 0"]
    return _text(
        [
            *head,
            *("{!r} {!r} {!r}".format(*x) for x in X.tolist()),
            *("3 {} {} {}".format(*t) for t in T.tolist()),
        ]
    )


def _stl_bytes(X, T, _):
    rows = np.zeros(len(T), [("n", "<f4", 3), ("x", "<f4", (3, 3)), ("a", "<u2")])
    rows["x"] = X[T]
    return b"binary".ljust(80) + len(T).to_bytes(4, "little") + rows.tobytes()


def _gifti_bytes(X, T, scalars):
    arrays = [("POINTSET", X.astype(np.float32), {}), ("TRIANGLE", T, {})]
    arrays += [
        ("SHAPE", values.astype(np.float32), {"Name": name}) for name, values in scalars.items()
    ]
    return nibabel.gifti.GiftiImage(
        darrays=[
            nibabel.gifti.GiftiDataArray(
                values, f"NIFTI_INTENT_{intent}", meta=nibabel.gifti.GiftiMetaData(meta)
            )
            for intent, values, meta in arrays
        ]
    ).to_bytes()


def _npz_bytes(X, T, scalars):
    out = io.BytesIO()
    np.savez_compressed(out, position=X, corner_vertex=T, **scalars)
    return out.getvalue()


WRITERS = {
    ".ply": _ply_bytes,
    ".obj": _obj_bytes,
    ".off": _off_bytes,
    ".stl": _stl_bytes,
    ".vtk": vtk_bytes,
    ".gii": _gifti_bytes,
    ".npz": _npz_bytes,
}
