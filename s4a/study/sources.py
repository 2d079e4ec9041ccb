"""Input of an analysis (5.1, the data): shapes, landmarks, fields, and keys of their content."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from s4a.geometry.mesh import as_dataset
from s4a.input.annotations import feature_files
from s4a.input.coordinates import CoordinateSystem, common, says_nothing
from s4a.input.files import check_names, files_named, find_meshes, systems_of
from s4a.input.landmarks import SUFFIXES
from s4a.input.raw import read_bytes, shown
from s4a.input.subjects import is_missing, listed
from s4a.method.shape import features_of
from s4a.options import Options
from s4a.schema import require
from s4a.study.netcdf import read
from s4a.study.store import task_key

# files; a dict of name to a file, a Dataset or (points, triangles); or what read_shapes returns
Collection = Path | str | list[Path | str] | dict[str, Any] | xr.DataTree
Sources = dict[str, tuple[str | xr.Dataset, str]]  # name -> path or mesh, key of its content
Keyed = tuple[str, str]  # a file, and the key of its content


SEVERAL = (
    "s4a_morphometrics.analyse_structures (s4a run-structures) analyses several structures of each "
    "subject: pip install 's4a[morphometrics]'"
)


class Guides(NamedTuple):
    """Files that guide the registration of a shape: landmarks, and fields by name."""

    landmarks: Keyed | None
    features: dict[str, Keyed]


Marked = dict[str, Guides]  # by the name of the shape


def find_sources(
    shapes: Collection, pattern: str | None = None, *, volumes: bool = False
) -> Sources:
    """Return path or Dataset of each shape, and the key of its content, sorted by name.

    Parameters
    ----------
    shapes : see :func:`s4a.analyse`
    pattern : str, optional
        Use only files whose name matches.
    volumes : bool
        The files are label volumes.

    Raises
    ------
    ValueError
        If there is no shape, or a name or a mesh is invalid.
    OSError
        If a file disappears meanwhile.

    Examples
    --------
    >>> import s4a
    >>> from s4a.study.sources import find_sources
    >>> list(find_sources({"b": s4a.synthetic.sphere(9), "a": s4a.synthetic.sphere(12)}))
    ['a', 'b']
    """
    if isinstance(shapes, xr.DataTree):
        if "original" not in shapes:
            raise ValueError(
                "the DataTree needs a node /original with a node per shape, such as "
                "s4a.read_shapes returns"
            )
        shapes = {name: node.to_dataset() for name, node in shapes["original"].children.items()}
    if not isinstance(shapes, dict):
        files = sorted((name, path) for path, name in find_meshes(shapes, pattern, volumes=volumes))
        sources: Sources = {name: (str(path), content_of_file(path)) for name, path in files}
        for _, path in files:  # the folder may have been unmounted
            if not os.path.lexists(path):
                raise OSError(f"{shown(path)} disappeared since the run began: start it again")
        return sources
    check_names(shapes)
    return {name: _source_of(name, mesh) for name, mesh in sorted(shapes.items())}


def _source_of(name, mesh):
    """Mesh or path given by name, and the key of its content."""
    if isinstance(mesh, dict):
        raise ValueError(
            f"shape {name}: a mesh or a file needed; found a dict of {listed(list(map(str, mesh)))}"
            f"; {SEVERAL}"
        )
    if isinstance(mesh, str | Path):
        if not Path(mesh).is_file():
            raise ValueError(f"shape {name}: {shown(mesh)} is not a file")
        return str(mesh), content_of_file(mesh)
    mesh = mesh if isinstance(mesh, xr.Dataset) else as_dataset(*mesh)
    require(mesh, "position", "corner_vertex", what=f"shape {name}")
    return mesh, content_key(mesh)


def common_system(sources: Sources, options: Options) -> tuple[dict[str, str], list[str]]:
    """Return attributes of the system to convert all shapes to, if they differ, and a remark.

    Raises ValueError if some systems are known and others are not.
    """
    given = CoordinateSystem.of(vars(options))
    said = {n: m for n, (m, _) in sources.items() if isinstance(m, str) or not says_nothing(m)}
    systems = systems_of(said, given)
    target = common(systems)
    others = [
        f"{n} ({s})" for n, s in systems.items() if (s.axes, s.unit) != (target.axes, target.unit)
    ]
    n_all = f"{len(others)} of {len(systems)} shapes"
    remark = f"{n_all} were converted to {target}: {listed(others)}"
    return (target.attrs, [remark]) if others else ({}, [])


def content_of_file(path: Path | str) -> str:
    """Key of the bytes of a file, or of the error in reading it, which its task will raise."""
    try:
        return task_key(read_bytes(path))
    except ValueError as error:
        return task_key(str(error))


def content_key(mesh: xr.Dataset) -> str:
    """Key of all variables of a mesh in memory, with labels and landmarks."""
    variables = {str(name): variable.values for name, variable in sorted(mesh.variables.items())}
    parts = [v.tolist() if v.dtype.hasobject else v for v in variables.values()]
    return task_key(list(variables), *parts)


def find_guides(
    sources: Sources, folder: Path | str | None = None, features: Sequence[str] = ()
) -> Marked:
    """Find files that guide the shapes: landmarks in a folder, and fields next to the meshes.

    Raises ValueError if there is no landmark file, or no file of a field, for any shape.
    """
    files = {} if folder is None else files_named(folder, sources, "landmarks", SUFFIXES)
    paths = {name: mesh if isinstance(mesh, str) else "" for name, (mesh, _) in sources.items()}
    marked = {n: guides_of_shape(paths[n], files.get(n), features) for n in sources}
    for field in features:
        if not any(field in marked[n].features or _has(sources[n][0], field) for n in sources):
            example = f"{next(iter(sources))}.{field}.npy"
            raise ValueError(
                f"features: no shape has a field {field!r}: a file such as {example} next to that "
                "of the mesh needed, a vertex property of PLY files, or s4a.with_features for "
                "meshes in memory"
            )
    return {name: guides for name, guides in marked.items() if any(guides)}


def guides_of_shape(path: str, landmarks: Path | None, features: Sequence[str]) -> Guides:
    """Files that guide one shape: landmarks, and fields next to its file."""
    files = feature_files(path, features) if path and features else {}
    fields = {field: _keyed(file) for field, file in files.items()}
    return Guides(_keyed(landmarks) if landmarks else None, fields)


def _keyed(file):
    return str(file), content_of_file(file)


def _has(source, feature):
    """Whether a source is a mesh in memory with a field of that name."""
    return not isinstance(source, str) and feature in features_of(source)


def remarks_on_guides(sources: Sources, marked: Marked, features: Sequence[str] = ()) -> list[str]:
    """Remarks on shapes without landmark file or field, if others have one."""
    missing = {"landmark file": [n for n in sources if not (n in marked and marked[n][0])]}
    for field in features:
        having = {name for name in marked if field in marked[name].features}
        having |= {n for n, (mesh, _) in sources.items() if _has(mesh, field)}
        missing[f"field {field!r}"] = [name for name in sources if name not in having]
    return [
        f"{len(names)} of {len(sources)} shapes have no {what} and are registered without: "
        f"{listed(names)}"
        for what, names in missing.items()
        if 0 < len(names) < len(sources)
    ]


def check_one_structure(subjects: xr.Dataset) -> None:
    """Raise ValueError if the shapes of a table are several structures of each subject."""
    if not {"structure", "subject"} <= set(subjects):
        return
    if len({cell for cell in map(str, subjects["structure"].values) if not is_missing(cell)}) > 1:
        raise ValueError(
            f"{subjects.attrs['path']}: one structure expected in the column 'structure', found "
            f"several; {SEVERAL}; else rename the column"
        )


def with_contents(subjects: xr.Dataset, sources: Sources) -> xr.Dataset:
    """Add the keys of the shapes' contents to a table, for :func:`remarks_on_table`."""
    keys = [sources[name][1] for name in subjects["shape"].values.tolist()]
    return subjects.assign_attrs(contents=" ".join(keys))


def remarks_on_table(file: Path, sources: Sources) -> list[str]:
    """Remarks on a table of an earlier run, which is kept, if it does not match the shapes."""
    if not file.is_file():
        return []
    table = read(file)
    names = table["shape"].values.tolist()
    contents = dict(zip(names, table.attrs.get("contents", "").split(), strict=False))
    faults = {
        "it has no row for": [name for name in sources if name not in names],
        "it has rows for other shapes:": [name for name in names if name not in sources],
        "the meshes have changed:": [
            name for name, key in contents.items() if sources.get(name, ("", key))[1] != key
        ],
    }
    texts = [f"{text} {listed(shapes)}" for text, shapes in faults.items() if shapes]
    if not texts:
        return []
    return [
        f"the table of an earlier run, {table.attrs['path']}, is kept, but {'; '.join(texts)}: "
        "give it again if it is valid, or another (--table FILE)"
    ]
