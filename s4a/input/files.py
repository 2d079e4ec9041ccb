"""Mesh files: read and write triangle meshes, and find the files of a collection (5, the data)."""

import fnmatch
import glob
import hashlib
import os
import re
import unicodedata
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np

from s4a.input import bounded
from s4a.input.formats import NPZ_KEYS, READERS, WRITERS

SURFER = (
    ".pial",
    ".white",
    ".inflated",
    ".orig",
    ".smoothwm",
    ".sphere",
)  # FreeSurfer: the name is the suffix
SUFFIXES = {
    "PLY": (".ply",),
    "OBJ": (".obj",),
    "OFF": (".off",),
    "STL": (".stl",),
    "VTK": (".vtk",),
    "VTP": (".vtp",),
    "GIFTI": (".gii",),
    "NPZ": (".npz",),
    "FreeSurfer": SURFER,
}


OTHERS = (
    ".json",
    ".csv",
    ".txt",
    ".md",
    ".html",
    ".png",
    ".jpg",
    ".nc",
    ".npy",
    ".annot",
    ".nii",
)  # of a glob


def read_mesh(path):
    """Points and triangles of a mesh file; the format is told by the content, not by the name.

    Parameters
    ----------
    path : str or Path
        PLY, OBJ, OFF, STL, VTK legacy polydata, VTP, GIFTI, FreeSurfer surface, or NPZ with the
        keys V and F, vertices and faces, points and triangles, position and corner_vertex, or X and
        T; each of them compressed by gzip too (.ply.gz), which may unpack to 1 GiB.  Polygons
        become fans of triangles.

    Returns
    -------
    points : float64 ndarray (n, 3)
        As in the file, non-finite ones too; those of an STL, which has no vertices, are its
        distinct corners.
    triangles : int32 ndarray (m, 3)
    attrs : dict of str
        ``format``, and where the file says so ``coordinate_system`` (RAS or LPS) and ``unit``;
        ``note`` when the name promises another format.

    Raises
    ------
    ValueError
        When the file is not a mesh, ends early or contradicts itself; the message names the file.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import s4a
    >>> folder = Path(tempfile.mkdtemp())
    >>> path = s4a.write_mesh(folder / "one.off", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> points, triangles = s4a.read_mesh(folder / "one.off")[:2]
    >>> points.shape, triangles.tolist()
    ((3, 3), [[0, 1, 2]])
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    found = "mesh"
    try:
        data = bounded.content(path).removeprefix(b"\xef\xbb\xbf")
        found = _sniff(data)
        with np.errstate(all="ignore"):  # nonsense in the file is refused, or left to the cleaning
            points, triangles, attrs = READERS[found](data)
            points, triangles = _checked(points, triangles)
    except Exception as error:  # whatever a file holds, it must not end the run over a collection
        raise ValueError(
            f"{path} cannot be read as {found}: {error or type(error).__name__}"
        ) from error
    space = re.search(rb"SPACE=(RAS|LPS)", data[:1000])  # as 3D Slicer writes it into any header
    if space:
        attrs["coordinate_system"] = space[1].decode()
    promised = [name for name, suffixes in SUFFIXES.items() if suffix_of(path) in suffixes]
    if promised and found not in promised:
        attrs["note"] = f"named {path.suffix} but holds {found}, and was read as that; rename it"
    return points, triangles, {"format": found, **attrs}


def suffix_of(path):
    """What the name promises: the suffix in lower case, that before .gz where there is one.

    Examples
    --------
    >>> from s4a.input.files import suffix_of
    >>> suffix_of("a.PLY"), suffix_of("lh.pial.gz"), suffix_of("a.tar.gz")
    ('.ply', '.pial', '.tar')
    """
    return Path(Path(path).name.lower().removesuffix(".gz")).suffix


def stem_of(path):
    """The name without the suffix of its format, and without .gz.

    FreeSurfer's suffixes are names.
    """
    name = Path(path).name
    name = name[:-3] if name.lower().endswith(".gz") else name
    return name if suffix_of(path) in SURFER else Path(name).stem


def _sniff(data):
    """The format that the first bytes show."""
    head = data[:4096].lstrip()
    starts = {
        b"ply\n": "PLY",
        b"ply\r": "PLY",
        b"# vtk DataFile": "VTK",
        b"PK\x03\x04": "NPZ",
        b"\xff\xff\xfe": "FreeSurfer",
    }
    for start, name in starts.items():
        if head.startswith(start):
            return name
    if head.startswith(b"<"):
        for start, name in {b"<VTKFile": "VTP", b"<GIFTI": "GIFTI"}.items():
            if start in head:
                return name
    if re.match(rb"(ST)?C?N?OFF", head):
        return "OFF"
    if len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        return "STL"
    if re.match(rb"solid\b", head, re.I) and re.search(rb"\bfacet\b|\bendsolid\b", data, re.I):
        return "STL"
    if b"\0" not in head and re.search(rb"^[ \t]*v[ \t]+[-+.\dn]", data, re.M):
        return "OBJ"
    if b"\0" in head and len(data) >= 84:
        return "STL"
    formats = ", ".join(SUFFIXES)
    raise ValueError(
        f"one of {formats} expected, found {len(data)} bytes" + " of something else" * bool(data)
    )


def _checked(points, triangles):
    points, triangles = np.asarray(points, np.float64), np.asarray(triangles, np.int64)
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(
            f"points (n, 3) and triangles (m, 3) needed, found {points.shape} and {triangles.shape}"
        )
    if len(points) and len(triangles) == 0:
        raise ValueError(
            f"no faces: a surface needs triangles, found {len(points)} points and nothing else"
        )
    if len(points) == 0:
        raise ValueError(f"a surface needs vertices and triangles, found 0 and {len(triangles)}")
    low, high = triangles.min(), triangles.max()
    if low < 0 or high >= len(points):
        raise ValueError(
            f"face indices 0..{len(points) - 1} expected for {len(points)} vertices, found {low}..{high}"
        )
    return points, triangles.astype(np.int32)


def write_mesh(path, points, triangles, **vertex_scalars):
    """Write a mesh in the format that the suffix names.

    .ply (binary), .obj, .off, .stl, .vtk, .gii or .npz.

    Parameters
    ----------
    path : str or Path
    points : float ndarray (n, 3)
    triangles : int ndarray (m, 3)
    **vertex_scalars : float ndarray (n,)
        Values per vertex by name; PLY, VTK, GIFTI and NPZ hold them, as float32 but for NPZ.

    Raises
    ------
    ValueError
        When the suffix is another, the format holds no values or their number is not that of the
        vertices.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import s4a
    >>> folder = Path(tempfile.mkdtemp())
    >>> s4a.write_mesh(folder / "one.ply", np.eye(3), [[0, 1, 2]], height=np.zeros(3))
    >>> (folder / "one.ply").stat().st_size > 0
    True
    """
    path = Path(path)
    points, triangles = _checked(points, triangles)
    scalars = {name: np.asarray(values) for name, values in vertex_scalars.items()}
    for name, values in scalars.items():
        if values.shape != (len(points),):
            raise ValueError(
                f"{name} needs one value for each of {len(points)} vertices, found {values.shape}"
            )
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise ValueError(f"a name ending in {', '.join(WRITERS)} needed, found {path.name}")
    if scalars and suffix in (".obj", ".off", ".stl"):
        raise ValueError(f"{suffix} holds no values per vertex; write .ply, .vtk, .gii or .npz")
    path.write_bytes(WRITERS[suffix](points, triangles, scalars))


def find_meshes(paths, pattern=None):
    """The mesh files of a collection and a name for each.

    Parameters
    ----------
    paths : str, Path or list of these
        Folders (searched to any depth; what is no mesh is passed over, see :func:`not_meshes`),
        files, or globs such as ``"scans/*/head.stl"``.
    pattern : str, optional
        Keep the files whose name, with or without suffix, it matches: ``"*_brain"`` picks one
        structure of many.

    Returns
    -------
    list of (Path, str)
        Sorted by path.  The name has letters, digits, ``_`` and ``-`` only and is made of the
        file's name; where two would be the same, of the folders too, and of the suffix, and of a
        hash when nothing else tells them apart.

    Raises
    ------
    ValueError
        When a path is missing or no mesh is found.
    """
    files = [file for file, why in _files(paths) if not why]
    chosen = [file for file in files if pattern is None or _matches(file, pattern)]
    if not chosen:
        suffixes = ", ".join(suffix for group in SUFFIXES.values() for suffix in group)
        where = ", ".join(map(str, _listed(paths))) or "an empty list"
        filtered = (
            f" of {len(files)} files matching {pattern!r}"
            if pattern and files
            else f" ({suffixes})"
        )
        raise ValueError(f"no mesh{filtered} in {where}")
    return list(zip(chosen, slugs(chosen), strict=True))


def not_meshes(paths, pattern=None):
    """The files of folders and globs that are named like meshes, or matched.

    And hold something else.

    Returns
    -------
    list of (Path, str)
        Sorted by path, with what they are.
    """
    return [
        (file, why)
        for file, why in _files(paths)
        if why and (pattern is None or _matches(file, pattern))
    ]


def _listed(paths):
    return [paths] if isinstance(paths, str | os.PathLike) else list(paths)


def _files(paths):
    """All files that are meant, once and sorted, with the reason why they are no meshes or ""."""
    found = sorted(
        (os.path.abspath(file), str(file), why)
        for path in _listed(paths)
        for file, why in _expand(path)
    )
    return [
        (Path(file), why)
        for i, (at, file, why) in enumerate(found)
        if i == 0 or at != found[i - 1][0]
    ]


def _matches(file, pattern):
    return any(fnmatch.fnmatchcase(name, pattern) for name in (file.name, file.stem, stem_of(file)))


def _expand(path):
    """The files that a folder, a file or a glob means.

    With the reason why they are no meshes or "".
    """
    known = tuple(suffix for group in SUFFIXES.values() for suffix in group)
    path = Path(path).expanduser()
    if path.is_file():
        return [(path, "")]
    if path.is_dir():
        found = (Path(folder, name) for folder, _, names in os.walk(path) for name in names)
        return [
            (file, _other(file))
            for file in found
            if suffix_of(file) in known and file.name[0] != "."
        ]
    found = (
        [Path(name) for name in glob.glob(str(path), recursive=True)]
        if glob.has_magic(str(path))
        else []
    )
    if not found:
        raise ValueError(f"no file, folder or match of {path}")
    return [
        one
        for name in found
        for one in ([(name, _other(name))] if name.is_file() else _expand(name))
    ]


def _other(file):
    """What a file holds that may well lie beside the meshes of a collection and is none.

    "" where it may be one.
    """
    try:
        if suffix_of(file) == ".npz":
            with zipfile.ZipFile(file) as archive:
                names = {name.removesuffix(".npy") for name in archive.namelist()}
            return (
                ""
                if any(names.issuperset(keys) for keys in NPZ_KEYS)
                else "an archive of other arrays"
            )
        if suffix_of(file) == ".gii":
            data = bounded.content(file)
            return (
                ""
                if b"<GIFTI" not in data or b"NIFTI_INTENT_POINTSET" in data
                else "a GIFTI file without points"
            )
        if suffix_of(file) in (
            ".json",
            ".csv",
            ".txt",
            ".md",
            ".html",
            ".png",
            ".jpg",
            ".nc",
            ".npy",
            ".annot",
            ".nii",
        ):
            return f"a {suffix_of(file)} file"
    except (OSError, ValueError, zipfile.BadZipFile):  # it will be said when it is read
        pass
    return ""


def slug(text):
    """`text` in letters, digits, ``_`` and ``-``.

    Accents are dropped, other characters outside ASCII escaped.

    Examples
    --------
    >>> from s4a.input.files import slug
    >>> slug("Crâne 3.b"), slug("脳")
    ('Crane_3_b', 'u8133')
    """
    kept = (c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    return (
        "".join(
            c if re.match(r"[A-Za-z0-9_-]", c) else "_" if c.isascii() else f"u{ord(c):x}"
            for c in kept
        )
        or "_"
    )


def slugs(files):
    """A unique :func:`slug` for each path, also where upper and lower case are one."""
    files = [Path(os.path.abspath(file)) for file in files]
    base = os.path.commonpath([file.parent for file in files])
    relative = [file.relative_to(base).as_posix() for file in files]
    level = dict.fromkeys(relative, 0)

    def name(path):
        stem = Path(path).with_name(stem_of(path)).as_posix()
        digest = hashlib.sha256(os.fsencode(path)).hexdigest()[:8]
        return slug([Path(stem).name, stem, path, f"{path}_{digest}"][level[path]])

    while True:
        names = {path: name(path).casefold() for path in relative}
        taken = Counter(names.values())
        double = [path for path in relative if taken[names[path]] > 1 and level[path] < 3]
        if not double:
            return [name(path) for path in relative]
        level |= {path: level[path] + 1 for path in double}
