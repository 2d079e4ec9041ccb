"""VTK's polygonal data: legacy files and XML files (.vtp), as far as a surface needs them (5.

The data).
"""

import base64
import itertools
import re

import numpy as np

from s4a.input.bounded import limit_of, unpack, xml

LEGACY_TYPES = {
    "char": "i1",
    "unsigned_char": "u1",
    "short": "i2",
    "unsigned_short": "u2",
    "int": "i4",
    "unsigned_int": "u4",
    "long": "i8",
    "unsigned_long": "u8",
    "vtkidtype": "i8",
    "vtktypeint64": "i8",
    "vtktypeint32": "i4",
    "float": "f4",
    "double": "f8",
}
XML_TYPES = {"Int": "i", "UInt": "u", "Float": "f"}
COMPRESSORS = {"vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}


def fans(connectivity, offsets):
    """Triangles of polygons whose corners stand one after the other.

    Polygon i from ``offsets[i]`` on.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.vtk import fans
    >>> fans(np.array([0, 1, 2, 4, 5, 6, 7]), np.array([0, 3, 7])).tolist()
    [[0, 1, 2], [4, 5, 6], [4, 6, 7]]
    """
    falls = (
        offsets[1:] < offsets[:-1]
    ).any()  # their differences could overflow, and look like sizes
    if falls or (len(offsets) and (offsets[0] < 0 or offsets[-1] > len(connectivity))):
        raise ValueError(f"polygons of {offsets[-1]} corners promised, found {len(connectivity)}")
    repeat = np.maximum(np.diff(offsets) - 2, 0)
    start = np.repeat(offsets[:-1], repeat)
    step = np.arange(repeat.sum()) - np.repeat(np.cumsum(repeat) - repeat, repeat)
    return connectivity[np.stack([start, start + step + 1, start + step + 2], axis=1)]


def parse_vtk(data):
    """Points, triangles and attributes of a legacy file with ``DATASET POLYDATA``.

    Ascii or binary.
    """
    reader = _Legacy(data)
    if [word.upper() for word in reader.line()] != [b"DATASET", b"POLYDATA"]:
        raise ValueError(
            "DATASET POLYDATA expected, found another dataset; save the surface as polydata"
        )
    points, triangles = None, [np.empty((0, 3), np.int64)]
    while words := reader.line():
        key = words[0].upper()
        if key == b"POINTS":
            points = reader.values(3 * int(words[1]), words[2]).reshape(-1, 3)
        elif key in (b"POLYGONS", b"LINES", b"VERTICES", b"TRIANGLE_STRIPS"):
            if key == b"TRIANGLE_STRIPS":
                raise ValueError("triangle strips are not supported; save the surface as triangles")
            found = reader.polygons(int(words[1]), int(words[2]))
            triangles += [found] if key == b"POLYGONS" else []
        elif key in (b"POINT_DATA", b"CELL_DATA"):
            break
        elif key == b"METADATA":
            reader.skip_metadata()
        elif key == b"FIELD":
            reader.skip_fields(int(words[2]))
        else:
            raise ValueError(f"a section of polydata expected, found {words[0][:40]!r}")
    if points is None:
        raise ValueError("POINTS expected, found none")
    return points, np.concatenate(triangles), {}


class _Legacy:
    """A place in the bytes of a legacy file."""

    def __init__(self, data):
        head = re.match(rb"[^\n]*\n[^\n]*\n\s*(ASCII|BINARY)\s*\n", data, re.I)
        if not head:
            raise ValueError("two lines and ASCII or BINARY expected at the start")
        self.data, self.at, self.binary = data, head.end(), head[1].upper() == b"BINARY"

    def line(self):
        """Words of the next line that is not empty; none at the end."""
        found = re.compile(rb"\s*([^\n]*)").match(self.data, self.at)
        self.at = min(found.end() + 1, len(self.data))
        return found[1].split()

    def values(self, count, type_name):
        dtype = np.dtype(">" + LEGACY_TYPES[type_name.decode().lower()])
        room = len(self.data) - self.at
        if count < 0 or count * (dtype.itemsize if self.binary else 2) > room + 1:
            raise ValueError(
                f"expected {count} values of type {dtype.name}, found {room} bytes: the file is cut short"
            )
        if self.binary:
            start, self.at = self.at, self.at + count * dtype.itemsize
            return np.frombuffer(self.data, dtype, count, start)
        end = min(
            self.at + 64 * count + 1000, len(self.data)
        )  # the rest is not copied for each of many short arrays
        words = self.data[self.at : end].split(None, count)
        if len(words) <= count:
            end = len(self.data)
            words = self.data[self.at :].split(None, count)
        if len(words) < count:
            raise ValueError(f"expected {count} values, found {len(words)}: the file is cut short")
        self.at = end - sum(map(len, words[count:]))
        return np.array(words[:count], dtype.newbyteorder("="))

    def polygons(self, n, size):
        """Triangles of a section of cells.

        Counts between the corners, or offsets and connectivity (5.1).
        """
        before = self.at
        words = self.line()
        if words and words[0].upper() == b"OFFSETS":
            offsets = self.values(n, words[1])
            return fans(
                self.values(size, self.line()[1]).astype(np.int64), offsets.astype(np.int64)
            )
        self.at = before
        values = self.values(size, b"int").astype(np.int64)
        starts = _starts(values, n)
        keep = np.ones(len(values), bool)
        keep[starts] = False
        return fans(values[keep], np.r_[0, np.cumsum(values[starts])])

    def skip_metadata(self):
        """To the next empty line."""
        self.at = re.compile(rb"\n[ \t\r]*\n|\Z").search(self.data, self.at - 1).end()

    def skip_fields(self, count):
        for _ in range(count):
            _, width, rows, type_name = self.line()
            n = int(width) * int(rows)
            if type_name.lower() != b"string":
                self.values(n, type_name)
            elif self.binary:
                raise ValueError(
                    "binary fields of strings before the points are not supported; save without them"
                )
            else:
                for _ in range(min(n, len(self.data))):
                    self.line()


def _starts(values, n):
    """Where the counts of n cells stand among `values` (count, corners, count, corners, ...)."""
    if n and len(values) % n == 0 and (values[:: len(values) // n] == len(values) // n - 1).all():
        return np.arange(0, len(values), len(values) // n)
    starts, at = [], 0
    for _ in range(n):
        if at >= len(values) or values[at] < 0:
            raise ValueError(f"expected {n} polygons, found {len(starts)}")
        starts.append(at)
        at += int(values[at]) + 1
    if at != len(values):
        raise ValueError(f"expected {len(values)} values for {n} polygons, found {at}")
    return np.array(starts, np.int64)


def vtk_bytes(X, T, scalars):
    """A binary legacy file."""
    cells = np.column_stack([np.full(len(T), 3), T])
    parts = [b"# vtk DataFile Version 3.0\nsurface\nBINARY\nDATASET POLYDATA\n"]
    parts += [b"POINTS %d double\n" % len(X), X.astype(">f8").tobytes()]
    parts += [b"\nPOLYGONS %d %d\n" % (len(T), cells.size), cells.astype(">i4").tobytes(), b"\n"]
    parts += [b"POINT_DATA %d\n" % len(X)] if scalars else []
    for name, values in scalars.items():
        label = re.sub(r"\s", "_", name).encode()
        parts += [
            b"SCALARS %s float 1\nLOOKUP_TABLE default\n" % label,
            values.astype(">f4").tobytes(),
            b"\n",
        ]
    return b"".join(parts)


def parse_vtp(data):
    """Points, triangles and attributes of an XML file.

    Inline or appended, ascii, base64 or raw, compressed or not.
    """
    appended = re.search(rb"<AppendedData([^<>]{0,400})>\s{0,99}_", data)
    encoding, blob = None, b""
    if appended:  # raw bytes are no XML
        encoding, blob = (
            "raw" if b"raw" in appended[1] else "base64",
            memoryview(data)[appended.end() :],
        )
        data = data[: appended.start()] + b"</VTKFile>"
    root = xml(data)
    if root.get("type") != "PolyData":
        raise ValueError(
            f"PolyData expected, found {root.get('type')}; save the surface as polydata"
        )
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    size = np.dtype(order + ("u8" if root.get("header_type") == "UInt64" else "u4"))
    compressor, left = root.get("compressor"), limit_of(len(data) + len(blob))

    def array(node):
        nonlocal left
        kind, bits = re.match(r"([A-Za-z]+)(\d+)", node.get("type")).groups()
        dtype = np.dtype(f"{order}{XML_TYPES[kind]}{int(bits) // 8}")
        how = node.get("format")
        if how == "ascii":
            return np.array((node.text or "").split(), dtype)
        if how == "appended":
            found = _unpack(
                blob[int(node.get("offset")) :], encoding == "base64", size, compressor, left
            )
        else:
            found = _unpack((node.text or "").strip().encode(), True, size, compressor, left)
        left -= len(found)  # many arrays may name one place
        return np.frombuffer(found, dtype)

    points, triangles, before = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for piece in root.iter("Piece"):
        if int(piece.get("NumberOfStrips") or 0):
            raise ValueError("triangle strips are not supported; save the surface as triangles")
        xyz = array(piece.find("Points/DataArray")).reshape(-1, 3)
        polys = {
            node.get("Name"): array(node).astype(np.int64)
            for node in piece.findall("Polys/DataArray")
        }
        offsets = np.r_[0, polys.get("offsets", np.empty(0, np.int64))]
        for name, found in {"NumberOfPoints": len(xyz), "NumberOfPolys": len(offsets) - 1}.items():
            if int(piece.get(name) or 0) != found:
                raise ValueError(f"expected {name} = {piece.get(name)}, found {found}")
        triangles.append(fans(polys.get("connectivity", np.empty(0, np.int64)), offsets) + before)
        points.append(xyz)
        before += len(xyz)
    return np.concatenate(points), np.concatenate(triangles), {}


def _unpack(data, is_base64, size, compressor, limit):
    """The bytes of one array, `limit` at most.

    A header of sizes, then the array or its compressed blocks.
    """

    def take(start, length):
        """Bytes start .. start + length of what is encoded from the beginning of `data`."""
        if is_base64:
            text = data[: 4 * -(-(start + length) // 3)]
            found = base64.b64decode(text)[start : start + length]
        else:
            found = data[start : start + length]
        if len(found) < length:
            raise ValueError(
                f"expected {length} bytes of an array, found {len(found)}: the file is cut short"
            )
        return found

    w = size.itemsize
    if not compressor:
        length = int(np.frombuffer(take(0, w), size)[0])
        if length > limit:
            raise ValueError(f"arrays of at most {limit} bytes more expected, found {length}")
        return take(w, length)
    if compressor not in COMPRESSORS:
        raise ValueError(f"{' or '.join(COMPRESSORS)} expected, found {compressor}")
    blocks = int(np.frombuffer(take(0, w), size)[0])
    lengths = np.frombuffer(take(3 * w, blocks * w), size).tolist()
    start = (3 + blocks) * w
    if is_base64:  # header and blocks are encoded apart
        data, start = data[4 * -(-start // 3) :], 0
    body, ends = take(start, sum(lengths)), np.cumsum([0, *lengths])
    parts = []
    for a, b in itertools.pairwise(ends):
        parts.append(unpack(body[a:b], COMPRESSORS[compressor], limit))
        limit -= len(parts[-1])
    return b"".join(parts)
