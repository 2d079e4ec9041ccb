"""Mesh formats (5, the data): bytes to arrays and back.

To add a format, add a line to :data:`FORMATS`; CONTRIBUTING.md lists the steps.

Everything is parsed here; nibabel writes GIFTI.  Measured on 400 damaged files of each format of
``tests/fuzz.py``: trimesh 5.2 reads 41 damaged PLY, 44 OBJ and 29 OFF files without an error, and
meshio 5.3 28 PLY, 13 OFF and 5 STL files; all are errors here.  trimesh has no GIFTI, VTK and VTP,
and gives an STL three vertices per triangle; meshio hangs on some files.  Reading a torus of
100,000 vertices takes here, in trimesh and in meshio: PLY 12, 40 and 57 ms, OBJ 0.5, 0.3 and 0.7 s,
OFF 0.4, 0.8 and 0.2 s.
"""

import base64
import html
import io
import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from s4a.geometry.mesh import equal_rows
from s4a.input.polygons import Polygons, joined, polygons, strips
from s4a.input.raw import is_utf_16, limit_of, npz, unpack, xml
from s4a.schema import Array

_LEGACY_TYPES = {
    "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2", "int": "i4",
    "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtkidtype": "i8",
    "vtktypeint64": "i8", "vtktypeint32": "i4", "float": "f4", "double": "f8",
}  # fmt: skip
_COMPRESSORS = {"vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}


def _number_type(name, order):
    """Dtype of a name in XML, as Float32 or NIFTI_TYPE_UINT8; order is ``<`` or ``>``."""
    match = re.fullmatch(r"(?:NIFTI_TYPE_)?(u?int(8|16|32|64)|float(32|64))", name or "", re.I)
    if not match:
        raise ValueError(f"integers or floats expected, found {str(name)[:40]}")
    return np.dtype(order + np.dtype(match[1].lower()).str[1:])


# legacy files


def _parse_vtk(data):
    """Points, triangles and attributes of a legacy file with ``DATASET POLYDATA``."""
    file = _Legacy(data)
    if [word.upper() for word in file.line()] != [b"DATASET", b"POLYDATA"]:
        raise ValueError(
            "DATASET POLYDATA expected, found another dataset; save the surface as polydata"
        )
    points, cells = None, []
    while words := file.line():
        section = words[0].upper()
        if section == b"POINTS" and points is None:
            points = file.values(3 * int(words[1]), words[2]).reshape(-1, 3)
        elif section in (b"POLYGONS", b"TRIANGLE_STRIPS", b"LINES", b"VERTICES"):
            found = file.polygons(int(words[1]), int(words[2]))
            if section == b"TRIANGLE_STRIPS":
                found = strips(*found)
            if section in (b"POLYGONS", b"TRIANGLE_STRIPS"):
                cells.append(found)
        elif section in (b"POINT_DATA", b"CELL_DATA"):
            if second := re.search(rb"\n# vtk DataFile Version", data[file.at :]):
                at = file.at + second.start() + 1
                raise ValueError(f"one mesh expected, found a second VTK at byte {at}: {_REMEDY}")
            break
        elif section == b"METADATA":  # to the next empty line
            file.at = next(re.compile(rb"\n[ \t\r]*\n|\Z").finditer(data, file.at - 1)).end()
        elif section == b"FIELD":
            file.skip_fields(int(words[2]))
        else:
            raise ValueError(f"a section of polydata expected, found {words[0][:40]!r}")
    if points is None:
        raise ValueError("POINTS expected, found none")
    return points, joined(cells), {}


class _Legacy:
    """Bytes of a legacy file and the position of the reader."""

    def __init__(self, data):
        head = re.match(rb"[^\n]*\n[^\n]*\n\s*(ASCII|BINARY)\s*\n", data, re.I)
        if not head:
            raise ValueError("two lines and ASCII or BINARY expected at the start")
        self.data, self.at, self.binary = data, head.end(), head[1].upper() == b"BINARY"

    def line(self):
        """Words of the next line that is not empty; an empty list at the end."""
        line = next(re.compile(rb"\s*([^\n]*)").finditer(self.data, self.at))
        self.at = min(line.end() + 1, len(self.data))
        return line[1].split()

    def values(self, count, type_name):
        """Read the next numbers."""
        dtype = np.dtype(">" + _LEGACY_TYPES[type_name.decode().lower()])
        n_bytes = len(self.data) - self.at
        if count < 0 or count * (dtype.itemsize if self.binary else 2) > n_bytes + 1:
            raise ValueError(
                f"expected {count} values of type {dtype.name}, found {n_bytes} bytes: "
                "the file is cut short"
            )
        if self.binary:
            start, self.at = self.at, self.at + count * dtype.itemsize
            return np.frombuffer(self.data, dtype, count, start)
        # splitting all the rest for each array would be quadratic in the size of the file
        end = min(self.at + 64 * count + 1000, len(self.data))
        words = self.data[self.at : end].split(None, count)
        if len(words) <= count:
            end = len(self.data)
            words = self.data[self.at :].split(None, count)
        if len(words) < count:
            raise ValueError(f"expected {count} values, found {len(words)}: the file is cut short")
        self.at = end - sum(map(len, words[count:]))
        return np.array(words[:count], dtype.newbyteorder("="))

    def polygons(self, n, size):
        """Cells of a section: count and corners of each cell, or offsets and corners (5.1)."""
        before = self.at
        words = self.line()
        if words and words[0].upper() == b"OFFSETS":
            offsets = self.values(n, words[1]).astype(np.int64)
            corners = self.values(size, self.line()[1])
            return polygons(corners.astype(np.int64), offsets)
        self.at = before
        values = self.values(size, b"int").astype(np.int64)
        is_count = np.zeros(size, bool)
        is_count[_count_positions(values, n)] = True
        return values[~is_count], values[is_count]

    def skip_fields(self, count):
        """Skip arrays that come before the points."""
        for _ in range(count):
            _, width, rows, type_name = self.line()
            n = int(width) * int(rows)
            if type_name.lower() != b"string":
                self.values(n, type_name)
                continue
            for _ in range(min(n, len(self.data))):
                if self.binary:  # 2 bits: size of the length; the length; the string
                    size = 8 >> (self.data[self.at : self.at + 1] or b"\0")[0] // 64
                    length = int.from_bytes(self.data[self.at : self.at + size])
                    self.at = min(self.at + size + length % 2 ** (8 * size - 2), len(self.data))
                else:
                    self.line()


def _count_positions(values, n):
    """Positions of the counts of n cells in `values` (count, corners, count, corners, ...)."""
    width = len(values) // n if n > 0 else 0
    if width and len(values) == n * width and (values[::width] == width - 1).all():
        return np.arange(0, len(values), width)  # all cells have the same number of corners
    positions, at = [], 0
    for _ in range(n):
        if at >= len(values) or values[at] < 0:
            raise ValueError(f"expected {n} polygons, found {len(positions)}")
        positions.append(at)
        at += int(values[at]) + 1
    if at != len(values):
        raise ValueError(f"expected {len(values)} values for {n} polygons, found {at}")
    return np.array(positions, np.int64)


def vtk_bytes(X: Array, T: Array, scalars: dict[str, Array], title: str = "") -> bytes:
    """Make a binary legacy file; 3D Slicer reads ``SPACE=RAS`` or ``SPACE=LPS`` in its title."""
    cells = np.column_stack([np.full(len(T), 3), T]).astype(">i4")
    parts = [
        b"# vtk DataFile Version 3.0\n%b\nBINARY\nDATASET POLYDATA\n" % (title or "S4A").encode(),
        b"POINTS %d double\n%b\n" % (len(X), X.astype(">f8").tobytes()),
        b"POLYGONS %d %d\n%b\n" % (len(T), cells.size, cells.tobytes()),
    ]
    if scalars:
        parts.append(b"POINT_DATA %d\n" % len(X))
    for name, values in scalars.items():
        label = re.sub(r"\s", "_", name).encode()
        head = b"SCALARS %b float 1\nLOOKUP_TABLE default\n" % label
        parts += [head, values.astype(">f4").tobytes(), b"\n"]
    return b"".join(parts)


# XML files


def vtp_bytes(X: Array, T: Array, arrays: dict[str, Array], title: str = "") -> bytes:
    """Make an XML file with arrays in base64, and `title` in a comment.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)
    arrays : dict of str to float ndarray (n,) or (n, c)
        Values, or vectors, of the points by name; stored as float32.
    """
    fields = "".join(
        _data_array(name, np.asarray(values, "<f4")) for name, values in arrays.items()
    )
    ends = np.arange(3, 3 * len(T) + 1, 3, dtype="<i8")
    cells = _data_array("connectivity", T.astype("<i8").ravel()) + _data_array("offsets", ends)
    piece = f'<Piece NumberOfPoints="{len(X)}" NumberOfPolys="{len(T)}">'
    return (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt64">\n<PolyData>\n{_space_field(title)}{piece}\n<PointData>\n{fields}</PointData>\n'
        f"<Points>\n{_data_array('Points', X.astype('<f8'))}</Points>\n<Polys>\n{cells}</Polys>\n"
        "</Piece>\n</PolyData>\n</VTKFile>\n"
    ).encode()


def _space_field(title):
    """Field data with the axes in a title, as 3D Slicer reads them."""
    space = re.search(r"SPACE=(\w+)", title)
    codes = " ".join(str(ord(letter)) for letter in f"{space[1]}\0") if space else ""
    array = '<Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">'
    return f"<!-- {title} --><FieldData>\n{array}{codes}</Array>\n</FieldData>\n" if space else ""


def _data_array(name, values):
    kind = {"f4": "Float32", "f8": "Float64", "i8": "Int64"}[values.dtype.str[1:]]
    width = values.shape[1] if values.ndim == 2 else 1
    raw = np.array(values.nbytes, "<u8").tobytes() + np.ascontiguousarray(values).tobytes()
    return (
        f'<DataArray type="{kind}" Name="{html.escape(name)}" '
        f'NumberOfComponents="{width}" format="binary">'
        f"{base64.b64encode(raw).decode()}</DataArray>\n"
    )


def _parse_vtp(data):
    """Points, triangles and attributes of an XML file in any encoding, compressed or not."""
    file = VtkXml(data)
    points, cells, n_before = [np.empty((0, 3))], [], 0
    for piece in file.root.iter("Piece"):
        node = piece.find("Points/DataArray")
        if node is None:
            raise ValueError("an array of points expected, found none")
        X = file.values(node).reshape(-1, 3)
        counts = {"NumberOfPoints": len(X)}
        for name in ("Polys", "Strips"):
            arrays = {"connectivity": np.empty(0, np.int64), "offsets": np.empty(0, np.int64)}
            for node in piece.findall(f"{name}/DataArray"):
                arrays[str(node.get("Name"))] = file.values(node).astype(np.int64)
            found = polygons(arrays["connectivity"], np.r_[0, arrays["offsets"]])
            counts[f"NumberOf{name}"] = len(found[1])
            corners, sizes = strips(*found) if name == "Strips" else found
            cells.append((corners + n_before, sizes))
        for name, count in counts.items():
            if int(piece.get(name) or 0) != count:
                raise ValueError(f"expected {name} = {piece.get(name)}, found {count}")
        points.append(X)
        n_before += len(X)
    return np.concatenate(points), joined(cells), {}


class VtkXml:
    """An XML file, with the encoding of its arrays."""

    def __init__(self, data):
        appended = re.search(rb"<AppendedData([^<>]{0,400})>\s{0,99}_", data)
        self.appended: bytes | memoryview = b""
        self.appended_is_base64 = False
        self.limit = limit_of(len(data))  # bytes left for its arrays
        if appended:  # raw bytes are not XML
            self.appended_is_base64 = b"raw" not in appended[1]
            self.appended = memoryview(data)[appended.end() :]
            data = data[: appended.start()] + b"</VTKFile>"
        self.root = xml(data)
        if self.root.get("type") != "PolyData":
            raise ValueError(
                f"PolyData expected, found {self.root.get('type')}; save the surface as polydata"
            )
        self.order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        is_64_bit = self.root.get("header_type") == "UInt64"
        self.size_type = np.dtype(self.order + ("u8" if is_64_bit else "u4"))
        self.compressor = self.root.get("compressor")

    def values(self, node: Any) -> Array:
        """Read the numbers of a DataArray."""
        return self._bytes(node, _number_type(node.get("type"), self.order))

    def _bytes(self, node, dtype):
        text = node.text or ""
        if node.get("format") == "ascii":
            return np.array(text.split(), dtype)
        if node.get("format") == "appended":
            start = int(node.get("offset"))
            raw = self._unpack(self.appended[start:], self.appended_is_base64)
        else:
            raw = self._unpack(text.strip().encode(), True)
        self.limit -= len(raw)  # many arrays may refer to the same bytes
        return np.frombuffer(raw, dtype)

    def strings(self, name: str) -> list[str]:
        """Strings of an array in the field data of the file, which are zero-terminated."""
        nodes = self.root.iterfind(f".//*[@Name='{name}'][@type='String']")
        texts = [self._bytes(node, np.dtype("u1")).tobytes() for node in nodes]
        return [one.decode("latin-1") for text in texts for one in text.split(b"\0")]

    def _unpack(self, data, is_base64):
        """Bytes of one array: sizes come first, then the array or its compressed blocks."""
        w = self.size_type.itemsize
        if not self.compressor:
            length = int(np.frombuffer(_take(data, 0, w, is_base64), self.size_type)[0])
            if length > self.limit:
                raise ValueError(
                    f"arrays of at most {self.limit} bytes more expected, found {length}"
                )
            return _take(data, w, length, is_base64)
        if self.compressor not in _COMPRESSORS:
            raise ValueError(
                f"{' or '.join(_COMPRESSORS)} expected, found {self.compressor}: save it with "
                "compression by ZLib, or without"
            )
        # number of blocks, size of a block, size of the last block, compressed size of each
        blocks = int(np.frombuffer(_take(data, 0, w, is_base64), self.size_type)[0])
        sizes = np.frombuffer(_take(data, 3 * w, blocks * w, is_base64), self.size_type).tolist()
        start = (3 + blocks) * w
        if is_base64:  # sizes and blocks are encoded separately
            data, start = data[_base64_length(start) :], 0
        body = _take(data, start, sum(sizes), is_base64)
        parts, at, limit = [], 0, self.limit
        for size in sizes:
            parts.append(unpack(body[at : at + size], _COMPRESSORS[self.compressor], limit))
            at += size
            limit -= len(parts[-1])
        return b"".join(parts)


def _base64_length(length):
    """Number of characters that encode so many bytes."""
    return 4 * -(-length // 3)


def _take(data, start, length, is_base64):
    """Decode bytes start .. start + length, encoded from the beginning of `data`."""
    end = start + length
    raw = base64.b64decode(data[: _base64_length(end)]) if is_base64 else data[:end]
    if len(raw) < end:
        raise ValueError(
            f"expected {length} bytes of an array, found {max(len(raw) - start, 0)}: "
            "the file is cut short"
        )
    return raw[start:end]


# points, triangles (m, 3) or polygons, attributes
Surface = tuple[Array, Array | Polygons, dict[str, str]]


@dataclass(frozen=True)
class _Format:
    """Suffixes, detection, reader and writer of a format.

    Parameters
    ----------
    suffixes : str
        In lower case, separated by spaces; the first is used for writing.
    signature : bytes
        Regular expression for the first bytes after white space; empty if later bytes decide, see
        :func:`format_of`.
    read : callable
        Function of bytes that returns a :data:`Surface`.
    write : callable, optional
        Function of X ``(n, 3)``, T ``(m, 3)``, a dict of values per vertex, and a title that may
        have ``SPACE=RAS``, that returns bytes.
    scalars : bool
        The format can hold values per vertex.
    """

    suffixes: str
    signature: bytes
    read: Callable[[bytes], Surface]
    write: Callable[..., bytes] | None = None
    scalars: bool = False


# other files that are found among meshes -> regular expression of their first bytes
_MAGICS = dict(
    line.split(" | ", 1)
    for line in Path(__file__).with_name("magics.txt").read_text(encoding="utf-8").splitlines()[1:]
)


def format_of(data: bytes) -> str:
    """Detect the format of a file's content, a key of :data:`FORMATS`.

    Raises
    ------
    ValueError
        If the format is unknown.

    Examples
    --------
    >>> from s4a.input.formats import format_of
    >>> format_of(b"OFF 3 1 0"), format_of(b"# a comment\\nv 0 0 0")
    ('OFF', 'OBJ')
    """
    head = data[:4096].lstrip()
    for name, kind in FORMATS.items():
        if kind.signature and re.match(kind.signature, head, re.DOTALL):
            return name
    if re.match(rb"solid\b", head, re.I) and _STL_FACETS.search(data):
        return "STL"
    if is_utf_16(data):
        raise ValueError("text in UTF-16 found: save it as UTF-8")
    other = next(
        (kind for kind, magic in _MAGICS.items() if re.match(magic.encode(), data, re.DOTALL)), ""
    )
    if not other and _is_binary_stl(data):
        return "STL"
    if not other and b"\0" not in head and re.search(rb"^[ \t]*v[ \t]+[-+.\dn]", data, re.M):
        return "OBJ"
    what = f"{len(data)} bytes" + " of an unknown format" * bool(data)
    found = other or what
    found += ": export the surface as one of them" * bool(other and ":" not in other)
    raise ValueError(f"one of {', '.join(FORMATS)} expected, found {found}")


def _integers(values):
    """Indices as integers; those of an ascii PLY are floats."""
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    if not (np.abs(values) < 2**53).all():
        raise ValueError("face indices are not numbers, or far too large")
    integers = values.astype(np.int64)
    if (integers != values).any():
        wrong = values[integers != values][0]
        raise ValueError(f"integers expected as face indices, found {wrong}")
    return integers


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
_COUNTED = "one mesh, with all of its rows counted, expected"
_REMEDY = "correct the counts, or write each mesh to a file of its own"
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _ply_tables(data):
    """Columns of the elements up to vertices and faces."""
    end = re.search(rb"\bend_header[ \t]*\r?\n", data)
    if not end:
        raise ValueError("the header has no end_header")
    kind, elements = _ply_header(data[: end.start()].decode("latin-1"))
    body = data[end.end() :]
    if second := re.search(rb"ply\s+format (ascii|binary_\w+_endian) ", body):
        raise ValueError(
            f"one mesh expected, found a second PLY at byte {end.end() + second.start()}: {_REMEDY}"
        )
    if kind == "ascii":  # convert numbers to eight bytes each, for the binary reader
        body = np.array(body.split(), np.float64).tobytes()
    at, table, least = 0, {}, 1
    for name, count, properties in elements:
        table[name], at = _ply_rows(body, at, name, count, properties)
        least = max(sum(types[0].itemsize for _, types in properties), 1)
    if more := (len(body) - at) // least:
        raise ValueError(f"{_COUNTED}, found {more} more rows than the header says: {_REMEDY}")
    return table


def ply_properties(data: bytes) -> dict[str, Array]:
    """Return the vertex properties of a PLY file by name.

    Raises
    ------
    ValueError
        If the file is truncated or not a PLY file.
    """
    return _ply_tables(data).get("vertex", {})


def _read_ply(data):
    table = _ply_tables(data)
    vertex = table.get("vertex", {})
    if not all(axis in vertex for axis in "xyz"):
        elements = ", ".join(table) or "no element"
        if "vertex" in table:
            elements = f"an element vertex with {', '.join(vertex) or 'nothing'}"
        raise ValueError(f"an element vertex with x, y and z expected, found {elements}")
    points = np.stack([vertex[axis].astype(np.float64) for axis in "xyz"], axis=1)
    cells = []
    for element in ("face", "tristrips"):
        for key in {"vertex_indices", "vertex_index"} & set(table.get(element, {})):
            found = table[element][key]
            cells.append(found if element == "face" else strips(*_split(*found)))
    return points, joined(cells), {}


def _split(corners, sizes):
    """Split triangle strips where a corner is -1."""
    number = np.cumsum(corners < 0) + np.repeat(np.arange(len(sizes)), sizes)
    kept = corners >= 0
    return corners[kept], np.unique(number[kept], return_counts=True)[1]


def _ply_header(text):
    """Encoding and elements, (name, count, [(property, types)]), of a header.

    A property has one type; a list has two, for its length and its values.
    """
    kind, elements = None, []
    for words in map(str.split, text.splitlines()):
        if words[:1] == ["format"]:
            kind = words[1] if words[1:] else None
        elif words[:1] == ["element"]:
            if any(words[1] == name for name, _, _ in elements):
                raise ValueError(f"one mesh expected, found two elements {words[1]!r}: {_REMEDY}")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            types = [PLY_TYPES.get(word) for word in words[1:-1] if word != "list"]
            if not elements or not all(types):
                line = " ".join(words)[:80]
                raise ValueError(
                    f"a property of an element, of a PLY type, expected, found {line!r}"
                )
            elements[-1][2].append((words[-1], types))
    if kind not in _PLY_ORDERS:
        orders = ", ".join(_PLY_ORDERS)
        raise ValueError(f"one of the formats {orders} expected in the header, found {kind}")
    for _, _, properties in elements:
        for _, types in properties:
            types[:] = [
                np.dtype("f8" if kind == "ascii" else _PLY_ORDERS[kind] + code) for code in types
            ]
    return kind, elements


def _ply_rows(body, at, name, count, properties):
    """Columns of an element, and the start of the next.

    The lists of corners are a column of polygons; other lists are skipped.  If rows differ in
    length, their other properties are skipped too.
    """
    least = sum(types[0].itemsize for _, types in properties)
    _need(count, (len(body) - at) // max(least, 1), f"rows of {name}")
    if count <= 0:
        return {key: np.empty(0) for key, types in properties if len(types) == 1}, at
    parts, end = _ply_row(body, at, properties)
    stride = end - at
    if parts is not None and at + count * stride <= len(body):
        kinds: list[Any] = [part[:2] if part[3] is None else (*part[:2], part[3]) for part in parts]
        rows = np.frombuffer(body, np.dtype(kinds), count, at)
        lists = {key: length for key, _, _, length in parts if length is not None}
        if all((rows[f"length {key}"] == length).all() for key, length in lists.items()):
            columns = {key: rows[key] for key, types in properties if len(types) == 1}
            for key in lists:
                if key.startswith("vertex_ind"):
                    columns[key] = _integers(rows[key]).ravel(), np.full(count, lists[key])
            return columns, at + count * stride
    return _ply_mixed_rows(body, at, name, count, properties)


def _ply_row(body, at, properties):
    """(name, type, begin, length or None) of each part of a row, None if truncated; and its end."""
    parts: list[Any] = []
    for key, types in properties:
        begin, at = at, at + types[0].itemsize
        if at > len(body):
            return None, at
        if len(types) == 1:
            parts.append((key, types[0], begin, None))
            continue
        length = int(np.frombuffer(body, types[0], 1, begin)[0])
        parts += [(f"length {key}", types[0], begin, None), (key, types[1], at, length)]
        at += length * types[1].itemsize
        if length < 0 or at > len(body):
            return None, at
    return parts, at


def _ply_mixed_rows(body, at, name, count, properties):
    """Polygons of the lists of corners, from rows of different length."""
    wanted = next((key for key, _ in properties if key.startswith("vertex_ind")), None)
    corners, sizes = [], []
    for row in range(count):
        parts, at = _ply_row(body, at, properties)
        if parts is None:
            _need(count, row, f"rows of {name}")
        for key, kind, begin, length in parts:
            if key == wanted and length is not None:
                corners.append(np.frombuffer(body, kind, length, begin))
                sizes.append(length)
    if wanted is None:
        return {}, at
    return {wanted: (_integers(np.concatenate(corners)), np.array(sizes))}, at


# OBJ, OFF, STL


def _read_obj(data):
    text = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")  # continued lines
    vertices, indices, sizes, n_before = [], [], [], []
    for line in text.splitlines():
        words = line.split()
        if words[:1] == [b"v"]:
            vertices.append(words[1:4])
        elif words[:1] == [b"f"]:
            indices += [word.partition(b"/")[0] for word in words[1:]]
            sizes.append(len(words) - 1)
            n_before.append(len(vertices))
    points = np.array(vertices, np.float64)
    short = sum(size < 3 for size in sizes)
    if short:
        raise ValueError(f"faces of 3 corners or more expected, found {short} with fewer")
    corners = np.array(indices, np.int64)
    if (corners == 0).any():
        raise ValueError("face indices from 1, or from -1 backwards, expected; found 0")
    # -1 is the last vertex before the face
    corners += np.where(corners > 0, -1, np.repeat(np.array(n_before, np.int64), sizes))
    return points, (corners, np.array(sizes, np.int64)), {}


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
    if more := len(lines) - 1 - n - m:
        raise ValueError(f"{_COUNTED}, found {more} more lines than its counts say: {_REMEDY}")
    points = np.array([line.split()[:3] for line in lines[1 : n + 1]], np.float64)
    corners, sizes = [], []
    for line in lines[n + 1 : n + 1 + m]:
        size, *words = line.split()  # colours may follow
        sizes.append(int(size))
        _need(sizes[-1], len(words), "corners of a face")
        corners += words[: sizes[-1]]
    return points, (np.array(corners, np.int64), np.array(sizes, np.int64)), {}


_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])


# at the start of a line, as the name of a solid is free text
_STL_FACETS = re.compile(rb"[\r\n][ \t]*(facet|vertex|endsolid)\b", re.I)
_STL_VERTEX = re.compile(rb"[\r\n][ \t]*vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.I)


def _is_binary_stl(data):
    """Whether data have the size of a binary STL, or else plausible triangles.

    Triangles of a file that is cut short, or longer than its triangles, have normals of length 1 or
    0 and coordinates within the range of those that programs write.
    """
    count = int.from_bytes(data[80:84], "little")
    if len(data) < 134 or len(data) == 84 + 50 * count:
        return len(data) >= 84 and len(data) == 84 + 50 * count
    rows = np.frombuffer(data, _STL_TRIANGLE, min((len(data) - 84) // 50, max(count, 1), 1000), 84)
    with np.errstate(all="ignore"):
        length = np.linalg.norm(rows["normal"].astype(float), axis=1)
        size = np.abs(rows["corner"].astype(float))
        is_normal = (np.abs(length - 1) < 0.01) | (length == 0)
        is_usual = (size == 0) | ((size > 1e-15) & (size < 1e15))
    return bool(is_normal.all() and is_usual.all() and size.any())


def _read_stl(data):
    """Distinct corners in order of appearance, and triangles: STL has no shared vertices."""
    count = int.from_bytes(data[80:84], "little")
    starts_as_ascii = re.match(rb"\s*solid\b", data, re.I) and b"\0" not in data[:1000]
    if starts_as_ascii and len(data) != 84 + 50 * count:
        vertices, words = _STL_VERTEX.findall(data), _STL_FACETS.findall(data.lower())
        _need(3 * words.count(b"facet"), len(vertices), "vertices of facets")
        _need(1, words[-1:].count(b"endsolid"), "endsolid at the end")
        if not re.fullmatch(b"(e|fvvv)*", b"".join(word[:1] for word in words)):
            raise ValueError("three vertices in every facet expected, found another number")
        corners = np.array(vertices, np.float64)
    else:
        _need(count, (len(data) - 84) // 50, "triangles")
        if len(data) >= 84 + 50 * (count + 1):
            raise ValueError(
                f"{count} triangles of {84 + 50 * count} bytes expected, found {len(data)} bytes: "
                f"{_REMEDY}"
            )
        corners = np.frombuffer(data, _STL_TRIANGLE, count, 84)["corner"].reshape(-1, 3)
    first, group = equal_rows(corners)
    rank = np.argsort(np.argsort(first))
    return corners[np.sort(first)], rank[group].reshape(-1, 3), {}


def _read_mz3(data):
    """Triangles and points of Surf Ice and NiiVue; colours and scalars may follow."""
    kind, m, n, skip = struct.unpack_from("<HIII", data, 2)
    if kind & 3 != 3:
        raise ValueError("triangles and vertices expected, found an overlay of values or colours")
    _need(12 * (m + n), len(data) - 16 - skip, "bytes of triangles and vertices")
    triangles = np.frombuffer(data, "<i4", 3 * m, 16 + skip).reshape(m, 3)
    return np.frombuffer(data, "<f4", 3 * n, 16 + skip + 12 * m).reshape(n, 3), triangles, {}


def _read_mni(data):
    """Polygons of MNI and CIVET: points, normals, colours, ends of the polygons, corners."""
    words = data.split()
    n = int(words[6])
    points = np.array(words[7 : 7 + 3 * n], np.float64)
    _need(6 * n + 2, len(words) - 7, "numbers of points and normals")
    m, colours = (int(word) for word in words[7 + 6 * n : 9 + 6 * n])
    at = 9 + 6 * n + 4 * {0: 1, 1: m, 2: n}.get(colours, 1)
    ends = np.array(words[at : at + m], np.int64)
    corners = np.array(words[at + m :], np.int64)
    _need(m, len(ends), "polygons")
    found = polygons(corners, np.r_[0, ends])
    _need(len(found[0]), len(corners), "corners of polygons")
    return points.reshape(-1, 3), found, {}


# containers of arrays


def gifti_arrays(data: bytes) -> list[tuple[str, Array]]:
    """Return the intent and the values of each array of a GIFTI file.

    Raises
    ------
    ValueError
        If an array is truncated, too large, or in another file.
    """
    root, arrays, total = xml(data), [], 0
    if root.tag != "GIFTI":
        raise ValueError(f"GIFTI expected, found {root.tag[:40]}")
    for node in root.findall("DataArray"):
        values = _gifti_values(node, limit_of(len(data)) - total)
        total += values.nbytes
        arrays.append((node.get("Intent", "").removeprefix("NIFTI_INTENT_"), values))
    expected = root.get("NumberOfDataArrays")
    if expected is not None and expected.strip() != str(len(arrays)):
        raise ValueError(f"expected {expected[:40]} arrays, found {len(arrays)}")
    return arrays


def _gifti_values(node, limit):
    order = ">" if node.get("Endian") == "BigEndian" else "<"
    dtype = _number_type(node.get("DataType"), order)
    shape = tuple(int(node.get(f"Dim{i}")) for i in range(6) if node.get(f"Dim{i}") is not None)
    expected = node.get("Dimensionality")
    if str(len(shape)) != expected or not shape or min(shape) < 0:
        raise ValueError(f"{expected} dimensions expected, found the sizes {shape}")
    text, encoding = node.findtext("Data") or "", node.get("Encoding")
    if encoding == "ASCII":
        values = np.array(text.split(), dtype)
    elif encoding in ("Base64Binary", "GZipBase64Binary"):
        raw = base64.b64decode(text)
        raw = unpack(raw, "zlib", limit) if encoding == "GZipBase64Binary" else raw
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
    if len(points) != 1 or len(triangles) != 1:
        raise ValueError(
            "one set of points and one of triangles expected, "
            f"found {len(points)} and {len(triangles)}: save each surface in a file of its own"
        )
    return points[0], _integers(triangles[0]), {}


def freesurfer_counts(data: bytes) -> tuple[int, int, int]:
    """Return the first byte after the counts, and the counts of vertices and triangles.

    The comment before the counts ends with an empty line, or with one line end.
    """
    ends = [re.match(rb"[^\n]*\n(?:\r?\n)?", data), re.match(rb"(?s).*?\n\r?\n", data[:4096])]
    n = m = -1
    for end in filter(None, ends):
        start = end.end() + 8
        n, m = (int(k) for k in np.frombuffer(data[start - 8 : start].ljust(8, b"\0"), ">i4"))
        if min(n, m) > 0 and 12 * (n + m) <= len(data) - start:
            return start, n, m
    if min(n, m) < 0:
        raise ValueError("a comment and counts of vertices and triangles expected at the start")
    _need(12 * (n + m), len(data) - start, "bytes of vertices and triangles")
    return start, n, m


def _read_freesurfer(data):
    start, n, m = freesurfer_counts(data)
    points = np.frombuffer(data, ">f4", 3 * n, start).reshape(n, 3)
    triangles = np.frombuffer(data, ">i4", 3 * m, start + 12 * n).reshape(m, 3)
    return points, triangles, {}


NPZ_KEYS = (
    ("V", "F"),
    ("vertices", "faces"),
    ("points", "triangles"),
    ("position", "corner_vertex"),
    ("X", "T"),
)


def _read_npz(data):
    arrays = npz(data)
    found = [keys for keys in NPZ_KEYS if set(keys) <= set(arrays)]
    if len(found) != 1:
        wanted = " or ".join(" and ".join(keys) for keys in NPZ_KEYS)
        names = ", ".join(arrays) or "nothing"
        remedy = "write each mesh to a file of its own" if found else "unpack it"
        raise ValueError(f"the keys {wanted} expected, found a ZIP archive of {names}: {remedy}")
    (keys,) = found
    points, triangles = (arrays[key]() for key in keys)
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"integer indices expected in {keys[1]}, found {triangles.dtype}")
    if points.dtype.kind not in "iuf":
        raise ValueError(f"numbers expected in {keys[0]}, found {points.dtype}")
    return points, triangles, {}


# writers


def _ply_bytes(X, T, scalars, title=""):
    names = ["x", "y", "z", *(re.sub(r"\s", "_", name) for name in scalars)]
    comment = f"comment {title}\n" if title else ""
    head = f"ply\nformat binary_little_endian 1.0\n{comment}element vertex {len(X)}\n"
    head += "".join(f"property float {name}\n" for name in names)
    head += f"element face {len(T)}\nproperty list uchar int vertex_indices\nend_header\n"
    vertex = np.column_stack([X, *scalars.values()]).astype("<f4")
    face = np.empty(len(T), [("length", "u1"), ("corners", "<i4", 3)])
    face["length"], face["corners"] = 3, T
    return head.encode() + vertex.tobytes() + face.tobytes()


def _obj_bytes(X, T, _, title=""):
    vertices = f"# {title}\n" * bool(title)
    vertices += "".join("v {!r} {!r} {!r}\n".format(*x) for x in X.tolist())
    return (vertices + "".join("f {} {} {}\n".format(*t) for t in (T + 1).tolist())).encode()


def _off_bytes(X, T, _, title=""):
    vertices = "".join("{!r} {!r} {!r}\n".format(*x) for x in X.tolist())
    faces = "".join("3 {} {} {}\n".format(*t) for t in T.tolist())
    comment = f"# {title}\n" * bool(title)
    return f"OFF\n{comment}{len(X)} {len(T)} 0\n{vertices}{faces}".encode()


def _stl_bytes(X, T, _, title=""):
    rows = np.zeros(len(T), _STL_TRIANGLE)
    rows["corner"] = X[T]
    return f"binary {title}".encode().ljust(80)[:80] + len(T).to_bytes(4, "little") + rows.tobytes()


_GIFTI_SPACES = {None: 2, "scanner": 1, "MNI152": 4}  # codes by origin


def _gifti_bytes(X, T, scalars, title=""):
    from nibabel.gifti import gifti  # imported here only

    found = re.search(r"SPACE=RAS.*?(?: ORIGIN=(\w+)|$)", title)
    code = _GIFTI_SPACES.get(found[1], 0) if found else 0
    space = gifti.GiftiCoordSystem(code, code)
    arrays = [("POINTSET", X.astype(np.float32), {}), ("TRIANGLE", T, {})]
    for name, values in scalars.items():
        arrays.append(("SHAPE", values.astype(np.float32), {"Name": name}))
    image = gifti.GiftiImage()
    for intent, values, words in arrays:
        meta = gifti.GiftiMetaData(words)
        image.add_gifti_data_array(
            gifti.GiftiDataArray(values, f"NIFTI_INTENT_{intent}", meta=meta, coordsys=space)
        )
    return image.to_bytes()


def _npz_bytes(X, T, scalars, title=""):
    out = io.BytesIO()
    np.savez_compressed(out, position=X, corner_vertex=T, **scalars)
    return out.getvalue()


SURFER = ".pial .white .inflated .orig .smoothwm .sphere"  # the name is the suffix: lh.pial
FORMATS = {
    "PLY": _Format(".ply", rb"ply[\r\n]", _read_ply, _ply_bytes, scalars=True),
    "OBJ": _Format(".obj", b"", _read_obj, _obj_bytes),
    "OFF": _Format(".off", rb"(ST)?C?N?OFF", _read_off, _off_bytes),
    "STL": _Format(".stl", b"", _read_stl, _stl_bytes),
    "VTK": _Format(".vtk", b"# vtk DataFile", _parse_vtk, vtk_bytes, scalars=True),
    "VTP": _Format(".vtp", b"<(.*<)?VTKFile", _parse_vtp, vtp_bytes, scalars=True),
    "GIFTI": _Format(".gii", b"<(.*<)?GIFTI", _read_gifti, _gifti_bytes, scalars=True),
    "NPZ": _Format(".npz", rb"PK\x03\x04", _read_npz, _npz_bytes, scalars=True),
    "FreeSurfer": _Format(SURFER, rb"\xff\xff\xfe", _read_freesurfer),
    "MZ3": _Format(".mz3", rb"MZ[\0-\x7f]\0", _read_mz3),
    "MNI": _Format(".obj", rb"P(\s+[-+.\de]+){5}\s+\d+\s", _read_mni),
}
