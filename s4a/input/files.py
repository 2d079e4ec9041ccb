"""Mesh files: read and write triangle meshes, and find the files of a collection (5, the data)."""

import fnmatch
import glob
import hashlib
import os
import re
import unicodedata
import zipfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from s4a.input import bounded
from s4a.input.formats import FORMATS, NPZ_KEYS, SURFER, format_of

SUFFIXES = {suffix: name for name, known in FORMATS.items() for suffix in known.suffixes.split()}
WRITERS = {known.suffixes.split()[0]: known.write for known in FORMATS.values() if known.write}
OTHERS = ".json .csv .txt .md .html .png .jpg .nc .npy .annot .nii".split()  # that a glob may match

Paths = str | os.PathLike | Iterable[str | os.PathLike]


def read_mesh(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
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
    >>> path = Path(tempfile.mkdtemp()) / "one.off"
    >>> s4a.write_mesh(path, [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> points, triangles, attrs = s4a.read_mesh(path)
    >>> points.shape, triangles.tolist()
    ((3, 3), [[0, 1, 2]])
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no file {path}")
    name = "mesh"
    try:
        data = bounded.content(path).removeprefix(b"\xef\xbb\xbf")
        name = format_of(data)
        with np.errstate(all="ignore"):  # nonsense in the file is refused, or left to the cleaning
            points, triangles, attrs = FORMATS[name].read(data)
            points, triangles = _checked(points, triangles)
    except Exception as error:  # whatever a file holds, it must not end the run over a collection
        why = error or type(error).__name__
        raise ValueError(f"{path} cannot be read as {name}: {why}") from error
    attrs = {"format": name, **attrs}
    space = re.search(rb"SPACE=(RAS|LPS)", data[:1000])  # as 3D Slicer writes it into any header
    if space:
        attrs["coordinate_system"] = space[1].decode()
    if SUFFIXES.get(suffix_of(path), name) != name:
        attrs["note"] = f"named {path.suffix} but holds {name}, and was read as that; rename it"
    return points, triangles, attrs


def suffix_of(path: str | os.PathLike) -> str:
    """What the name promises: the suffix in lower case, that before .gz where there is one.

    Examples
    --------
    >>> from s4a.input.files import suffix_of
    >>> suffix_of("a.PLY"), suffix_of("lh.pial.gz"), suffix_of("a.tar.gz")
    ('.ply', '.pial', '.tar')
    """
    return Path(Path(path).name.lower().removesuffix(".gz")).suffix


def stem_of(path: str | os.PathLike) -> str:
    """The name without .gz and without the suffix of its format; FreeSurfer's suffixes are names.

    Examples
    --------
    >>> from s4a.input.files import stem_of
    >>> stem_of("scans/head.ply.gz"), stem_of("lh.pial")
    ('head', 'lh.pial')
    """
    name = Path(path).name
    name = name[:-3] if name.lower().endswith(".gz") else name
    return name if suffix_of(path) in SURFER.split() else Path(name).stem


def _checked(points, triangles):
    """Points as float64, triangles as int32, or ValueError."""
    points, triangles = np.asarray(points, np.float64), np.asarray(triangles, np.int64)
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(
            f"points (n, 3) and triangles (m, 3) needed, found {points.shape} and {triangles.shape}"
        )
    n, m = len(points), len(triangles)
    if n and m == 0:
        raise ValueError(f"no faces: a surface needs triangles, found {n} points and nothing else")
    if n == 0:
        raise ValueError(f"a surface needs vertices and triangles, found 0 and {m}")
    low, high = triangles.min(), triangles.max()
    if low < 0 or high >= n:
        raise ValueError(f"face indices 0..{n - 1} expected for {n} vertices, found {low}..{high}")
    return points, triangles.astype(np.int32)


def write_mesh(
    path: str | os.PathLike, points: np.ndarray, triangles: np.ndarray, **vertex_scalars: np.ndarray
) -> None:
    """Write a mesh in the format of the suffix: .ply (binary), .obj, .off, .stl, .vtk, .gii, .npz.

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
    if scalars and not FORMATS[SUFFIXES[suffix]].scalars:
        raise ValueError(f"{suffix} holds no values per vertex; write .ply, .vtk, .gii or .npz")
    path.write_bytes(WRITERS[suffix](points, triangles, scalars))


# the files of a collection


def find_meshes(paths: Paths, pattern: str | None = None) -> list[tuple[Path, str]]:
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
    files = [file for file, why_not in _files(paths) if not why_not]
    chosen = [file for file in files if pattern is None or _matches(file, pattern)]
    if not chosen:
        where = ", ".join(map(str, _listed(paths))) or "an empty list"
        if pattern and files:
            raise ValueError(f"no mesh of {len(files)} files matching {pattern!r} in {where}")
        raise ValueError(f"no mesh ({', '.join(SUFFIXES)}) in {where}")
    return list(zip(chosen, slugs(chosen), strict=True))


def not_meshes(paths: Paths, pattern: str | None = None) -> list[tuple[Path, str]]:
    """The files that are named like meshes, or matched by a glob, and hold something else.

    Returns
    -------
    list of (Path, str)
        Sorted by path, with what they are.
    """
    return [
        (file, why_not)
        for file, why_not in _files(paths)
        if why_not and (pattern is None or _matches(file, pattern))
    ]


def _listed(paths):
    return [paths] if isinstance(paths, str | os.PathLike) else list(paths)


def _files(paths):
    """All files that are meant, once and sorted, each with why it is no mesh, or ""."""
    by_place = {}
    for path in _listed(paths):
        for file, why_not in _expand(path):
            place = os.path.abspath(file)
            by_place[place] = min(by_place.get(place, (str(file), why_not)), (str(file), why_not))
    return [(Path(file), why_not) for _, (file, why_not) in sorted(by_place.items())]


def _matches(file, pattern):
    return any(fnmatch.fnmatchcase(name, pattern) for name in (file.name, file.stem, stem_of(file)))


def _expand(path):
    """The files that a folder, a file or a glob means, each with why it is no mesh, or ""."""
    path = Path(path).expanduser()
    if path.is_file():  # named by itself, it is tried whatever it is
        return [(path, "")]
    if path.is_dir():
        files = (Path(folder, name) for folder, _, names in os.walk(path) for name in names)
        meant = [file for file in files if suffix_of(file) in SUFFIXES and file.name[0] != "."]
        return [(file, _why_not(file)) for file in meant]
    matches = glob.glob(str(path), recursive=True) if glob.has_magic(str(path)) else []
    if not matches:
        raise ValueError(f"no file, folder or match of {path}")
    files = []
    for match in map(Path, matches):
        files += [(match, _why_not(match))] if match.is_file() else _expand(match)
    return files


def _why_not(file):
    """What a file is that may well lie beside the meshes of a collection; "" where it may be one.

    Two formats hold other things as well as meshes, and are looked into.
    """
    suffix = suffix_of(file)
    if suffix in OTHERS:
        return f"a {suffix} file"
    try:
        if suffix == ".npz":
            with zipfile.ZipFile(file) as archive:
                names = {name.removesuffix(".npy") for name in archive.namelist()}
            if not any(names.issuperset(keys) for keys in NPZ_KEYS):
                return "an archive of other arrays"
        if suffix == ".gii":
            data = bounded.content(file)
            if b"<GIFTI" in data and b"NIFTI_INTENT_POINTSET" not in data:
                return "a GIFTI file without points"
    except (OSError, ValueError, zipfile.BadZipFile):  # it will be said when it is read
        pass
    return ""


def slug(text: str) -> str:
    """`text` in letters, digits, ``_`` and ``-``: accents go, other letters become their code.

    Examples
    --------
    >>> from s4a.input.files import slug
    >>> slug("Crâne 3.b"), slug("脳")
    ('Crane_3_b', 'u8133')
    """
    letters = [c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c)]
    ascii_only = "".join(c if c.isascii() else f"u{ord(c):x}" for c in letters)
    return re.sub(r"[^A-Za-z0-9_-]", "_", ascii_only) or "_"


def slugs(files: Iterable[str | os.PathLike]) -> list[str]:
    """A unique :func:`slug` for each path, also where upper and lower case are one."""
    files = [Path(os.path.abspath(file)) for file in files]
    base = os.path.commonpath([file.parent for file in files])
    paths = [file.relative_to(base).as_posix() for file in files]
    level = dict.fromkeys(paths, 0)  # how much of the path a name is made of

    def name(path):
        stem = Path(path).with_name(stem_of(path)).as_posix()
        digest = hashlib.sha256(os.fsencode(path)).hexdigest()[:8]
        return slug([Path(stem).name, stem, path, f"{path}_{digest}"][level[path]])

    while True:
        names = {path: name(path).casefold() for path in paths}
        count = Counter(names.values())
        shared = [path for path in paths if count[names[path]] > 1 and level[path] < 3]
        if not shared:
            return [name(path) for path in paths]
        for path in shared:
            level[path] += 1
