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
from typing import Any

import numpy as np

from s4a.input.formats import FORMATS, NPZ_KEYS, SURFER, format_of
from s4a.input.labels import VOLUMES, is_volume
from s4a.input.raw import check_there, content, regular_file, shown

SUFFIXES = {suffix: name for name, known in FORMATS.items() for suffix in known.suffixes.split()}
WRITERS = {known.suffixes.split()[0]: known.write for known in FORMATS.values() if known.write}
LONGEST_NAME = 100  # letters of a shape's name, so that files of a study can be named after it
OTHERS = ".json .csv .txt .md .html .png .jpg .nc .npy .annot .nii".split()  # that a glob may match

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


def read_mesh(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
    """Points and triangles of a mesh file; the format is told by the content, not by the name.

    Parameters
    ----------
    path : str or Path
        PLY, OBJ, OFF, STL, VTK legacy polydata, VTP, GIFTI, FreeSurfer surface, or NPZ with the
        keys V and F, vertices and faces, points and triangles, position and corner_vertex, or X and
        T; each of them compressed by gzip too (.ply.gz), which may unpack to 1 GiB.  A regular
        file of 2 GiB at most.  Polygons become fans of triangles.

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
    check_there(path)
    name = "mesh"
    try:
        data = content(path).removeprefix(b"\xef\xbb\xbf")
        if is_volume(data):
            raise ValueError("found a volume; with a label (label=17, --label 17) it is a surface")
        name = format_of(data)
        with np.errstate(all="ignore"):  # nonsense in the file is refused, or left to the cleaning
            points, triangles, attrs = FORMATS[name].read(data)
            points, triangles = _checked(points, triangles)
    except Exception as error:  # whatever a file holds, it must not end the run over a collection
        why = shown(error) or type(error).__name__
        raise ValueError(f"{shown(path)} cannot be read as {name}: {why}") from error
    attrs = {"format": name, **attrs}
    space = re.search(rb"SPACE=(RAS|LPS)", data[:1000])  # as 3D Slicer writes it into any header
    if space:
        attrs["coordinate_system"] = space[1].decode()
    if SUFFIXES.get(suffix_of(path), name) != name:
        attrs["note"] = f"named {path.suffix} but holds {name}, and was read as that; rename it"
    return points, triangles, attrs


def suffix_of(path: str | os.PathLike[str]) -> str:
    """What the name promises: the suffix in lower case, that before .gz where there is one.

    Examples
    --------
    >>> from s4a.input.files import suffix_of
    >>> suffix_of("a.PLY"), suffix_of("lh.pial.gz"), suffix_of("a.tar.gz")
    ('.ply', '.pial', '.tar')
    """
    return Path(Path(path).name.lower().removesuffix(".gz")).suffix


def stem_of(path: str | os.PathLike[str]) -> str:
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
    path: str | os.PathLike[str],
    points: np.ndarray,
    triangles: np.ndarray,
    **vertex_scalars: np.ndarray,
) -> None:
    """Write a mesh in the format of the suffix.

    These are .ply (binary), .obj, .off, .stl, .vtk, .vtp, .gii and .npz.

    Parameters
    ----------
    path : str or Path
    points : float ndarray (n, 3)
    triangles : int ndarray (m, 3)
    **vertex_scalars : float ndarray (n,)
        Values per vertex by name; PLY, VTK, VTP, GIFTI and NPZ hold them, as float32 but for NPZ.

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
        raise ValueError(
            f"{suffix} holds no values per vertex; write .ply, .vtk, .vtp, .gii or .npz"
        )
    path.write_bytes(WRITERS[suffix](points, triangles, scalars))


# the files of a collection


def find_meshes(
    paths: Paths, pattern: str | None = None, *, volumes: bool = False
) -> list[tuple[Path, str]]:
    """The mesh files of a collection and a name for each.

    Parameters
    ----------
    paths : str, Path or list of these
        Folders (searched to any depth; what is no mesh is passed over, see :func:`not_meshes`),
        files, or globs such as ``"scans/*/head.stl"``.
    pattern : str, optional
        Keep the files whose name, with or without suffix, it matches: ``"*_brain"`` picks one
        structure of many.
    volumes : bool
        Look for label volumes (:mod:`s4a.input.labels`) instead of meshes.

    Returns
    -------
    list of (Path, str)
        Sorted by path.  The name has letters, digits, ``_`` and ``-`` only and is made of the
        file's name; where two would be the same, of the folders too, and of the suffix, and of a
        hash when nothing else tells them apart.  It has 100 letters at most, see :func:`slug`.

    Raises
    ------
    ValueError
        When a path is missing or no mesh is found.
    """
    found = _files(paths, volumes)
    files = [file for file, why_not in found if not why_not]
    chosen = [file for file in files if pattern is None or _matches(file, pattern)]
    if not chosen:
        what = "label volume" if volumes else "mesh"
        where = ", ".join(map(shown, _listed(paths))) or "an empty list"
        if pattern and files:
            raise ValueError(f"no {what} of {len(files)} files matching {pattern!r} in {where}")
        others = "".join(f"; {shown(file)} is {why_not}" for file, why_not in found[:3])
        raise ValueError(f"no {what} ({', '.join(_suffixes(volumes))}) in {where}{others}")
    return list(zip(chosen, slugs(chosen), strict=True))


def not_meshes(
    paths: Paths, pattern: str | None = None, *, volumes: bool = False
) -> list[tuple[Path, str]]:
    """What is named like meshes, or matched by a glob, and holds something else.

    Folders that cannot be searched are among them, and links to folders, which are not followed.

    Returns
    -------
    list of (Path, str)
        Sorted by path, with what they are.
    """
    return [
        (file, why_not)
        for file, why_not in _files(paths, volumes)
        if why_not and (pattern is None or _matches(file, pattern) or os.path.isdir(file))
    ]


def was_cut(file: Path, name: str) -> bool:
    """Whether the name of a shape was made shorter than its file's."""
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
    """All files that are meant, once and sorted, each with why it is no mesh, or ""."""
    by_place = {}
    for path in _listed(paths):
        for file, why_not in _expand(path, volumes):
            place = os.path.abspath(file)
            by_place[place] = min(by_place.get(place, (str(file), why_not)), (str(file), why_not))
    return [(Path(file), why_not) for _, (file, why_not) in sorted(by_place.items())]


def _matches(file, pattern):
    return any(fnmatch.fnmatchcase(name, pattern) for name in (file.name, file.stem, stem_of(file)))


def _expand(path, volumes):
    """The files that a folder, a file or a glob means, each with why it is no mesh, or ""."""
    path = Path(os.path.expanduser(path))
    if os.path.isdir(path):
        return _search(path, volumes)
    if os.path.lexists(path):  # named by itself, it is tried whatever it is
        return [(path, "")]
    matches = glob.glob(str(path), recursive=True) if glob.has_magic(str(path)) else []
    if not matches:
        raise ValueError(f"no file, folder or match of {shown(path)}")
    files = []
    for match in map(Path, matches):
        is_file = not os.path.isdir(match)
        files += [(match, _why_not(match, volumes))] if is_file else _search(match, volumes)
    return files


def _search(folder, volumes):
    """The files in a folder, to any depth, that are named like meshes, each with why it is none."""
    unread: list[OSError] = []
    files, others = [], []
    for place, folders, names in os.walk(folder, onerror=unread.append):
        inside = [Path(place, name) for name in folders if name[0] != "."]
        meant = [Path(place, name) for name in names if name[0] != "."]
        links = [path for path in inside if path.is_symlink()]
        others += [(path, "a link to a folder, which is not followed") for path in links]
        known = _suffixes(volumes)
        files += [(path, _why_not(path, volumes)) for path in meant if suffix_of(path) in known]
        named_so = [path for path in inside if suffix_of(path) in known and path not in links]
        others += [(path, "a folder, and its files were searched") for path in named_so]
    others += [
        (Path(error.filename), f"a folder that cannot be searched: {error.strerror}")
        for error in unread
    ]
    return files + others


def _why_not(file, volumes):
    """What a file is that may well lie beside the meshes of a collection; "" where it may be one.

    Two formats hold other things as well as meshes, and are looked into.
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
    except (ValueError, zipfile.BadZipFile):  # it will be said when it is read
        pass
    return ""


def slug(text: str) -> str:
    """`text` in letters, digits, ``_`` and ``-``: accents go, other letters become their code.

    What would have more than 100 letters is cut to 100, the last of which are a hash of `text`.

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


def check_names(names: Iterable[Any]) -> None:
    """ValueError unless there are names, and each is one that :func:`slug` leaves as it is."""
    names = list(names)
    wrong = [name for name in names if not isinstance(name, str) or slug(name) != name]
    if wrong or not names:
        raise ValueError(
            f"shapes need names of letters, digits, _ and -, at most {LONGEST_NAME} of them; "
            f"found {wrong or 'none'}"
        )


def files_named(
    folder: Path | str, names: Iterable[str], what: str, suffixes: Iterable[str], field: str = ""
) -> dict[str, Path]:
    """The file of every shape that has one: in the folder, named as the shape is.

    Parameters
    ----------
    folder : path
    names : iterable of str
        Of shapes.
    what : str
        What the files hold, for messages.
    suffixes : iterable of str
        Endings that such files have, lower case; one of ``.gz`` may follow.
    field : str, optional
        Of the field, which may stand behind the shape: ``a.npy``, ``a.thickness.npy`` or, of
        FreeSurfer, ``a.thickness``.

    Returns
    -------
    dict of str to Path

    Raises
    ------
    ValueError
        When there is no folder, no file in it is of a shape, or two are of one.
    """
    names, suffixes, folder = list(names), list(suffixes), Path(folder)
    if not folder.is_dir():
        raise ValueError(
            f"{what}: a folder of files named as the shapes needed; found {shown(folder)}"
        )
    behind = f".{field}" if field else ""
    found: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        plain = file.name[:-3] if file.name.lower().endswith(".gz") else file.name
        suffix = next((end for end in suffixes if plain.lower().endswith(end)), "")
        plain = plain[: len(plain) - len(suffix)]
        if not suffix and not (behind and plain.endswith(behind)):
            continue
        name = slug(plain.removesuffix(behind))
        if name in found and name in names:
            raise ValueError(
                f"{what}: one file for {name} needed: {shown(found[name])} and {shown(file)}"
            )
        found[name] = file
    found = {name: found[name] for name in names if name in found}
    if not found:
        endings = ", ".join([*suffixes[:4], *filter(None, [behind])])
        raise ValueError(
            f"{what}: no file in {shown(folder)} is named as a shape, such as {names[0]} with one "
            f"of {endings}"
        )
    return found


def slugs(files: Iterable[str | os.PathLike[str]]) -> list[str]:
    """A unique :func:`slug` for each path, also where upper and lower case are one."""
    whole = [Path(os.path.abspath(file)) for file in files]
    base = os.path.commonpath([file.parent for file in whole])
    paths = [file.relative_to(base).as_posix() for file in whole]
    level = dict.fromkeys(paths, 0)  # how much of the path a name is made of

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
