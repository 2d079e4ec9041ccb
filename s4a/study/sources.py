"""The shapes that an analysis is given (5.1, the data), each with the key of its content."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr

from s4a.geometry.mesh import as_dataset
from s4a.input.annotations import feature_files
from s4a.input.files import check_names, files_named, find_meshes
from s4a.input.landmarks import SUFFIXES
from s4a.input.raw import read_bytes, shown
from s4a.input.subjects import is_missing, listed
from s4a.method.shape import features_of
from s4a.schema import require
from s4a.study.netcdf import read
from s4a.study.store import task_key

# files; or by name files or meshes, Datasets or (points, triangles); or what read_shapes gives
Collection = Path | str | list[Path | str] | dict[str, Any] | xr.DataTree
Sources = dict[str, tuple[str | xr.Dataset, str]]  # name -> path or mesh, key of its content
Keyed = tuple[str, str]  # a file, and the key of its content


SEVERAL = (
    "s4a_morphometrics.analyse_structures (s4a run-structures) analyses several structures of each "
    "subject: pip install 's4a[morphometrics]'"
)


class Guides(NamedTuple):
    """Files of what guides the registration of a shape: landmarks, and fields by their names."""

    landmarks: Keyed | None
    features: dict[str, Keyed]


Marked = dict[str, Guides]  # by the name of the shape


def find_sources(
    shapes: Collection, pattern: str | None = None, *, volumes: bool = False
) -> Sources:
    """What the user gave, in the order of the names: path or Dataset, and the key of its content.

    Parameters
    ----------
    shapes : see :func:`s4a.analyse`
    pattern : str, optional
        Of the files found, those whose name it matches.
    volumes : bool
        Whether the files are label volumes.

    Raises
    ------
    ValueError
        When there is no shape, or a name or a mesh that cannot be used.
    OSError
        When a file has gone while all were looked at.

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
                "the DataTree needs a node /original with one node per shape, as of s4a.read_shapes"
            )
        shapes = {name: node.to_dataset() for name, node in shapes["original"].children.items()}
    if not isinstance(shapes, dict):
        files = sorted((name, path) for path, name in find_meshes(shapes, pattern, volumes=volumes))
        found: Sources = {name: (str(path), content_of_file(path)) for name, path in files}
        for _, path in files:  # an unmounted folder is not one of unreadable files
            if not os.path.lexists(path):
                raise OSError(f"{shown(path)} has gone since the run began: start it again")
        return found
    check_names(shapes)
    return {name: _source_of(name, mesh) for name, mesh in sorted(shapes.items())}


def _source_of(name, mesh):
    """A mesh or file that was given by name, and the key of its content."""
    if isinstance(mesh, dict):
        raise ValueError(
            f"shape {name}: a mesh or a file needed, found a dict of {listed(list(map(str, mesh)))}"
            f"; {SEVERAL}"
        )
    if isinstance(mesh, str | Path):
        if not Path(mesh).is_file():
            raise ValueError(f"shape {name}: {shown(mesh)} is no file")
        return str(mesh), content_of_file(mesh)
    mesh = mesh if isinstance(mesh, xr.Dataset) else as_dataset(*mesh)
    require(mesh, "position", "corner_vertex", what=f"shape {name}")
    return mesh, content_key(mesh)


def content_of_file(path: Path | str) -> str:
    """The key of the bytes of a file, or of why it cannot be read, which its task will say."""
    try:
        return task_key(read_bytes(path))
    except ValueError as error:
        return task_key(str(error))


def content_key(mesh: xr.Dataset) -> str:
    """The key of everything that a mesh in memory holds, labels and landmarks too."""
    variables = {str(name): variable.values for name, variable in sorted(mesh.variables.items())}
    parts = [v.tolist() if v.dtype.hasobject else v for v in variables.values()]
    return task_key(list(variables), *parts)


def find_guides(
    sources: Sources, folder: Path | str | None = None, features: Sequence[str] = ()
) -> Marked:
    """What guides the shapes: landmarks of a folder, and fields beside their files.

    ValueError where there is no file of landmarks, or of a field, for any shape.
    """
    files = {} if folder is None else files_named(folder, sources, "landmarks", SUFFIXES)
    paths = {name: mesh if isinstance(mesh, str) else "" for name, (mesh, _) in sources.items()}
    marked = {n: guides_of_shape(paths[n], files.get(n), features) for n in sources}
    for one in features:
        if not any(one in marked[n].features or _holds(sources[n][0], one) for n in sources):
            first = next(iter(sources))
            raise ValueError(
                f"features: no shape has a field {one!r}: a file such as {first}.{one}.npy beside "
                "that of the mesh needed, a property of the vertices of PLY files, or "
                "s4a.with_features for meshes in memory"
            )
    return {name: guides for name, guides in marked.items() if any(guides)}


def guides_of_shape(path: str, landmarks: Path | None, features: Sequence[str]) -> Guides:
    """What guides one shape: its file of landmarks, and fields beside its own file."""
    beside = feature_files(path, features) if path and features else {}
    fields = {one: _keyed(file) for one, file in beside.items()}
    return Guides(_keyed(landmarks) if landmarks else None, fields)


def _keyed(file):
    return str(file), content_of_file(file)


def _holds(source, feature):
    """Whether it is a mesh in memory with a field of that name."""
    return not isinstance(source, str) and feature in features_of(source)


def remarks_on_guides(sources: Sources, marked: Marked, features: Sequence[str] = ()) -> list[str]:
    """In words: which shapes have no file of landmarks, or of a field, where others have one."""
    lacking = {"file of landmarks": [n for n in sources if not (n in marked and marked[n][0])]}
    for one in features:
        having = {name for name in marked if one in marked[name].features}
        having |= {n for n, (mesh, _) in sources.items() if _holds(mesh, one)}
        lacking[f"field {one!r}"] = [name for name in sources if name not in having]
    return [
        f"{len(without)} of {len(sources)} shapes have no {what} and are registered without: "
        f"{listed(without)}"
        for what, without in lacking.items()
        if 0 < len(without) < len(sources)
    ]


def check_one_structure(subjects: xr.Dataset) -> None:
    """ValueError where a table says that shapes are several structures of one subject."""
    if not {"structure", "subject"} <= set(subjects):
        return
    if len({cell for cell in map(str, subjects["structure"].values) if not is_missing(cell)}) > 1:
        raise ValueError(
            f"{subjects.attrs['path']}: the column 'structure' names several, and one collection "
            f"has shapes of one kind; {SEVERAL}, or call the column otherwise"
        )


def of_contents(subjects: xr.Dataset, sources: Sources) -> xr.Dataset:
    """A table of the shapes that knows the contents it was given for, for :func:`kept_table`."""
    keys = [sources[name][1] for name in subjects["shape"].values.tolist()]
    return subjects.assign_attrs(contents=" ".join(keys))


def kept_table(file: Path, sources: Sources) -> list[str]:
    """What of a table of an earlier run, which stays until another is given, holds no longer."""
    if not file.is_file():
        return []
    table = read(file)
    names = table["shape"].values.tolist()
    given_for = dict(zip(names, table.attrs.get("contents", "").split(), strict=False))
    found = {
        "it has no row for": [name for name in sources if name not in names],
        "it has rows for what is no shape now:": [name for name in names if name not in sources],
        "other meshes have taken the names": [
            name for name, key in given_for.items() if sources.get(name, ("", key))[1] != key
        ],
    }
    said = [f"{words} {listed(of)}" for words, of in found.items() if of]
    if not said:
        return []
    return [
        f"the table of an earlier run, {table.attrs['path']}, is kept, but {'; '.join(said)}: give "
        "it again if it holds, or another (--table FILE)"
    ]
