"""Annotations of a mesh (6.2): read and write labels, landmarks and scalar fields."""

import csv
import io
import json
import logging
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from s4a.input.coordinates import CoordinateSystem, map_between, moved, only
from s4a.input.files import stem_of
from s4a.input.formats import gifti_arrays, ply_properties
from s4a.input.raw import check_there, content, npy, npz, reading, shown, text_of, xml
from s4a.options import MILLIMETRES, check_unit
from s4a.schema import Array, check_rows, dataset, require, unit_of

log = logging.getLogger(__name__)

LONGEST = 255  # characters of a name, as NumPy pads each text to the longest
_MARKUPS = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/"
    "Resources/Schema/markups-schema-v1.0.3.json#"
)
_FORMULA = r"[=+@\t\r#-]."  # the beginning of a formula of a spreadsheet, or of a comment


def read_labels(path: Path | str, n: int | None = None) -> Array:
    """Read one label per vertex from a file.

    Parameters
    ----------
    path : str or Path
        NPY; NPZ, ``FILE.npz:NAME`` if several arrays fit; CSV or text with a row per vertex, or
        with a header, the column ``label`` and optionally the index ``vertex``; GIFTI label (.gii);
        FreeSurfer .annot, whose labels are rows of the colour table, -1 for annotation 0.  Files
        may be compressed by gzip (.annot.gz).
    n : int, optional
        Number of vertices in the file of the mesh.

    Returns
    -------
    ndarray (n,)
        Integers or strings.

    Raises
    ------
    ValueError
        If the file is missing, cannot be read as labels, or does not have `n` values.
    """
    before, _, name = str(path).partition(".npz:")
    file = Path(f"{before}.npz" if name else before)
    check_there(file)
    kind = Path(file.name.lower().removesuffix(".gz")).suffix
    readers = {".npy": npy, ".gii": _gifti_vector, ".annot": _annot_labels}
    with reading(path, "labels"):
        data = content(file)
        if kind == ".npz" or zipfile.is_zipfile(io.BytesIO(data)):
            labels = _npz_labels(data, file.name, name, n)
        else:
            labels = np.asarray(readers.get(kind, _text_labels)(data))
    labels = labels[:, 0] if labels.ndim == 2 and labels.shape[1] == 1 else labels
    _check_length(path, labels, n, "label")
    wrong: Any = labels.dtype
    if labels.dtype.kind == "f":
        is_fraction = (np.round(labels) != labels) | ~(np.abs(labels) < 2**53)
        if not is_fraction.any():
            return labels.astype(np.int64)
        wrong = labels[is_fraction][0]
    if labels.dtype.kind not in "iubU":
        raise ValueError(f"{shown(path)}: labels need integers or names, found {wrong}")
    return labels


def _check_length(path, values, n, what):
    if values.ndim != 1 or n not in (None, len(values)):
        wanted = f"one {what} per vertex" if n is None else f"{n} {what}s, one per vertex"
        of_file = " of the file of the mesh," if n and what == "label" else "," * (n is not None)
        raise ValueError(
            f"{shown(path)}: {wanted}{of_file} needed, found an array of shape {values.shape}"
        )


def _npz_labels(data, file, name, n):
    arrays = npz(data)
    if name:
        if name not in arrays:
            raise ValueError(f"an array {name!r} needed, found {', '.join(arrays)}")
        return arrays[name]()
    columns = {key: read() for key, read in arrays.items()}
    fitting = [
        key for key, values in columns.items() if values.ndim == 1 and n in (None, len(values))
    ]
    if len(fitting) != 1:
        shapes = ", ".join(f"{key} {values.shape}" for key, values in columns.items())
        wanted = "one array" if n is None else f"one array of {n} values"
        raise ValueError(f"{wanted} needed, found {shapes}; name it as {file}:NAME")
    return columns[fitting[0]]


def _gifti_vector(data, intent="LABEL"):
    """The array of labels, if there is one, or of one dimension, in the order of the vertices."""
    arrays = gifti_arrays(data)
    index = [values for of, values in arrays if of == "NODE_INDEX"]
    arrays = [(of, values) for of, values in arrays if of != "NODE_INDEX"]
    found = [values for of, values in arrays if of == intent]
    found = found or [values for _, values in arrays if values.ndim == 1]
    if not found:
        raise ValueError("a GIFTI array of one dimension needed, found none")
    if len(found) > 1:
        log.warning("the first of %d arrays of a GIFTI file is used", len(found))
    if index:
        _check_vertices(index[0])
    return found[0][np.argsort(index[0])] if index else found[0]


class _Cursor(io.BytesIO):
    """Reader of consecutive big-endian integers and length-prefixed texts."""

    def take(self, count):
        """Read the next bytes."""
        rest = len(self.getbuffer()) - self.tell()
        if not 0 <= count <= rest:
            raise ValueError(f"expected {count} bytes, found {rest}: the file is cut short")
        return self.read(count)

    def numbers(self, count):
        return np.frombuffer(self.take(4 * count), ">i4").astype(np.int64)

    def number(self):
        return int(self.numbers(1)[0])


def _annot_labels(data):
    """Row of the colour table of each vertex.

    nibabel accepts annotations that are not in the table, and allocates the memory of damaged
    counts: more than 2 GiB for 325 of 2,000 damaged files.
    """
    file = _Cursor(data)
    vertex, annotation = file.numbers(2 * file.number()).reshape(-1, 2).T
    _check_vertices(vertex)
    if not file.number():
        raise ValueError("a colour table expected, found none")
    row_of_colour = _colour_table(file)
    # -1 and 0 are no region; a value may have the colour's alpha, or not
    rows = {
        value: row_of_colour.get(value, row_of_colour.get(value % 2**24))
        for value in np.unique(annotation).tolist()
    } | {-1: -1}
    unknown = [value for value, row in rows.items() if row is None]
    if unknown:
        raise ValueError(
            f"annotations of the colour table expected, found {unknown[:3]}, which are not in it"
        )
    of_vertex = [rows[value] for value in annotation.tolist()]
    return np.array(of_vertex, np.int64)[np.argsort(vertex)]


def _colour_table(file):
    """Row of each colour, -1 for none; in version 2, the file numbers the rows."""
    count = file.number()
    numbered = count < 0
    if numbered:
        if count != -2:
            raise ValueError(f"a colour table of version 2 expected, found {-count}")
        file.number()
    file.take(file.number())  # name of the original file
    row_of_colour = {}
    for i in range(file.number() if numbered else count):
        row = file.number() if numbered else i
        file.take(file.number())  # name of the structure
        colour = np.array(file.numbers(4), "u1").view("<i4").item()
        if row_of_colour.setdefault(colour, row) != row:
            log.warning(
                "rows %d and %d of a colour table have one colour, so the label of both is %d",
                row_of_colour[colour],
                row,
                row_of_colour[colour],
            )
    opaque = {colour % 2**24: row for colour, row in row_of_colour.items()}
    return opaque | row_of_colour | {0: -1}


def table_rows(text: str) -> dict[int, list[str]]:
    """Split a table at commas, semicolons, tabs or spaces; rows by the number of their last line.

    Empty lines and comments, which begin with ``#``, are skipped, as is Excel's ``sep=;``.

    Examples
    --------
    >>> from s4a.input.annotations import table_rows
    >>> table_rows("name;x\\n# a comment\\na;1")
    {1: ['name', 'x'], 3: ['a', '1']}
    """
    lines = {
        number: line
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not re.match("#|sep=.$", line)
    }
    if not lines:
        raise ValueError("the file is empty")
    numbers, texts = list(lines), list(lines.values())
    mark = next((mark for mark in ",;\t" if mark in texts[0]), " ")
    for line in text.splitlines():
        if line[:1] == "#" and line.count(mark) == texts[0].count(mark) > 0 and mark != " ":
            log.warning("a row that begins with # is skipped as a comment: %s", shown(line[:60]))
    rows = {}
    for row in (reader := csv.reader(texts, delimiter=mark, skipinitialspace=True)):
        cells = (cell.strip() for cell in row)
        rows[numbers[reader.line_num - 1]] = [re.sub(f"^'(?={_FORMULA})", "", c) for c in cells]
    return rows


def write_rows(path: Path, rows: Iterable[Iterable[Any]]) -> Path:
    """Write a CSV file and return its path.

    A text that would be a formula of a spreadsheet or a comment gets an apostrophe, which
    :func:`table_rows` removes.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from s4a.input.annotations import write_rows
    >>> path = Path(tempfile.mkdtemp()) / "table.csv"
    >>> write_rows(path, [["a", "=1+1", "-3.2", -3.2]]).read_text().strip()
    "a,'=1+1,-3.2,-3.2"
    """
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([[_escaped(cell) for cell in row] for row in rows])
    return path


def _escaped(cell):
    is_formula = isinstance(cell, str) and re.match(_FORMULA, cell) and not is_number(cell)
    return f"'{cell}" if is_formula else cell


def _check_cells(rows, n, least):
    """Raise ValueError unless every row has `least` to `n` cells, not counting empty ones after."""
    for line, row in rows.items():
        if len(row) < least or any(row[n:]):
            raise ValueError(
                f"line {line} needs {n} cells, as in the first row; found {len(row)}: "
                f"{', '.join(row)[:60]!r}"
            )


def _number_of(cell, line):
    """Number in a cell, or ValueError with its line."""
    if not is_number(cell):
        raise ValueError(f"line {line} needs a number, found {cell[:40]!r}")
    return float(cell)


def short(texts: list[str]) -> list[str]:
    """Return `texts`; ValueError if one is so long that an array of them could fill the memory."""
    longest = max(map(len, texts), default=0)
    if longest > LONGEST:
        raise ValueError(f"names of at most {LONGEST} characters expected, found one of {longest}")
    return texts


def is_number(text: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _text_labels(data):
    if data.startswith(b"#!ascii label"):
        raise ValueError(
            "one label for every vertex expected, found some vertices (a FreeSurfer label): "
            "convert it to .annot by mris_label2annot"
        )
    cells = _column(text_of(data), "label", str.lower, lambda head: head == "label")
    if all(map(is_number, cells.values())):
        return np.array([float(cell) for cell in cells.values()])
    return np.array(short(list(cells.values())))


def _column(text, name, case, is_head):
    """Cells of a column by line, in the order of the column ``vertex`` if there is one.

    `case` changes the cells of the header; `is_head` says whether a single cell is one.
    """
    rows = table_rows(text)
    header = next(iter(rows.values()))
    head, n = [case(cell) for cell in header], len(header)
    if n > 1 and head.count(name) != 1:
        raise ValueError(f"one column {name!r} needed, found {', '.join(header)[:80]}")
    at = head.index(name) if n > 1 else 0
    if n > 1 or is_head(head[0]):
        del rows[next(iter(rows))]
    head = [cell.lower() for cell in head]
    _check_cells(rows, n, 1 + at)
    lines = list(rows)
    if n > 1 and "vertex" in head:
        column = head.index("vertex")
        _check_cells(rows, n, 1 + column)
        vertex = np.array([_number_of(row[column], line) for line, row in rows.items()])
        _check_vertices(vertex)
        lines = [lines[i] for i in np.argsort(vertex)]
    return {line: rows[line][at] for line in lines}


def _check_vertices(vertex):
    """Raise ValueError unless every vertex is there once."""
    if not np.array_equal(np.sort(vertex), np.arange(len(vertex))):
        raise ValueError(f"every vertex from 0 to {len(vertex) - 1} needed once")


def read_landmarks(path: Path | str) -> xr.Dataset:
    """Read landmarks from a file.

    Parameters
    ----------
    path : str or Path
        3D Slicer .mrk.json (points, curves, closed curves), .fcsv or CSV (``label,l,p,s``); CSV
        ``name,x,y,z`` (a header is optional; with one, also ``curve``, the name of the curve or
        empty, and ``closed``); TPS, ``FILE.tps:ID`` if it has several specimens; .pts; Scalismo's
        JSON; or the XML of MeshLab's picked points (.pp).  Files may be compressed by gzip.

    Returns
    -------
    Dataset
        ``landmark_name(landmark)``, ``landmark_position(landmark, xyz)``; for curves, the points in
        order with ``landmark_curve`` and ``landmark_closed``; attributes ``coordinate_system`` and
        ``unit`` if the file has them (:mod:`s4a.input.coordinates`).

    Raises
    ------
    ValueError
        If the file is missing or has no points, or a curve has only one point.
    """
    before, tps, specimen = str(path).partition(".tps:")
    path = Path(f"{before}.tps" if tps else path)
    check_there(path)
    with reading(path, "landmarks"):
        text = text_of(content(path))
        first = text.lstrip()[:1]
        reader = {"{": _slicer_points, "[": _scalismo_points, "<": _meshlab_points}.get(first)
        if re.match(r"\s*LM3?\s*=", text, re.I):
            text, reader = _specimen(text, specimen), _tps_points
        elif re.match(r"\s*version\b", text, re.I):
            reader = _pts_points
        system, rows = (reader or _table_points)(text)
        # name, position (None if it is not set), curve, closed
        rows = [(str(row[0]) or str(i), *row[1:], "", False)[:4] for i, row in enumerate(rows, 1)]
        unset = [name for name, position, *_ in rows if position is None]
        if unset:
            text = "%s: landmarks without a position are left out: %s"
            log.warning(text, shown(path), shown(", ".join(unset)))
        rows = [row for row in rows if row[1] is not None]
        sizes = {len(position) for _, position, *_ in rows}
        if sizes != {3}:
            raise ValueError(f"points of 3 coordinates needed, found {len(rows)} of {sizes or 0}")
        names, positions, curve, closed = zip(*rows, strict=True)
        points = np.array(positions, float)
        if not np.isfinite(points).all():
            raise ValueError("points with finite coordinates needed")
        single = [name for name, count in Counter(curve).items() if name and count < 2]
        if single:
            raise ValueError(f"a curve needs at least two points; {single[0]!r} has one")
        texts = short(list(names))
        curves = short([str(name) for name in curve])
    data = {"landmark_name": np.array(texts), "landmark_position": points}
    if any(curves):
        data |= {"landmark_curve": np.array(curves), "landmark_closed": np.array(closed, bool)}
    return dataset(system.attrs, **data)


def _specimen(text, name):
    """Lines of one specimen of a TPS file."""
    specimens = re.split(r"(?im)^(?=[ \t]*LM3?\s*=)", text)[1:]
    ids = [
        found[1] if (found := re.search(r"(?im)^ID\s*=\s*(.*?)\s*$", s)) else "" for s in specimens
    ]
    chosen = [s for s, one in zip(specimens, ids, strict=True) if not name or one == name]
    if len(chosen) != 1:
        raise ValueError(
            f"one specimen needed, found {', '.join(ids)}: choose one as FILE.tps:{ids[0]}"
        )
    return chosen[0]


def _tps_points(text):
    head, *lines = [line.strip() for line in text.splitlines() if line.strip()]
    n = int(head.partition("=")[2])
    scale = re.search(r"(?im)^SCALE\s*=\s*(\S+)", text)
    points = [line.split() for line in lines[:n] if "=" not in line]
    others = [line for line in lines[n:] if not re.match(r"(?i)(ID|IMAGE|SCALE|COMMENT)\s*=", line)]
    if others:
        raise ValueError(f"{n} points and their ID needed, found the line {others[0][:40]!r}")
    factor = float(scale[1]) if scale else 1.0
    return CoordinateSystem(), _counted([("", factor * np.array(p, float)) for p in points], n)


def _pts_points(text):
    """Points of IDAV's Landmark editor, or of other files that begin with a version."""
    head, *lines = [line.strip() for line in text.splitlines()[1:] if line.strip(" \t{}")]
    rows = [line.split() for line in lines]
    rows = [(row[0], row[1:]) if len(row) == 4 else ("", row) for row in rows]
    return CoordinateSystem(), _counted(rows, int(head.split()[-1]))


def _counted(rows, n):
    if len(rows) != n:
        raise ValueError(f"{n} points needed, found {len(rows)}")
    return rows


def _scalismo_points(text):
    return CoordinateSystem(), [(mark["id"], mark["coordinates"]) for mark in json.loads(text)]


_AXES = {"0": "RAS", "1": "LPS"}  # numbers of coordinate systems of 3D Slicer


def _slicer_points(text):
    lists = json.loads(text)["markups"]
    axes = "coordinateSystem"  # of a list, or of a point
    systems = {
        _AXES.get(text := str(p.get(axes, m.get(axes, "LPS"))).upper(), text)
        for m in lists
        for p in (m, *(m.get("controlPoints") or []))
    }
    rows, taken = [], set()
    for i, m in enumerate(lists, 1):
        curve = ""
        if m.get("type") in ("Curve", "ClosedCurve"):
            curve = m.get("name") or f"curve_{i}"
            curve = f"{curve}_{i}" if curve in taken else curve
            taken.add(curve)
        for p in m.get("controlPoints") or []:  # a region of interest may have none
            position = p["position"] if p.get("positionStatus", "defined") == "defined" else None
            rows.append((p.get("label", ""), position, curve, m.get("type") == "ClosedCurve"))
    # a unit may be a list of its code, the scheme of the code and its meaning
    units = {np.ravel(m.get("coordinateUnits") or "mm").tolist()[0] for m in lists}
    return _system_of(systems, units), rows


def _system_of(systems, units):
    """Coordinate system of landmarks; ValueError if several are stated."""
    system, unit = only("coordinate system", systems), only("unit", units)
    return CoordinateSystem.of({"coordinate_system": system, "unit": unit and check_unit(unit)})


def _meshlab_points(text):
    points = [(p, [p.get(axis) for axis in "xyz"]) for p in xml(text).iter("point")]
    rows = [(p.get("name", ""), None if p.get("active") == "0" else x) for p, x in points]
    return CoordinateSystem(), rows


_NAMES = ("name", "label", "landmark", "point", "id", "")  # the last of an index of pandas
_TRUE = ("1", "true", "yes")
# values of points that have a position; numbers: 0 undefined, 1 preview, 2 defined, 3 missing
_SET = {"positionstatus": ("", "2", "defined"), "defined": ("", *_TRUE)}


def _table_points(text):
    columns = re.compile(r"(?m)^#\s*columns\s*=\s*")
    stated = [r"(?:SPACE|CoordinateSystem)\s*=\s*(\w+)", r"UNIT\s*=\s*(um|mm|cm|m|in)\b"]
    found = [re.findall(rf"(?m)^#.*?\b{one}", text) for one in stated]
    axes, unit = map(only, ("coordinate system", "unit"), found)
    if columns.search(text):  # .fcsv of 3D Slicer, of old versions without a system, or with 0
        axes, unit = axes or "0", unit or "mm"
    systems, units = [_AXES.get(axes, axes)], [unit]
    rows = table_rows(columns.sub("", text, count=1))
    header = next(iter(rows.values()))
    if columns.search(text) and len(header) == 14:
        header += ["positionstatus", "created"]  # of 3D Slicer 5, which does not name them
    head = [cell.lower() for cell in header]
    name, curve, closed, status = None, None, None, None
    systems_of_axes = (a for a in ("xyz", "lps", "ras") if all(head.count(x) == 1 for x in a))
    letters = next(systems_of_axes, "")
    if letters:
        x = [head.index(axis) for axis in letters]
        name = next((head.index(n) for n in _NAMES if n in head), None)
        curve, closed = (head.index(n) if n in head else None for n in ("curve", "closed"))
        del rows[next(iter(rows))]
        status = next((head.index(n) for n in _SET if n in head), None)
        systems += _column_of("coordinate_system", head, rows)
        units += _column_of("unit", head, rows)
        if letters != "xyz":  # of 3D Slicer
            systems.append(letters.upper())
            units = units if any(units) else ["mm"]
    elif len(head) in (3, 4) and all(map(is_number, header[-3:])):
        x = list(range(len(head) - 3, len(head)))
        name = 0 if len(head) == 4 else None
    else:
        raise ValueError(f"the columns name, x, y and z needed, found {', '.join(header)}")
    used = [i for i in (*x, name, curve, closed) if i is not None]
    _check_cells(rows, len(head), 1 + max(used))
    points = []
    for line, row in rows.items():
        label, of_curve, is_closed = ("" if i is None else row[i] for i in (name, curve, closed))
        is_set = status is None or "".join(row[status : status + 1]).lower() in _SET[head[status]]
        position = [_number_of(row[i], line) for i in x] if is_set else None
        points.append((label, position, of_curve, is_closed.lower() in _TRUE))
    return _system_of(systems, units), points


def _column_of(name, head, rows):
    """Cells of a column, if there is one."""
    at = head.index(name) if name in head else len(head)
    return [row[at] for row in rows.values() if at < len(row)]


def write_landmarks(path: Path | str, landmarks: xr.Dataset) -> None:
    """Write landmarks as CSV or, if the name ends in ``.mrk.json``, as markups of 3D Slicer.

    CSV has the columns ``name,x,y,z``, and ``curve,closed`` for curves.  Markups have a list of
    points and a list for each curve, in the axes of the attribute ``coordinate_system`` of the
    landmarks, else in LPS, the default of 3D Slicer.  Surface RAS becomes scanner RAS.
    """
    require(landmarks, "landmark_name", "landmark_position", what="landmarks")
    if Path(path).name.lower().endswith(".mrk.json"):
        text = json.dumps(_markups(landmarks), indent=1)
        Path(path).write_text(text + "\n", encoding="utf-8")
        return
    columns = [landmarks["landmark_name"].values]
    columns += list(landmarks["landmark_position"].values.astype(float).T)
    head = ["name", "x", "y", "z"]
    if "landmark_curve" in landmarks:
        head += ["curve", "closed"]
        columns += [landmarks["landmark_curve"].values, landmarks["landmark_closed"].values]
    write_rows(Path(path), [head, *zip(*(column.tolist() for column in columns), strict=True)])


def _markups(landmarks):
    """Content of a file of markups, as 3D Slicer writes it."""
    unit = unit_of(landmarks["landmark_position"])
    own = CoordinateSystem.of(landmarks.attrs | ({"unit": unit} if unit in MILLIMETRES else {}))
    written = own.in_world("LPS" if own.axes == "LPS" else "RAS", "mm")
    M = map_between(own, written, "landmarks")
    frame = {"coordinateSystem": written.axes or "LPS"}
    frame |= {"coordinateUnits": "mm"} if written.unit else {}
    upright = 1.0 if written.axes == "RAS" else -1.0  # the axes of a point are those of RAS
    n = landmarks.sizes["landmark"]
    curves = landmarks["landmark_curve"].values if "landmark_curve" in landmarks else np.full(n, "")
    closed = (
        landmarks["landmark_closed"].values if "landmark_closed" in landmarks else np.zeros(n, bool)
    )
    names = landmarks["landmark_name"].values.tolist()
    positions = moved(landmarks["landmark_position"].values.astype(float), M).tolist()
    orientation = [upright, 0.0, 0.0, 0.0, upright, 0.0, 0.0, 0.0, 1.0]
    shared = {"orientation": orientation, "selected": True, "locked": False, "visibility": True}
    points = [
        {"id": str(i + 1), "label": names[i], "position": positions[i]}
        | shared
        | {"positionStatus": "defined"}
        for i in range(len(names))
    ]
    lists = []
    for curve in dict.fromkeys(curves.tolist()):
        index = np.flatnonzero(curves == curve)
        kind = ("ClosedCurve" if closed[index[0]] else "Curve") if curve else "Fiducial"
        named = {"name": curve} if curve else {}
        lists.append({"type": kind, **named, **frame, "controlPoints": [points[i] for i in index]})
    return {"@schema": _MARKUPS, "markups": lists}


def labels_of_mesh(labels: ArrayLike, mesh: xr.Dataset) -> Array:
    """Map labels from the vertices of a file to those of the cleaned mesh.

    Raises
    ------
    ValueError
        If there is not one label per vertex of the file.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.annotations import labels_of_mesh
    >>> from s4a.schema import dataset
    >>> mesh = dataset(file_vertex=[2, 0], vertex_of_file=[1, -1, 0])
    >>> labels_of_mesh(np.array([5, 6, 7]), mesh).tolist()
    [7, 5]
    """
    require(mesh, "file_vertex", "vertex_of_file", what="mesh")
    shape = (mesh.sizes["file_vertex_index"],)
    labels = check_rows("label", labels, shape, of="vertices of the file of the mesh")
    return labels[mesh["file_vertex"].values]


def labels_of_file(labels: Array, mesh: xr.Dataset, points: Array) -> tuple[Array, int]:
    """Map labels from the vertices of a cleaned mesh to those of its file.

    Parameters
    ----------
    labels : ndarray (n,)
        One per vertex of the cleaned mesh.
    mesh : Dataset
        With ``position`` and ``vertex_of_file``.
    points : float ndarray (p, 3)
        Vertices of the file.

    Returns
    -------
    labels : ndarray (p,)
        Dropped vertices have the label of the nearest remaining vertex; non-finite ones, that of
        the vertex before it in the file.
    n_dropped : int
    """
    require(mesh, "position", "vertex_of_file", what="mesh")
    vertex = mesh["vertex_of_file"].values.copy()
    if len(points) != len(vertex):
        raise ValueError(
            f"the {len(vertex)} vertices of the file of the mesh needed, found {len(points)}"
        )
    dropped = vertex < 0
    finite = dropped & np.isfinite(points).all(axis=1)
    vertex[finite] = cKDTree(mesh["position"].values).query(points[finite])[1]
    previous = np.maximum.accumulate(np.where(vertex >= 0, np.arange(len(vertex)), -1))
    vertex = np.where(previous >= 0, vertex[previous], 0)
    return np.asarray(labels)[vertex], int(dropped.sum())


_CURV = b"\xff\xff\xff"  # first bytes of FreeSurfer's curvature files
SUFFIXES = (".npy", ".npz", ".ply", ".csv", ".txt", ".gii")


def read_scalars(path: Path | str, name: str = "", n: int | None = None) -> Array:
    """Read one number per vertex from a file.

    Parameters
    ----------
    path : str or Path
        NPY; NPZ, the array `name` if there are several; PLY, the vertex property `name`; CSV or
        text with a row per vertex, the column `name` if there is a header; GIFTI (.gii), the first
        array of one dimension; FreeSurfer's curvature files (``lh.curv``, ``lh.thickness``).  Files
        may be compressed by gzip.
    name : str
        Name of the field.
    n : int, optional
        Number of vertices in the file of the mesh.

    Returns
    -------
    float64 ndarray (n,)

    Raises
    ------
    ValueError
        If the file is missing, has no such field, or does not have `n` values.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from s4a.input.annotations import read_scalars
    >>> file = Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = file.write_text("vertex,thickness\\n0,2.5\\n1,3\\n")
    >>> read_scalars(file, "thickness").tolist()
    [2.5, 3.0]
    """
    file = Path(path)
    check_there(file)
    with reading(path, "a field"):
        data = content(file)
        values = np.asarray(_values(data, file.name.lower().removesuffix(".gz"), name))
        if values.dtype.kind not in "iufb":
            raise ValueError(f"numbers expected, found {values.dtype}")
    values = values.reshape(-1) if values.size == max(values.shape, default=0) else values
    _check_length(path, values, n, "number")
    return values.astype(float)


def of_vertices(values: Any, mesh: xr.Dataset, what: str) -> Array:
    """Return a field ``(n,)`` on the vertices of a clean mesh, given for these or for its file.

    Raises ValueError, with `what` as the name of the field, if the values are not numbers, have
    another length, are infinite, or are all NaN.
    """
    values = np.asarray(values)
    if values.dtype.kind not in "iufb":
        raise ValueError(f"{what} needs numbers, found {values.dtype}")
    n = mesh.sizes["vertex"]
    n_file = mesh.sizes.get("file_vertex_index", n)
    check_rows(what, values, (n,), (n_file,), of="vertices of its mesh, or of its file")
    if len(values) == n_file and "file_vertex" in mesh:
        values = values[mesh["file_vertex"].values]
    values = values.astype(float)
    if np.isinf(values).any():
        raise ValueError(
            f"{what} needs finite numbers, or NaN for missing values; {np.isinf(values).sum()} "
            "are infinite"
        )
    finite = values[~np.isnan(values)]
    if not len(finite):
        raise ValueError(f"{what} is NaN everywhere: leave it out")
    if len(finite) < n:
        log.warning("%s is NaN at %d of %d vertices", what, n - len(finite), n)
    if np.ptp(finite) <= 1e-12 * abs(finite).max():
        log.warning("%s is %.4g everywhere: is it the right file?", what, finite[0])
    return values


def with_features(
    mesh: xr.Dataset, features: Mapping[str, Any], *, weight: float = 1.0
) -> xr.Dataset:
    """Add scalar fields that guide the registration, such as sulcal depth or curvature.

    Fields of two shapes are paired by name.  They are descriptors of the initial map for large pose
    differences, and coordinates of the nearest-neighbour search, next to position and normal, in
    initial maps after ICP and in elastic iterations.  Fields are projected onto the first K
    eigenfunctions.  One standard deviation counts as 2 % of sqrt(area), times `weight`
    (:data:`s4a.method.shape.FIELD_WEIGHT`).

    Parameters
    ----------
    mesh : Dataset
        Clean mesh, see :func:`s4a.read_shape` and :func:`s4a.clean`.
    features : dict of str to array_like (vertex,) or path
        Name -> a number for each vertex of the mesh or of its file; or a file
        (:func:`s4a.input.annotations.read_scalars`).  NaN is replaced by the mean.
    weight : float
        Weight of all fields; increase it if the surface has few features, as a round one.  All
        shapes need the same weight.

    Returns
    -------
    Dataset
        The mesh with ``feature_name(feature)``, ``feature_value(vertex, feature)`` and
        ``feature_weight(feature)``, in place of earlier fields.

    Raises
    ------
    ValueError
        If there is no field, a file cannot be read, a field does not fit the mesh, or the weight is
        not positive.

    See Also
    --------
    with_landmarks : guide the registration by landmarks.
    analyse : the option ``features`` reads files next to the meshes.

    Examples
    --------
    >>> import s4a
    >>> mesh = s4a.clean(s4a.synthetic.ellipsoid(200))
    >>> s4a.with_features(mesh, {"height": mesh["position"].values[:, 2]})["feature_value"].shape
    (200, 1)
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    if not features:
        raise ValueError("features needs at least one field, found none")
    if not (np.isfinite(weight) and weight > 0):
        raise ValueError(f"weight must be positive, found {weight!r}")
    fields = {
        name: read_scalars(field, name) if isinstance(field, str | Path) else field
        for name, field in features.items()
    }
    values = [of_vertices(field, mesh, f"the feature {name!r}") for name, field in fields.items()]
    data = dataset(
        feature_name=list(features),
        feature_value=np.stack(values, axis=1),
        feature_weight=np.full(len(values), float(weight)),
    )
    return mesh.drop_dims("feature", errors="ignore").merge(data)


def feature_files(path: Path | str, names: Iterable[str]) -> dict[str, Path]:
    """Find the files with fields of a mesh, by name of the field.

    The field ``sulc`` of ``a.ply`` is in ``a.sulc`` or ``a.sulc.npy`` (any of :data:`SUFFIXES`) in
    the same folder, or in ``a.ply`` itself as a vertex property.

    Raises
    ------
    ValueError
        If a field has two files.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from s4a.input.annotations import feature_files
    >>> folder = Path(tempfile.mkdtemp())
    >>> np.save(folder / "a.sulc.npy", np.zeros(3))
    >>> [file.name for file in feature_files(folder / "a.ply", ["sulc", "curv"]).values()]
    ['a.sulc.npy']
    """
    mesh, file_of = Path(path), {}
    for name in names:
        endings = [end + packed for end in ("", *SUFFIXES) for packed in ("", ".gz")]
        files = [mesh.with_name(f"{stem_of(mesh)}.{name}{end}") for end in endings]
        files = [file for file in files if file.is_file()]
        if len(files) > 1:
            raise ValueError(
                f"one file with the field {name!r} of {shown(mesh)} needed; found "
                f"{shown(files[0])} and {shown(files[1])}"
            )
        if files:
            file_of[name] = files[0]
        elif mesh.is_file() and name in _properties(mesh):
            file_of[name] = mesh
    return file_of


def _properties(path):
    """Vertex properties of a PLY file; empty for other or damaged files."""
    try:
        data = content(path)
        return ply_properties(data) if data[:3] == b"ply" else {}
    except (ValueError, OSError):  # reading the mesh will raise the error
        return {}


def _values(data, file, name):
    """Numbers of a file; the format is detected by the first bytes, or the suffix."""
    if data.startswith(_CURV):
        return _curv(data)
    if data[:3] == b"ply":
        columns = ply_properties(data)
        if name not in columns:
            raise ValueError(f"a vertex property {name!r} expected, found {', '.join(columns)}")
        return columns[name]
    if zipfile.is_zipfile(io.BytesIO(data)):
        arrays = npz(data)
        wanted = next(iter(arrays)) if len(arrays) == 1 else name
        if wanted not in arrays:
            raise ValueError(f"an array {name!r} expected, found {', '.join(arrays) or 'none'}")
        return arrays[wanted]()
    if file.endswith(".npy"):
        return npy(data)
    if file.endswith(".gii"):
        return _gifti_vector(data, intent=None)
    cells = _column(text_of(data), name, str, lambda head: not is_number(head))
    return np.array([_number_of(cell, line) for line, cell in cells.items()])


def _curv(data):
    """FreeSurfer: counts of vertices, triangles and numbers per vertex, then the numbers."""
    if len(data) < 15:
        raise ValueError(f"15 bytes of a header expected, found {len(data)}")
    n, _, per_vertex = (int(count) for count in np.frombuffer(data, ">i4", 3, 3))
    if per_vertex != 1 or n < 0 or len(data) != 15 + 4 * n:
        raise ValueError(
            f"one number for each of {n} vertices expected, found {per_vertex} and "
            f"{len(data) - 15} bytes"
        )
    return np.frombuffer(data, ">f4", n, 15)
