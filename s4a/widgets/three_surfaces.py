"""Surfaces as pythreejs meshes, coloured by a field."""

import warnings

import numpy as np
import pythreejs as three
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import Colormap, to_hex

from s4a.geometry.mesh import as_arrays, vertex_normals
from s4a.schema import require
from s4a.show.draw import CLAY, SIGNED, UNKNOWN, label_colors


def surface(
    mesh: xr.Dataset,
    field: str | np.ndarray | xr.DataArray | None = None,
    cmap: str | Colormap | None = None,
    *,
    limits: tuple[float, float] | None = None,
    colors: np.ndarray | None = None,
) -> three.Mesh:
    """A mesh Dataset as a smooth pythreejs surface, coloured by a field.

    Parameters
    ----------
    mesh : xarray.Dataset
        With ``position(vertex, xyz)`` and ``corner_vertex(triangle, corner)``.
    field : str or ndarray (vertex,) or (vertex, 3), optional
        A value of each vertex, or the name of such a variable of the mesh: integers and booleans
        are labels, with a colour each, other numbers go through the colour map, and three of them
        are red, green and blue, from 0 to 1.  Where it is not finite the surface is grey.
    cmap : str or matplotlib.colors.Colormap, optional
        By default red, white and blue for a field of both signs, "viridis" for one of one sign.
    limits : (float, float), optional
        Values of the two ends of the colour map; by default those of the field, without its
        outermost percent, and as far below zero as above for a field of both signs.
    colors : ndarray (vertex, 3), optional
        The former name of `field`; deprecated.

    Returns
    -------
    pythreejs.Mesh

    Raises
    ------
    ValueError
        When a position is not finite or the field has not one value for each vertex.

    Examples
    --------
    >>> import s4a
    >>> from s4a.widgets import threejs
    >>> mesh = s4a.synthetic.sphere(100)
    >>> ball = threejs.surface(mesh, mesh["position"][:, 2], "magma")
    >>> ball.geometry.attributes["color"].array.shape
    (100, 3)
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    if colors is not None:
        warnings.warn("colors is now field", DeprecationWarning, stacklevel=2)
        field = colors
    X, T = as_arrays(mesh)
    _check_finite(X)
    values = None if field is None else _field_colors(mesh, field, cmap, limits)
    return three.Mesh(smooth_geometry(X, T, color=values), standard_material(values is not None))


def _check_finite(X):
    if not np.isfinite(X).all():
        wrong = (~np.isfinite(X)).any(1).sum()
        raise ValueError(
            f"finite positions needed, found {wrong} vertices that are not; "
            "s4a.clean repairs the mesh"
        )


def _field_colors(mesh, field, cmap, limits):
    """Colours (n, 3) of what was given as the field of a mesh."""
    if isinstance(field, str):
        if field not in mesh:
            raise ValueError(
                f"a variable of the mesh needed, found {field!r}; it has {', '.join(mesh)}"
            )
        field = mesh[field]
    values, n = np.asarray(field), mesh.sizes["vertex"]
    if values.shape not in ((n,), (n, 3)):
        raise ValueError(
            f"a value or a colour (3) for each of {n} vertices needed, found {values.shape}"
        )
    if values.ndim == 2:
        return np.where(np.isfinite(values), np.clip(values, 0, 1), UNKNOWN)
    if values.dtype.kind in "iub":
        return label_colors(values.astype(int))
    return field_colors(values, cmap, limits)


def field_colors(
    values: np.ndarray,
    cmap: str | Colormap | None = None,
    limits: tuple[float, float] | None = None,
) -> np.ndarray:
    """Colours ``(n, 3)`` of numbers ``(n,)``; see :func:`surface`.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.widgets.threejs import field_colors
    >>> field_colors(np.array([0.0, 0.5, 1.0]), "gray").round().tolist()
    [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """
    known = np.isfinite(values)
    low, high = np.quantile(values[known], (0.01, 0.99)) if known.any() else (0.0, 1.0)
    signed = low < 0 < high
    if limits is not None:
        low, high = limits
    elif signed:
        low, high = -max(-low, high), max(-low, high)
    shares = np.clip((np.where(known, values, low) - low) / (high - low or 1), 0, 1)
    colormap = colormaps.get_cmap(cmap or (SIGNED if signed else "viridis"))
    return np.where(known[:, None], colormap(shares)[:, :3], UNKNOWN)


def smooth_geometry(
    X: np.ndarray, T: np.ndarray, **attributes: np.ndarray | None
) -> three.BufferGeometry:
    """A geometry of vertices, triangles and what else is of each vertex; None is left out."""
    known = {"position": X, "normal": vertex_normals(X, T)} | attributes
    return three.BufferGeometry(
        attributes={
            name: three.BufferAttribute(
                np.ascontiguousarray(values, dtype=np.float32), normalized=False
            )
            for name, values in known.items()
            if values is not None
        },
        index=three.BufferAttribute(np.asarray(T, np.uint32).ravel(), normalized=False),
    )


def standard_material(colored: bool) -> three.Material:
    """Slightly rough, seen from both sides; in the vertices' colours or that of clay."""
    look = {"vertexColors": "VertexColors"} if colored else {"color": to_hex(CLAY)}
    return three.MeshStandardMaterial(roughness=0.7, metalness=0.05, side="DoubleSide", **look)
