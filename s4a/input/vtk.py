"""VTK's polygonal data as far as a surface needs it (5, the data): legacy and XML files (.vtp)."""

import base64
import re
from xml.sax.saxutils import quoteattr

import numpy as np

from s4a.input.bounded import limit_of, unpack, xml

LEGACY_TYPES = {
    "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2", "int": "i4",
    "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtkidtype": "i8",
    "vtktypeint64": "i8", "vtktypeint32": "i4", "float": "f4", "double": "f8",
}  # fmt: skip
COMPRESSORS = {"vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}


def fans(corners: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Triangles ``(m, 3)`` of polygons whose corners stand one after the other.

    Parameters
    ----------
    corners : int ndarray (c,)
    offsets : int ndarray (p + 1,)
        Polygon i has the corners from ``offsets[i]`` to ``offsets[i + 1]``; those with fewer than
        three have no triangle.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.vtk import fans
    >>> fans(np.array([0, 1, 2, 4, 5, 6, 7]), np.array([0, 3, 7])).tolist()
    [[0, 1, 2], [4, 5, 6], [4, 6, 7]]
    """
    # 3---2   the first corner with each side away from it
    # | / |
    # 0---1
    falls = (offsets[1:] < offsets[:-1]).any()  # looked for here, as differences may overflow
    if falls or (len(offsets) and (offsets[0] < 0 or offsets[-1] > len(corners))):
        raise ValueError(f"polygons of {offsets[-1]} corners promised, found {len(corners)}")
    count = np.maximum(np.diff(offsets) - 2, 0)  # triangles of each polygon
    first = np.repeat(offsets[:-1], count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return corners[np.stack([first, first + step + 1, first + step + 2], axis=1)]


def number_type(name: str | None, order: str) -> np.dtype:
    """The dtype that an XML file names: Float32, or NIFTI_TYPE_UINT8; order is ``<`` or ``>``."""
    known = re.fullmatch(r"(?:NIFTI_TYPE_)?(u?int(8|16|32|64)|float(32|64))", name or "", re.I)
    if not known:
        raise ValueError(f"integers or floats expected, found {str(name)[:40]}")
    return np.dtype(order + np.dtype(known[1].lower()).str[1:])


# legacy files


def parse_vtk(data: bytes) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
    """Points, triangles and attributes of a legacy file with ``DATASET POLYDATA``."""
    file = _Legacy(data)
    if [word.upper() for word in file.line()] != [b"DATASET", b"POLYDATA"]:
        raise ValueError(
            "DATASET POLYDATA expected, found another dataset; save the surface as polydata"
        )
    points, triangles = None, [np.empty((0, 3), np.int64)]
    while words := file.line():
        section = words[0].upper()
        if section == b"POINTS":
            points = file.values(3 * int(words[1]), words[2]).reshape(-1, 3)
        elif section in (b"POLYGONS", b"LINES", b"VERTICES"):
            cells = file.polygons(int(words[1]), int(words[2]))
            if section == b"POLYGONS":
                triangles.append(cells)
        elif section == b"TRIANGLE_STRIPS":
            raise ValueError("triangle strips are not supported; save the surface as triangles")
        elif section in (b"POINT_DATA", b"CELL_DATA"):
            break
        elif section == b"METADATA":  # to the next empty line
            file.at = next(re.compile(rb"\n[ \t\r]*\n|\Z").finditer(data, file.at - 1)).end()
        elif section == b"FIELD":
            file.skip_fields(int(words[2]))
        else:
            raise ValueError(f"a section of polydata expected, found {words[0][:40]!r}")
    if points is None:
        raise ValueError("POINTS expected, found none")
    return points, np.concatenate(triangles), {}


class _Legacy:
    """The bytes of a legacy file and the place up to which they are read."""

    def __init__(self, data):
        head = re.match(rb"[^\n]*\n[^\n]*\n\s*(ASCII|BINARY)\s*\n", data, re.I)
        if not head:
            raise ValueError("two lines and ASCII or BINARY expected at the start")
        self.data, self.at, self.binary = data, head.end(), head[1].upper() == b"BINARY"

    def line(self):
        """Words of the next line that is not empty; none at the end."""
        line = next(re.compile(rb"\s*([^\n]*)").finditer(self.data, self.at))
        self.at = min(line.end() + 1, len(self.data))
        return line[1].split()

    def values(self, count, type_name):
        """The next numbers."""
        dtype = np.dtype(">" + LEGACY_TYPES[type_name.decode().lower()])
        room = len(self.data) - self.at
        if count < 0 or count * (dtype.itemsize if self.binary else 2) > room + 1:
            raise ValueError(
                f"expected {count} values of type {dtype.name}, found {room} bytes: "
                "the file is cut short"
            )
        if self.binary:
            start, self.at = self.at, self.at + count * dtype.itemsize
            return np.frombuffer(self.data, dtype, count, start)
        # to split all the rest for each of many short arrays would take the square of the size
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
        """Triangles of a section: each cell's count and corners, or offsets and corners (5.1)."""
        before = self.at
        words = self.line()
        if words and words[0].upper() == b"OFFSETS":
            offsets = self.values(n, words[1]).astype(np.int64)
            corners = self.values(size, self.line()[1])
            return fans(corners.astype(np.int64), offsets)
        self.at = before
        values = self.values(size, b"int").astype(np.int64)
        is_count = np.zeros(size, bool)
        is_count[_count_places(values, n)] = True
        return fans(values[~is_count], np.r_[0, np.cumsum(values[is_count])])

    def skip_fields(self, count):
        """Over arrays that stand before the points."""
        for _ in range(count):
            _, width, rows, type_name = self.line()
            n = int(width) * int(rows)
            if type_name.lower() != b"string":
                self.values(n, type_name)
            elif self.binary:
                raise ValueError(
                    "binary fields of strings before the points are not supported; "
                    "save without them"
                )
            else:
                for _ in range(min(n, len(self.data))):
                    self.line()


def _count_places(values, n):
    """Where the counts of n cells stand among `values` (count, corners, count, corners, ...)."""
    width = len(values) // n if n > 0 else 0
    if width and len(values) == n * width and (values[::width] == width - 1).all():
        return np.arange(0, len(values), width)  # all cells have the same
    places, at = [], 0
    for _ in range(n):
        if at >= len(values) or values[at] < 0:
            raise ValueError(f"expected {n} polygons, found {len(places)}")
        places.append(at)
        at += int(values[at]) + 1
    if at != len(values):
        raise ValueError(f"expected {len(values)} values for {n} polygons, found {at}")
    return np.array(places, np.int64)


def vtk_bytes(
    X: np.ndarray, T: np.ndarray, scalars: dict[str, np.ndarray], title: str = "surface"
) -> bytes:
    """A binary legacy file; 3D Slicer takes ``SPACE=RAS`` or ``SPACE=LPS`` from its title."""
    cells = np.column_stack([np.full(len(T), 3), T]).astype(">i4")
    parts = [
        b"# vtk DataFile Version 3.0\n%b\nBINARY\nDATASET POLYDATA\n" % title.encode("ascii"),
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


def vtp_bytes(X: np.ndarray, T: np.ndarray, arrays: dict[str, np.ndarray]) -> bytes:
    """An XML file whose arrays stand in base64.

    Parameters
    ----------
    X : float ndarray (n, 3)
    T : int ndarray (m, 3)
    arrays : dict of str to float ndarray (n,) or (n, c)
        Values, or vectors, of the points by name; kept as float32.
    """
    fields = "".join(
        _data_array(name, np.asarray(values, "<f4")) for name, values in arrays.items()
    )
    ends = np.arange(3, 3 * len(T) + 1, 3, dtype="<i8")
    cells = _data_array("connectivity", T.astype("<i8").ravel()) + _data_array("offsets", ends)
    piece = f'<Piece NumberOfPoints="{len(X)}" NumberOfPolys="{len(T)}">'
    return (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt64">\n<PolyData>\n{piece}\n<PointData>\n{fields}</PointData>\n'
        f"<Points>\n{_data_array('Points', X.astype('<f8'))}</Points>\n<Polys>\n{cells}</Polys>\n"
        "</Piece>\n</PolyData>\n</VTKFile>\n"
    ).encode()


def _data_array(name, values):
    kind = {"f4": "Float32", "f8": "Float64", "i8": "Int64"}[values.dtype.str[1:]]
    width = values.shape[1] if values.ndim == 2 else 1
    raw = np.array(values.nbytes, "<u8").tobytes() + np.ascontiguousarray(values).tobytes()
    return (
        f"<DataArray type={quoteattr(kind)} Name={quoteattr(name)} "
        f'NumberOfComponents="{width}" format="binary">'
        f"{base64.b64encode(raw).decode()}</DataArray>\n"
    )


def parse_vtp(data: bytes) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
    """Points, triangles and attributes of an XML file in any encoding, compressed or not."""
    file = _Xml(data)
    points, triangles, n_before = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for piece in file.root.iter("Piece"):
        if int(piece.get("NumberOfStrips") or 0):
            raise ValueError("triangle strips are not supported; save the surface as triangles")
        X = file.values(piece.find("Points/DataArray")).reshape(-1, 3)
        arrays = {"connectivity": np.empty(0, np.int64), "offsets": np.empty(0, np.int64)}
        for node in piece.findall("Polys/DataArray"):
            arrays[str(node.get("Name"))] = file.values(node).astype(np.int64)
        offsets = np.r_[0, arrays["offsets"]]
        for name, count in {"NumberOfPoints": len(X), "NumberOfPolys": len(offsets) - 1}.items():
            if int(piece.get(name) or 0) != count:
                raise ValueError(f"expected {name} = {piece.get(name)}, found {count}")
        triangles.append(fans(arrays["connectivity"], offsets) + n_before)
        points.append(X)
        n_before += len(X)
    return np.concatenate(points), np.concatenate(triangles), {}


class _Xml:
    """An XML file, with what it says of all of its arrays."""

    def __init__(self, data):
        appended = re.search(rb"<AppendedData([^<>]{0,400})>\s{0,99}_", data)
        self.appended: bytes | memoryview = b""
        self.appended_is_base64 = False
        self.limit = limit_of(len(data))  # bytes that its arrays may still have
        if appended:  # raw bytes are no XML
            self.appended_is_base64 = b"raw" not in appended[1]
            self.appended = memoryview(data)[appended.end() :]
            data = data[: appended.start()] + b"</VTKFile>"
        self.root = xml(data)
        if self.root.get("type") != "PolyData":
            raise ValueError(
                f"PolyData expected, found {self.root.get('type')}; save the surface as polydata"
            )
        self.order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        wide = self.root.get("header_type") == "UInt64"
        self.size_type = np.dtype(self.order + ("u8" if wide else "u4"))
        self.compressor = self.root.get("compressor")

    def values(self, node):
        """The numbers of a DataArray."""
        dtype, text = number_type(node.get("type"), self.order), node.text or ""
        if node.get("format") == "ascii":
            return np.array(text.split(), dtype)
        if node.get("format") == "appended":
            start = int(node.get("offset"))
            raw = self._unpack(self.appended[start:], self.appended_is_base64)
        else:
            raw = self._unpack(text.strip().encode(), True)
        self.limit -= len(raw)  # many arrays may name one place
        return np.frombuffer(raw, dtype)

    def _unpack(self, data, is_base64):
        """The bytes of one array: sizes stand first, then the array or its compressed blocks."""
        w = self.size_type.itemsize
        if not self.compressor:
            length = int(np.frombuffer(_take(data, 0, w, is_base64), self.size_type)[0])
            if length > self.limit:
                raise ValueError(
                    f"arrays of at most {self.limit} bytes more expected, found {length}"
                )
            return _take(data, w, length, is_base64)
        if self.compressor not in COMPRESSORS:
            raise ValueError(f"{' or '.join(COMPRESSORS)} expected, found {self.compressor}")
        # number of blocks, size of a block, size of the last one, compressed size of each
        blocks = int(np.frombuffer(_take(data, 0, w, is_base64), self.size_type)[0])
        sizes = np.frombuffer(_take(data, 3 * w, blocks * w, is_base64), self.size_type).tolist()
        start = (3 + blocks) * w
        if is_base64:  # sizes and blocks are encoded apart
            data, start = data[_base64_length(start) :], 0
        body = _take(data, start, sum(sizes), is_base64)
        parts, at, limit = [], 0, self.limit
        for size in sizes:
            parts.append(unpack(body[at : at + size], COMPRESSORS[self.compressor], limit))
            at += size
            limit -= len(parts[-1])
        return b"".join(parts)


def _base64_length(length):
    """Characters that encode so many bytes."""
    return 4 * -(-length // 3)


def _take(data, start, length, is_base64):
    """Bytes start .. start + length of what is encoded from the beginning of `data`."""
    end = start + length
    raw = base64.b64decode(data[: _base64_length(end)]) if is_base64 else data[:end]
    if len(raw) < end:
        raise ValueError(
            f"expected {length} bytes of an array, found {max(len(raw) - start, 0)}: "
            "the file is cut short"
        )
    return raw[start:end]
