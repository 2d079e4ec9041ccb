"""The shapes that an analysis is given (5.1, the data), each with the key of its content."""

from pathlib import Path
from typing import Any

import xarray as xr

from s4a.geometry.mesh import as_dataset
from s4a.input.files import find_meshes, slug
from s4a.schema import require
from s4a.study.store import task_key

# files; or meshes in memory by name, Datasets or (points, triangles); or what read_shapes gives
Collection = Path | str | list[Path | str] | dict[str, Any] | xr.DataTree
Sources = dict[str, tuple[str | xr.Dataset, str]]  # name -> path or mesh, key of its content


def find_sources(shapes: Collection, pattern: str | None = None) -> Sources:
    """What the user gave, in the order of the names: path or Dataset, and the key of its content.

    Parameters
    ----------
    shapes : see :func:`s4a.analyse`
    pattern : str, optional
        Of the files found, those whose name it matches.

    Raises
    ------
    ValueError
        When there is no shape, or a name or a mesh that cannot be used.

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
        files = sorted((name, path) for path, name in find_meshes(shapes, pattern))
        return {name: (str(path), task_key(Path(path).read_bytes())) for name, path in files}
    wrong = [name for name in shapes if not isinstance(name, str) or slug(name) != name]
    if wrong or not shapes:
        raise ValueError(f"shapes need names of letters, digits, _ and -; found {wrong or 'none'}")
    meshes = {
        name: mesh if isinstance(mesh, xr.Dataset) else as_dataset(*mesh)
        for name, mesh in sorted(shapes.items())
    }
    for name, mesh in meshes.items():
        require(mesh, "position", "corner_vertex", what=f"shape {name}")
    return {name: (mesh, content_key(mesh)) for name, mesh in meshes.items()}


def content_key(mesh: xr.Dataset) -> str:
    """The key of everything that a mesh in memory holds, labels and landmarks too."""
    variables = {str(name): variable.values for name, variable in sorted(mesh.variables.items())}
    parts = [v.tolist() if v.dtype.hasobject else v for v in variables.values()]
    return task_key(list(variables), *parts)
