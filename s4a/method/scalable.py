"""SCALABLE: local functions instead of a coarse mesh (4.1, 5.2, 5.3).

Magnet & Ovsjanikov, "Scalable and Efficient Functional Map Computations on Dense Meshes" (2023).
Every sample of the dense mesh has a smooth local function of compact support.  Their values are the
columns of U, with rows of sum 1.  The Laplacian is restricted to their span, U^T W U phi =
lambda U^T A U phi, and functional maps use these phi.

:func:`reduce` returns them as a :class:`s4a.method.shape.Shape`, :func:`reduced` as the Dataset
``/coarse`` of a study with ``method="scalable"``.
"""

import logging

import numpy as np
import scipy.sparse as sp
import xarray as xr
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from s4a.geometry.align import farthest_points
from s4a.geometry.mesh import as_arrays, counted_edges, edge_graph, stiffness, vertex_areas
from s4a.geometry.voronoi import add_samples, dual, farthest_of_each, voronoi_cells
from s4a.method.remesh import check_clean, laplacian, sample_surface
from s4a.method.shape import Basis, Shape
from s4a.method.spectral import canonical, nearest_eigenpairs, solved
from s4a.schema import Array, check_count, dataset, in_unit, require, unit_of

log = logging.getLogger(__name__)

_RADIUS = 3.0  # of local functions, in radii of a disk of area / samples: nine overlap on average
GROUP = 64  # samples whose shortest paths are computed together
# meaning of the variables of /coarse without a coarse mesh
_MEANING = {
    "position": "position of the sample",
    "corner_vertex": "samples of adjacent cells: the dual mesh, for pictures and normals",
    "vertex_area": "integral of the local function: row sum of U^T A U",
    "edge_vertex": "samples whose local functions, or edges between them, overlap",
    "cotan_weight": "entry of -U^T W U, whose rows sum to 0",
    "sample_vertex": "vertex of the sample in the original mesh",
    "eigenvalue": "eigenvalue of U^T W U phi = lambda U^T A U phi",
    "eigenfunction": "coefficients phi of the eigenfunction U phi, orthonormal in U^T A U",
}


def bump(distance: Array, radius: float | Array) -> Array:
    """Evaluate the smooth step 1 - 3 s^2 + 2 s^3 of s = distance / radius, which is 0 for s > 1.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.method.scalable import bump
    >>> bump(np.array([0.0, 1.0, 2.0, 3.0]), 2.0).tolist()
    [1.0, 0.5, 0.0, 0.0]
    """
    s = np.minimum(distance / radius, 1)
    return 1 - 3 * s**2 + 2 * s**3


def covering_samples(
    X: Array, T: Array, p: int, seed: int = 0
) -> tuple[Array, Array, float, sp.csr_array]:
    """Sample a mesh such that every vertex is in the support of a local function.

    Farthest points in position and normal, and more samples if a vertex is far from these along the
    surface, as behind a thin wall.

    Returns
    -------
    sample : int ndarray (about p,)
    cell : int ndarray (n,)
        Nearest sample along the edges.
    radius : float
    G : sparse matrix (n, n)
        Edge lengths.
    """
    E, count = counted_edges(T, len(X))
    G = edge_graph(X, E)
    initial = sample_surface(X, T, G, E[count == 1], np.zeros(len(X), bool), min(p, len(X)), seed)
    radius = _RADIUS * np.sqrt(vertex_areas(X, T).sum() / (np.pi * len(initial)))
    state = voronoi_cells(G, initial)
    while len(far := np.flatnonzero(state.distance > 0.75 * radius)):
        state = add_samples(G, farthest_of_each(state.cell[far], far, state.distance), state)
    return state.sample, state.cell, radius, G


def local_functions(X: Array, G: sp.csr_array, sample: Array, radius: float) -> sp.csr_array:
    """Return U ``(n, p)``: functions of the distance to each sample along edges, rows of sum 1.

    Paths shorter than the radius stay in the ball of that radius, so each group of samples searches
    few vertices.
    """
    tree, middle = cKDTree(X), farthest_points(X[sample], -(-len(sample) // GROUP))
    group = cKDTree(X[sample[middle]]).query(X[sample])[1]
    rows, columns, values = [], [], []
    for number in np.unique(group):
        members = np.flatnonzero(group == number)
        near = np.unique(np.concatenate(tree.query_ball_point(X[sample[members]], radius))).astype(
            np.int64
        )
        distance = dijkstra(
            G[near][:, near], indices=np.searchsorted(near, sample[members]), limit=radius
        )
        which, vertex = np.nonzero(distance < radius)
        rows.append(near[vertex])
        columns.append(members[which])
        values.append(bump(distance[which, vertex], radius))
    U = sp.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        (len(X), len(sample)),
    )
    return sp.csr_matrix(sp.diags(1 / np.asarray(U.sum(axis=1)).ravel()) @ U)


def _reduced_eigenpairs(U, W, area, k):
    """The k smallest eigenpairs of U^T W U phi = lambda U^T A U phi, for areas of sum 1.

    Returns
    -------
    eigenvalue : float ndarray (k,)
    Phi : float ndarray (p, k)
    mass : sparse matrix (p, p)
        U^T A U; Phi^T mass Phi = I.
    """
    stiff, mass = (U.T @ W @ U).tocsc(), (U.T @ sp.diags(area) @ U).tocsc()
    # keeps the factor away from the constants
    shift = 1e-6 * stiff.diagonal().sum() / mass.diagonal().sum()
    pairs = nearest_eigenpairs(stiff, k, -shift, 1.0, mass)
    eigenvalue, Phi = canonical(*pairs, U.T @ area, lambda Phi: area @ (U @ Phi) ** 3)
    return eigenvalue, Phi, mass.tocsr()


def reduce(mesh: xr.Dataset, *, n_samples: int = 6000, k: int = 100, seed: int = 0) -> Shape:
    """Compute the spectrum of a clean mesh in the span of about `n_samples` local functions.

    Parameters
    ----------
    mesh : xarray.Dataset
        With ``position`` and ``corner_vertex``.
    n_samples : int
        Number of samples; a few more if the surface needs them, at most all vertices.
    k : int
        Number of eigenpairs.
    seed : int

    Returns
    -------
    Shape
        ``low`` has the samples as vertices and no triangles.  Its eigenvalues are 5 % too large on
        a sphere and 12 to 15 % on a head, as local functions do not contain linear functions.

    Raises
    ------
    ValueError
        If the mesh lacks a variable, or k is not smaller than the number of samples.

    References
    ----------
    R. Magnet and M. Ovsjanikov (2023), Scalable and efficient functional map computations on dense
    meshes, Computer Graphics Forum 42(2).

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.method.scalable import reduce
    >>> shape = reduce(s4a.synthetic.sphere(2000), n_samples=300, k=4)
    >>> bool(np.allclose(shape.low.eigenvalue, 8 * np.pi * np.array([0, 1, 1, 1]), rtol=0.1))
    True
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    return spectral_space(mesh, *local_space(mesh, n_samples, seed), k)


def local_space(
    mesh: xr.Dataset, n_samples: int = 6000, seed: int = 0
) -> tuple[Array, Array, sp.csr_matrix]:
    """Return samples ``(p,)``, cells ``(n,)`` and U ``(n, p)``, the first half of `reduce`."""
    X, T = as_arrays(mesh)
    X = Shape(mesh).to_frame(X)
    sample, cell, radius, G = covering_samples(X, T, n_samples, seed)
    return sample, cell, local_functions(X, G, sample, radius)


def spectral_space(
    mesh: xr.Dataset, sample: Array, cell: Array, U: sp.csr_matrix, k: int = 100
) -> Shape:
    """Compute the eigenpairs in the span of U: the second half of :func:`reduce`."""
    check_count("k", k, 1, len(sample) - 1)
    X, T = as_arrays(mesh)
    X = Shape(mesh).to_frame(X)
    E, w, area, _ = laplacian(X, T, vertex_areas(X, T))
    area = area / area.sum()
    eigenvalue, Phi, mass = _reduced_eigenpairs(U, stiffness(E, w, len(X)), area, k)
    low = Basis(X[sample], np.empty((0, 3), np.int32), U.T @ area, Phi, eigenvalue, mass)
    full = Basis(X, T, area, Phi, eigenvalue, mass, U)
    return Shape.of(mesh, low=low, full=full, U=U, cell=cell)


def reduced(mesh: xr.Dataset, *, n_coarse: int = 6000, k: int = 100, seed: int = 0) -> xr.Dataset:
    """Return samples and local functions of a mesh in the form of a low-resolution mesh (4.1).

    All later steps accept it, as it has the variables of :func:`s4a.coarsen` and
    :func:`s4a.spectrum`.  The vertices are samples of the original, and the triangles connect
    samples of adjacent geodesic Voronoi cells.  They serve pictures and normals only, and need not
    be manifold.

    Parameters
    ----------
    mesh : xarray.Dataset
        See :func:`s4a.coarsen`.
    n_coarse : int
        Number of samples, see :func:`reduce`.
    k : int
        Number of eigenpairs, see :func:`s4a.spectrum`.
    seed : int

    Returns
    -------
    xarray.Dataset
        ``position``, ``corner_vertex``, ``sample_vertex``: the samples and the dual of their cells;
        ``sample_cell(original_vertex)``: the cells; ``local_vertex``, ``local_sample``,
        ``local_weight(entry)``: U, instead of ``coarse_vertex`` and ``coarse_weight``, as rows have
        eight to twelve entries on average; ``vertex_area``: row sums of U^T A U; ``edge_vertex``
        and ``cotan_weight``: U^T W U; ``edge_mass``: U^T A U, see
        :func:`s4a.method.spectral.unit_mass`; ``eigenvalue``, ``eigenfunction``: phi, with U phi at
        all vertices.  The attribute ``method`` is "scalable"; for the others see
        :func:`s4a.coarsen`.

    Raises
    ------
    ValueError
        If the mesh is not clean, an option is out of range, or the solver does not converge.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.method.scalable import reduced
    >>> ball = s4a.synthetic.sphere(2000)
    >>> low = reduced(ball, n_coarse=300, k=4)
    >>> bool(np.isclose(low["vertex_area"].sum(), 4 * np.pi, rtol=0.01))
    True
    >>> bool(np.allclose(low["eigenvalue"] / (4 * np.pi), [0, 2, 2, 2], rtol=0.1))
    True
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    check_count("n_coarse", n_coarse, 4)
    X, T = as_arrays(mesh)
    check_clean(X, T)
    sample, cell, U = local_space(mesh, n_coarse, seed)
    p = len(sample)
    E, w, area, kind = laplacian(X, T, vertex_areas(X, T))
    total, W = area.sum(), stiffness(E, w, len(X))
    (eigenvalue, Phi, mass), found = solved(
        lambda k: _reduced_eigenpairs(U, W, area / total, k), k, w, p, "samples"
    )
    attrs: dict[str, int | str] = {
        "method": "scalable",
        "n_coarse": int(n_coarse),
        "seed": int(seed),
        "wrapped": 0,
        "kept_whole": int(p == len(X)),
        "laplacian": kind,
        **found,
    }
    stiff = sp.csr_matrix(U.T @ W @ U)
    i, j = sp.triu(abs(stiff) + abs(mass), 1).nonzero()
    entries = U.tocoo()
    data = dataset(
        attrs,
        position=X[sample],
        corner_vertex=dual(T, cell).astype(np.int32),
        vertex_area=U.T @ area,
        edge_vertex=np.stack([i, j], axis=1).astype(np.int32),
        cotan_weight=-np.asarray(stiff[i, j]).ravel(),
        edge_mass=total * np.asarray(mass[i, j]).ravel(),
        sample_vertex=sample.astype(np.int32),
        sample_cell=cell.astype(np.int32),
        local_vertex=entries.row.astype(np.int32),
        local_sample=entries.col.astype(np.int32),
        local_weight=entries.data,
        eigenvalue=eigenvalue,
        eigenfunction=Phi,
    )
    for name, meaning in _MEANING.items():
        data[name].attrs["long_name"] = meaning
    return in_unit(data, unit_of(mesh["position"]))
