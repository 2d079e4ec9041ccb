"""Mesh files: read and write triangle meshes, and find the files of a collection (5, the data)."""

import contextlib
import fnmatch
import glob
import hashlib
import os
import re
import unicodedata
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from s4a.input.coordinates import CoordinateSystem, map_between, moved, system_in, turned
from s4a.input.formats import FORMATS, NPZ_KEYS, SURFER, format_of
from s4a.input.labels import VOLUMES, grid_of, volume_format
from s4a.input.polygons import triangulated
from s4a.input.raw import check_there, content, regular_file, shown
from s4a.schema import Array, check_rows

SUFFIXES = {suffix: name for name, kind in FORMATS.items() for suffix in kind.suffixes.split()}
SUFFIXES[".obj"] = "OBJ"  # and of MNI
WRITERS = {kind.suffixes.split()[0]: kind.write for kind in FORMATS.values() if kind.write}
WITH_VALUES = [suffix for suffix in WRITERS if FORMATS[SUFFIXES[suffix]].scalars]
LONGEST_NAME = 100  # characters of a shape's name, as files of a study are named after it
OTHERS = ".json .csv .txt .md .html .png .jpg .nc .npy .annot .nii".split()  # not meshes
# grapheme joiner, variation selectors, fillers of Hangul and the blank of Braille
_UNSEEN = re.compile("[\u034f\ufe00-\ufe0f\u115f\u1160\u3164\uffa0\u2800]")

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


def read_mesh(path: str | os.PathLike[str]) -> tuple[Array, Array, dict[str, str]]:
    """Read points and triangles of a mesh file; the format is detected from the content.

    Parameters
    ----------
    path : str or Path
        A file in one of :data:`s4a.input.formats.FORMATS`, such as PLY, OBJ, STL, VTK, GIFTI or
        FreeSurfer surface, or NPZ with the keys V and F, vertices and faces, points and triangles,
        position and corner_vertex, or X and T.  Files may be compressed by gzip (.ply.gz).  The
        limit is 2 GiB, or 1 GiB unpacked.  Polygons are split into triangles.

    Returns
    -------
    points : float64 ndarray (n, 3)
        As in the file, including non-finite ones; for STL, the distinct corners.
    triangles : int32 ndarray (m, 3)
    attrs : dict of str
        ``format``; ``coordinate_system`` and ``unit`` if the file has them
        (:mod:`s4a.input.coordinates`); ``note`` if the suffix is that of another format.

    Raises
    ------
    ValueError
        If the file is not a mesh, is truncated or inconsistent; the message names the file.

    See Also
    --------
    write_mesh : write a mesh file.
    read_shape : read and clean a mesh file.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import s4a
    >>> path = Path(tempfile.mkdtemp()) / "triangle.off"
    >>> s4a.write_mesh(path, [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> points, triangles, attrs = s4a.read_mesh(path)
    >>> points.shape, triangles.tolist()
    ((3, 3), [[0, 1, 2]])
    """
    path = Path(path)
    check_there(path)
    name = "mesh"
    try:
        data = content(path).removeprefix(b"\xef\xbb\xbf")
        if volume := volume_format(data):
            raise ValueError(
                f"found a volume ({volume}); give a label (label=17, --label 17) for its surface"
            )
        name = format_of(data)
        with np.errstate(all="ignore"):  # invalid numbers are an error here or cleaned later
            points, cells, attrs = FORMATS[name].read(data)
            points, triangles, n_crossing = _checked(points, cells)
            attrs, notes = {"format": name, **attrs, **system_in(data, name).attrs}, []
    except Exception as error:  # no file may end the run over a collection
        why = shown(error) or type(error).__name__
        raise ValueError(f"{shown(path)} cannot be read as {name}: {why}") from error
    suffix = suffix_of(path)
    if suffix in SUFFIXES and suffix not in FORMATS[name].suffixes.split():
        notes.append(f"named {path.suffix} but read as {name} by its content; rename the file")
    if n_crossing:
        notes.append(f"{n_crossing} polygons intersect themselves; save the surface as triangles")
    return points, triangles, attrs | ({"note": "; ".join(notes)} if notes else {})


def systems_of(shapes: Mapping[str, Any], given: CoordinateSystem) -> dict[str, CoordinateSystem]:
    """Return the coordinate systems of files and meshes by name, without unreadable files.

    `given` is for files that state none.
    """
    systems = {}
    for name, shape in shapes.items():
        if not isinstance(shape, str | os.PathLike):
            systems[name] = CoordinateSystem.of(getattr(shape, "attrs", {})).filled(given)
            continue
        with contextlib.suppress(Exception):  # reading the shape will raise the error
            data = content(Path(shape)).removeprefix(b"\xef\xbb\xbf")
            own = grid_of(data)[2] if volume_format(data) else system_in(data, format_of(data))
            systems[name] = own.filled(given)
    return systems


def suffix_of(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a path in lower case, ignoring .gz.

    Examples
    --------
    >>> from s4a.input.files import suffix_of
    >>> suffix_of("a.PLY"), suffix_of("lh.pial.gz"), suffix_of("a.tar.gz")
    ('.ply', '.pial', '.tar')
    """
    return Path(Path(path).name.lower().removesuffix(".gz")).suffix


def stem_of(path: str | os.PathLike[str]) -> str:
    """Return the name of a path without .gz and suffix; FreeSurfer's suffixes are kept.

    Examples
    --------
    >>> from s4a.input.files import stem_of
    >>> stem_of("scans/head.ply.gz"), stem_of("lh.pial")
    ('head', 'lh.pial')
    """
    name = Path(path).name
    name = name[:-3] if name.lower().endswith(".gz") else name
    return name if suffix_of(path) in SURFER.split() else Path(name).stem


def _checked(points, cells):
    """Points (float64), triangles (int32) and number of crossing polygons, or ValueError.

    `cells` are triangles ``(m, 3)`` or polygons, see :mod:`s4a.input.polygons`.
    """
    points = np.asarray(points, np.float64)
    corners, *sizes = cells if isinstance(cells, tuple) else [np.asarray(cells)]
    n, m = len(points), len(sizes[0] if sizes else corners)
    fits = bool(sizes) or (corners.ndim == 2 and corners.shape[1] == 3)
    if points.ndim != 2 or points.shape[1] != 3 or not fits:
        raise ValueError(
            f"points (n, 3) and triangles (m, 3) needed, found {points.shape} and {corners.shape}"
        )
    if n and corners.size == 0:
        raise ValueError(f"no faces: a surface needs triangles, found {n} points only")
    if n == 0:
        raise ValueError(f"a surface needs vertices and triangles, found 0 and {m}")
    corners = corners.astype(np.int64)
    low, high = corners.min(), corners.max()
    if low < 0 or high >= n:
        raise ValueError(f"face indices 0..{n - 1} expected for {n} vertices, found {low}..{high}")
    triangles, n_crossing = triangulated(points, corners, *sizes) if sizes else (corners, 0)
    if len(triangles) == 0:
        raise ValueError(f"no faces: polygons of three corners or more needed, found {m} of fewer")
    return points, triangles.astype(np.int32), n_crossing


def write_mesh(
    path: str | os.PathLike[str],
    points: Array,
    triangles: Array,
    *,
    coordinate_system: str = "",
    unit: str = "",
    **vertex_scalars: Any,
) -> None:
    """Write a mesh file in the format of its suffix.

    Parameters
    ----------
    path : str or Path
        Name whose suffix is one of :data:`WRITERS`, such as .ply (binary), .stl, .vtk or .gii.
    points : float ndarray (n, 3)
    triangles : int ndarray (m, 3)
    coordinate_system, unit : str, optional
        Written into the header, as by 3D Slicer, except for NPZ.  Coordinates in FreeSurfer's
        surface RAS are converted to scanner RAS, and for GIFTI to RAS and mm.
    **vertex_scalars : float ndarray (n,)
        Values per vertex by name, stored as float32 except in NPZ; the suffix must be one of
        :data:`WITH_VALUES`.

    Raises
    ------
    ValueError
        If the suffix is unknown, the format cannot hold values, or their number is not n.

    See Also
    --------
    read_mesh : read a mesh file.
    write_registered : write a whole study as meshes in correspondence.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import s4a
    >>> folder = Path(tempfile.mkdtemp())
    >>> s4a.write_mesh(folder / "triangle.ply", np.eye(3), [[0, 1, 2]], height=np.zeros(3))
    >>> (folder / "triangle.ply").stat().st_size > 0
    True
    """
    path = Path(path)
    points, triangles, _ = _checked(points, triangles)
    shape = (len(points),)
    scalars = {name: check_rows(name, one, shape) for name, one in vertex_scalars.items()}
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise ValueError(f"a name ending in {', '.join(WRITERS)} needed, found {path.name}")
    if scalars and suffix not in WITH_VALUES:
        raise ValueError(
            f"{suffix} cannot hold values per vertex; write {', '.join(WITH_VALUES[:-1])} or "
            f"{WITH_VALUES[-1]}"
        )
    system = CoordinateSystem.of({"coordinate_system": coordinate_system, "unit": unit})
    written = system.in_world(*["RAS", "mm"] if suffix == ".gii" else [])
    M = map_between(system, written, shown(path))
    path.write_bytes(
        WRITERS[suffix](moved(points, M), turned(triangles, M), scalars, written.title)
    )


# the files of a collection


def find_meshes(
    paths: Paths, pattern: str | None = None, *, volumes: bool = False
) -> list[tuple[Path, str]]:
    """Find the mesh files of a collection and name each.

    Parameters
    ----------
    paths : str, Path or list of these
        Folders (searched recursively; other files are skipped, see :func:`not_meshes`), files, or
        globs such as ``"scans/*/head.stl"``.
    pattern : str, optional
        Keep files whose name matches, with or without suffix: ``"*_brain"`` selects one structure.
    volumes : bool
        Find label volumes (:mod:`s4a.input.labels`) instead of meshes.

    Returns
    -------
    list of (Path, str)
        Path and name, sorted by path.  Names are made by :func:`slug` from the file's name; equal
        names are made unique by the folders, then the suffix, then a hash.

    Raises
    ------
    ValueError
        If a path is missing or no mesh is found.
    """
    files_and_reasons = _files(paths, volumes)
    files = [file for file, why_not in files_and_reasons if not why_not]
    chosen = [file for file in files if pattern is None or _matches(file, pattern)]
    if not chosen:
        what = "label volume" if volumes else "mesh"
        where = ", ".join(map(shown, _listed(paths))) or "an empty list"
        if pattern and files:
            raise ValueError(f"no {what} of {len(files)} files matching {pattern!r} in {where}")
        others = "".join(f"; {shown(file)} is {why_not}" for file, why_not in files_and_reasons[:3])
        raise ValueError(f"no {what} ({', '.join(_suffixes(volumes))}) in {where}{others}")
    return list(zip(chosen, slugs(chosen), strict=True))


def not_meshes(
    paths: Paths, pattern: str | None = None, *, volumes: bool = False
) -> list[tuple[Path, str]]:
    """Find files that are named like meshes, or match a glob, but are not meshes.

    Unreadable folders and links to folders, which are not followed, are included.

    Returns
    -------
    list of (Path, str)
        Path and what it is, sorted by path.
    """
    return [
        (file, why_not)
        for file, why_not in _files(paths, volumes)
        if why_not and (pattern is None or _matches(file, pattern) or os.path.isdir(file))
    ]


def was_cut(file: Path, name: str) -> bool:
    """Return whether the name of a shape was shortened from that of its file."""
    return len(name) == LONGEST_NAME and name not in _plain(str(file))


def _listed(paths):
    paths = [paths] if isinstance(paths, str | os.PathLike) else paths
    if not isinstance(paths, Iterable) or not all(isinstance(p, str | os.PathLike) for p in paths):
        raise TypeError(
            "shapes must be a path or a list of paths, a dict of names to paths or meshes, or a "
            f"DataTree, such as s4a.read_shapes returns; found {type(paths).__name__}"
        )
    return list(paths)


def _suffixes(volumes):
    return VOLUMES if volumes else SUFFIXES


def _files(paths, volumes=False):
    """All files given, once and sorted, each with the reason why it is not a mesh, or ""."""
    reasons = {}
    for path in _listed(paths):
        for file, why_not in _expand(path, volumes):
            absolute = os.path.abspath(file)
            new = (str(file), why_not)
            reasons[absolute] = min(reasons.get(absolute, new), new)
    return [(Path(file), why_not) for _, (file, why_not) in sorted(reasons.items())]


def _matches(file, pattern):
    return any(fnmatch.fnmatchcase(name, pattern) for name in (file.name, file.stem, stem_of(file)))


def _expand(path, volumes):
    """Files of a folder, a path or a glob, each with the reason why it is not a mesh, or ""."""
    path = Path(os.path.expanduser(path))
    if os.path.isdir(path):
        return _search(path, volumes)
    if os.path.lexists(path):  # a file that is given by name is always read
        return [(path, "")]
    matches = glob.glob(str(path), recursive=True) if glob.has_magic(str(path)) else []
    if not matches:
        raise ValueError(f"no file or folder matches {shown(path)}")
    files = []
    for match in map(Path, matches):
        is_file = not os.path.isdir(match)
        files += [(match, _why_not(match, volumes))] if is_file else _search(match, volumes)
    return files


def _search(folder, volumes):
    """Files named like meshes in a folder, recursively, each with why it is not one, or ""."""
    errors: list[OSError] = []
    files, others, suffixes = [], [], _suffixes(volumes)
    for parent, folders, names in os.walk(folder, onerror=errors.append):
        inner = [Path(parent, name) for name in folders if name[0] != "."]
        visible = [Path(parent, name) for name in names if name[0] != "."]
        links = [path for path in inner if path.is_symlink()]
        others += [(path, "a link to a folder, which is not followed") for path in links]
        files += [
            (path, _why_not(path, volumes)) for path in visible if suffix_of(path) in suffixes
        ]
        like_meshes = [path for path in inner if suffix_of(path) in suffixes and path not in links]
        others += [(path, "a folder, and its files were searched") for path in like_meshes]
    if not files:
        others.append((folder, f"a folder without {'label volumes' if volumes else 'meshes'}"))
    others += [
        (Path(error.filename), f"a folder that cannot be searched: {error.strerror}")
        for error in errors
    ]
    return files + others


def _why_not(file, volumes):
    """Reason why a file among the meshes of a collection is not a mesh, or "".

    NPZ and GIFTI files may hold other data, and are opened.
    """
    suffix = suffix_of(file)
    if volumes:
        return "" if suffix in VOLUMES else f"a {suffix or 'nameless'} file"
    if suffix in OTHERS:
        return f"a {suffix} file"
    try:
        if suffix == ".npz":
            with regular_file(file) as opened, zipfile.ZipFile(opened) as archive:
                names = {name.removesuffix(".npy") for name in archive.namelist()}
            if not any(names.issuperset(keys) for keys in NPZ_KEYS):
                return "an archive of other arrays"
        if suffix == ".gii":
            data = content(file)
            if b"<GIFTI" in data and b"NIFTI_INTENT_POINTSET" not in data:
                return "a GIFTI file without points"
    except (ValueError, zipfile.BadZipFile):  # reading it will raise the error
        pass
    return ""


def slug(text: str) -> str:
    """Convert a text to letters, digits, ``_`` and ``-``.

    Accents are removed, other letters become their code.  More than 100 characters are shortened to
    100, ending in a hash of `text`.

    Examples
    --------
    >>> from s4a.input.files import slug
    >>> slug("Crâne 3.b"), slug("脳")
    ('Crane_3_b', 'u8133')
    >>> slug("a" * 250)[80:]
    'aaaaaaaaaaa_3f3e35e0'
    """
    plain = _plain(text) or "_"
    return plain if len(plain) <= LONGEST_NAME else f"{plain[: LONGEST_NAME - 9]}_{_digest(text)}"


def _plain(text):
    letters = [c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c)]
    ascii_only = "".join(c if c.isascii() else f"u{ord(c):x}" for c in letters)
    return re.sub(r"[^A-Za-z0-9_-]", "_", ascii_only)


def _digest(text):
    return hashlib.sha256(os.fsencode(text)).hexdigest()[:8]


def visible(text: str) -> str:
    """Return a text in composed letters, without characters that cannot be seen."""
    text = unicodedata.normalize("NFC", text)
    kept = (
        c
        for c in text
        if c.isspace() or not (unicodedata.category(c) in ("Cf", "Cc") or _UNSEEN.match(c))
    )
    return " ".join("".join(kept).split())


def check_names(names: Iterable[Any]) -> None:
    """Raise ValueError unless there are names, and :func:`slug` leaves each as it is."""
    names = list(names)
    wrong = [name for name in names if not isinstance(name, str) or slug(name) != name]
    if wrong or not names:
        raise ValueError(
            f"names of shapes need 1 to {LONGEST_NAME} letters, digits, _ or -; "
            f"found {wrong or 'no shapes'}"
        )


def files_named(
    folder: Path | str, names: Iterable[str], what: str, suffixes: Iterable[str], field: str = ""
) -> dict[str, Path]:
    """Find the files in a folder that are named after shapes.

    Parameters
    ----------
    folder : path
    names : iterable of str
        Names of the shapes.
    what : str
        Content of the files, for messages.
    suffixes : iterable of str
        Endings of the files, in lower case; ``.gz`` may follow.
    field : str, optional
        Name of a field that may follow that of the shape: ``a.npy``, ``a.thickness.npy`` or, for
        FreeSurfer, ``a.thickness``.

    Returns
    -------
    dict of str to Path
        Files by shape; shapes without a file are absent.

    Raises
    ------
    ValueError
        If there is no folder, no file is named after a shape, or two files are of one shape.
    """
    names, suffixes, folder = list(names), list(suffixes), Path(folder)
    if not folder.is_dir():
        raise ValueError(
            f"{what}: a folder of files named after the shapes needed; found {shown(folder)}"
        )
    behind = f".{field}" if field else ""
    file_of: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        plain = file.name[:-3] if file.name.lower().endswith(".gz") else file.name
        suffix = next((end for end in suffixes if plain.lower().endswith(end)), "")
        plain = plain[: len(plain) - len(suffix)]
        if not suffix and not (behind and plain.endswith(behind)):
            continue
        name = slug(plain.removesuffix(behind))
        if name in file_of and name in names:
            raise ValueError(
                f"{what}: one file for {name} needed; found "
                f"{shown(file_of[name])} and {shown(file)}"
            )
        file_of[name] = file
    file_of = {name: file_of[name] for name in names if name in file_of}
    if not file_of:
        endings = ", ".join([*suffixes[:4], *filter(None, [behind])])
        raise ValueError(
            f"{what}: no file in {shown(folder)} is named after a shape, such as {names[0]} with "
            f"one of {endings}"
        )
    return file_of


def slugs(files: Iterable[str | os.PathLike[str]]) -> list[str]:
    """Return a unique :func:`slug` for each path, ignoring case."""
    absolute = [Path(os.path.abspath(file)) for file in files]
    base = os.path.commonpath([file.parent for file in absolute])
    paths = [file.relative_to(base).as_posix() for file in absolute]
    level = dict.fromkeys(paths, 0)  # how much of the path the name has

    def name(path):
        stem = Path(path).with_name(stem_of(path)).as_posix()
        return slug([Path(stem).name, stem, path, f"{path}_{_digest(path)}"][level[path]])

    while True:
        names = {path: name(path).casefold() for path in paths}
        count = Counter(names.values())
        shared = [path for path in paths if count[names[path]] > 1 and level[path] < 3]
        if not shared:
            return [name(path) for path in paths]
        for path in shared:
            level[path] += 1
