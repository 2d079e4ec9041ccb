r"""Low-resolution mesh and its projection operator U (4.1, step 1; U appears in eq. 4 and 7).

Follows ReMatching (Maggioli et al. 2024): farthest-point samples, the manifold dual of their
geodesic Voronoi cells (:mod:`s4a.geometry.voronoi`), and for every original vertex the closest
point on the coarse triangles around the sample of its cell.  A row of U holds the barycentric
weights of that point::

                 c            p: the point closest to x on the coarse triangles around a,
                / \              the sample whose cell contains x
               /   \
      x . . . p     \         row of x in U: the weights u at a, v at b, w at c of p,
             /       \        so that (U f)(x) = u f(a) + v f(b) + w f(c)
            a---------b
"""

import contextlib
import os
from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np
import scipy.sparse as sp
import xarray as xr
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from s4a.geometry import mesh as surface
from s4a.geometry import voronoi
from s4a.geometry.align import many_farthest_points, without_ties
from s4a.geometry.closest import closest_point, closest_point_in_star
from s4a.geometry.compiled import robust_laplacian
from s4a.geometry.mesh import as_arrays, norms, triangle_areas, vertex_areas, vertex_normals
from s4a.input.collection import Mesh, as_mesh
from s4a.options import check
from s4a.schema import Array, check_count, dataset
from s4a.seeds import RNG, seed_of

GL = "install the system's libgl1 and libopengl0, or see `s4a doctor`"
INITIAL_SHARE = 0.95  # of n_coarse that is sampled first; the rest repairs the topology of cells
MAX_SHARE = 1.1  # of n_coarse, above which handles are cut instead of adding samples
MOVED = 1e-4  # of the radius: U is computed from vertices moved by less, of which few tie
_N_CUTS = 3  # attempts to cut handles before samples are added without limit


def sample_surface(
    X: Array, T: Array, G: sp.csr_matrix, boundary: Array, avoid: Array, k: int, seed: int = 0
) -> Array:
    """Sample about k vertices of a surface evenly, with the same spacing along its boundary.

    Farthest points in (position, spacing * normal), so that both sides of a thin wall are sampled,
    and curved regions more densely.

    Parameters
    ----------
    X, T : the mesh
    G : sparse matrix (n, n)
        :func:`s4a.geometry.mesh.edge_graph`.
    boundary : int ndarray (r, 2)
        Boundary edges.
    avoid : bool ndarray (n,)
        Vertices that are not sampled.
    k, seed : int

    Returns
    -------
    int ndarray, sorted
    """
    N, area = surface.normals_and_areas(X, T)
    spacing = np.sqrt(2 / np.sqrt(3) * area.sum() / k)  # edge of equilateral triangles
    ring = G.astype(bool).astype(float)
    for _ in range(2):  # removes noise, keeps curvature at the scale of the spacing
        N += ring @ N
        N /= np.maximum(norms(N), 1e-300)[:, None]
    X = X - area @ X / area.sum()
    P = np.c_[X / spacing, N]  # (n, 6)
    center = np.zeros(6)
    sample, free = np.empty(0, np.int64), np.flatnonzero(~avoid)
    if len(boundary):
        length = np.linalg.norm(X[boundary[:, 0]] - X[boundary[:, 1]], axis=1).sum()
        n_boundary = min(int(np.ceil(length / (0.8 * spacing))), k // 2)
        boundary = np.unique(boundary)
        sample = boundary[many_farthest_points(P[boundary], n_boundary, center=center, seed=seed)]
        near = dijkstra(G, indices=boundary, min_only=True, limit=0.6 * spacing)
        free = np.setdiff1d(np.flatnonzero(np.isinf(near) & ~avoid), boundary)
    others = free[many_farthest_points(P[free], k - len(sample), center=center, seed=seed)]
    return np.sort(np.r_[sample, others])


def sample_along_surface(X: Array, G: sp.csr_matrix, avoid: Array, k: int, seed: int = 0) -> Array:
    """Sample k vertices as ReMatching does: farthest points along the edges, one at a time.

    Parameters
    ----------
    X, G, avoid, k, seed : see :func:`sample_surface`

    Returns
    -------
    int ndarray (k,), sorted
    """
    free = np.flatnonzero(~avoid)
    start = free[many_farthest_points(X[free], 1, center=X.mean(0), seed=seed)]
    samples, distance = start.tolist(), dijkstra(G, indices=start[0])
    while len(samples) < k:
        # a component without a sample comes first
        samples.append(int(np.argmax(np.where(avoid, -1, distance))))
        limit = distance[samples[-1]]
        distance = np.minimum(distance, dijkstra(G, indices=samples[-1], limit=limit))
    return np.sort(samples)


def laplacian(X: Array, T: Array, area: Array) -> tuple[Array, Array, Array, str]:
    """Return edges, cotan weights, vertex areas and kind of the Laplacian.

    Returns
    -------
    E : int ndarray (e, 2)
    w : float ndarray (e,)
    area : float ndarray (n,)
        As given, but at least a thousandth of their mean.
    kind : {"cotan", "robust"}
        "robust" (Sharp & Crane 2020) if triangles are degenerate or edges non-manifold.
    """
    area = np.maximum(area, 1e-3 * area.mean())
    E, edge_of, count = surface.unique_edges(T, len(X))
    half = surface.directed_edges(T)
    squared = ((X[half[:, 0]] - X[half[:, 1]]) ** 2).sum(1).reshape(3, -1)  # (3, m)
    degenerate = triangle_areas(X, T) < 1e-6 * squared.max(0)
    if (count > 2).any() or degenerate.any():
        L = sp.triu(robust_laplacian.mesh_laplacian(X, T)[0], 1).tocoo()
        return np.stack([L.row, L.col], axis=1), -L.data, area, "robust"
    return E, np.bincount(edge_of, surface.half_cotangents(X, T), len(E)), area, "cotan"


def _sorted_mesh(X, T, key=None):
    """The mesh sorted by position, or by a key of its vertices, and the order of its vertices.

    The coarse mesh then does not depend on the numbering of the file.
    """
    order = surface.lexical_order(X[:, ::-1]) if key is None else np.argsort(key)
    rank = np.empty(len(X), np.int64)
    rank[order] = np.arange(len(X))
    T = rank[T]
    a, b, c = T.T
    is_a, is_b = (a <= b) & (a <= c), b <= c  # least corner first, same orientation
    T = [np.where(is_a, x, np.where(is_b, y, z)) for x, y, z in ((a, b, c), (b, c, a), (c, a, b))]
    rows = surface.lexical_order(np.stack([T[2], T[0] * len(X) + T[1]], axis=1))
    return X[order], np.stack([corner.take(rows) for corner in T], axis=1), order


def _coarse_surface(X, T, found, n_coarse, seed=0, sampling="normals"):
    """Manifold dual of about `n_coarse` geodesic Voronoi cells.

    `found` are the edges of the mesh and the triangles per edge.

    Returns
    -------
    Y, C : the coarse mesh
    sample : int ndarray
        Mesh vertex of each coarse vertex; -1 for the centre of a closed opening.
    cell : int ndarray (n,)
        Coarse vertex whose cell contains each vertex of the mesh.
    attrs : dict
        Numbers of samples, iterations and vertices cut.
    """
    V, F = X, T  # the surface after cutting handles
    origin = np.arange(len(X))  # row of X of each vertex of V, -1 for the centre of a fan
    is_cut = False
    for max_samples in [MAX_SHARE * n_coarse] * (1 + _N_CUTS) + [np.inf]:
        graph = voronoi.mesh_graph(V, F, found)
        found = None  # of the surface before cuts
        is_centre = origin < 0
        n_initial = max(4, round(INITIAL_SHARE * n_coarse))
        if sampling == "geodesic":
            initial = sample_along_surface(V, graph.G, is_centre, n_initial, seed)
        else:
            boundary = graph.E[graph.is_open]
            initial = sample_surface(V, F, graph.G, boundary, is_centre, n_initial, seed)
        cells = voronoi.voronoi_cells(graph.G, initial)
        state, iterations, faulty = voronoi.refine(graph, cells, max_samples, is_centre)
        if not faulty:
            break
        if not is_cut:  # cuts depend on the numbering: number from the outside, in any pose
            is_cut = True
            V, F, origin = _sorted_mesh(V, F, -np.linalg.norm(V - V.mean(0), axis=1))
            continue
        region = voronoi.thin_regions(graph, cells)
        cell_area = triangle_areas(V, F).sum() / n_coarse
        V, F, rows = voronoi.cut_handles(
            V, F, voronoi.between_boundaries(graph.G, F, region), cell_area
        )
        origin = np.where(rows >= 0, origin[rows], -1)
    cell = np.full(len(X), -1)
    is_original = np.flatnonzero(origin >= 0)
    cell[origin[is_original]] = state.cell[is_original]
    attrs = {
        "samples_first": len(initial),
        "samples_added": len(state.sample) - len(initial),
        "iterations": iterations,
        "vertices_cut": int((cell < 0).sum()),
    }
    if attrs["vertices_cut"]:
        cell = cell[_nearest_along_edges(X, T, np.flatnonzero(cell >= 0))]
    return V[state.sample], voronoi.dual(F, state.cell), origin[state.sample], cell, attrs


def _nearest_along_edges(X, T, vertices):
    """Nearest one of some vertices along edges, for each vertex ``(n,)``."""
    G = voronoi.mesh_graph(X, T).G
    return dijkstra(G, indices=vertices, min_only=True, return_predecessors=True)[2]


def check_wrap() -> None:
    """Raise ValueError if PyMeshLab, which computes alpha wraps, cannot be used."""
    if find_spec("pymeshlab") is None:
        raise ValueError("wrap=True needs PyMeshLab: install it with `pip install 's4a[wrap]'`")
    try:
        with silence():
            import pymeshlab

            has_filter = hasattr(pymeshlab.MeshSet(verbose=False), "generate_alpha_wrap")
    except ImportError as error:
        raise ValueError(
            f"wrap=True needs PyMeshLab, which cannot be imported: {error}; {GL}"
        ) from error
    if not has_filter:
        raise ValueError(f"wrap=True needs a filter that PyMeshLab lacks: {GL}")


def alpha_wrap(X: Array, T: Array, alpha: float = 1.0, offset: float = 0.2) -> tuple[Array, Array]:
    """Wrap a closed surface around a mesh; `alpha` and `offset` in percent of its diagonal."""
    check_wrap()
    with silence():
        import pymeshlab

        meshes = pymeshlab.MeshSet(verbose=False)
        meshes.add_mesh(pymeshlab.Mesh(X, T))
        percent = pymeshlab.PercentageValue
        meshes.generate_alpha_wrap(alpha=percent(alpha), offset=percent(offset))
        wrapped = meshes.current_mesh()
        return wrapped.vertex_matrix(), wrapped.face_matrix().astype(np.int64)


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Suppress the terminal output of native code."""
    with open(os.devnull, "w") as null:
        copies = [(fd, os.dup(fd)) for fd in (1, 2)]
        try:
            for fd, _ in copies:
                os.dup2(null.fileno(), fd)
            yield
        finally:
            for fd, copy in copies:
                os.dup2(copy, fd)
                os.close(copy)


def _nearest_with_normal(X, T, V, F):
    """Vertex of (V, F) nearest to each vertex of (X, T) in position and normal."""
    weight = 0.02 * np.linalg.norm(np.ptp(V, axis=0))
    tree = cKDTree(np.c_[V, weight * vertex_normals(V, F)])
    return tree.query(np.c_[X, weight * vertex_normals(X, T)])[1]


def topology(T: Array, E: Array, count: Array) -> dict[str, int]:
    """Count Euler characteristic, boundary loops and edges with three or more triangles.

    E and `count` are the edges and the triangles per edge.
    """
    boundary, vertex = np.unique(E[count == 1], return_inverse=True)
    loop = surface.components(vertex.reshape(-1, 2), len(boundary))
    return {
        "euler_characteristic": surface.euler_characteristic(T, E),
        "boundary_loops": int(loop.max(initial=-1) + 1),
        "nonmanifold_edges": int((count > 2).sum()),
    }


def _check_numbers(X, T):
    if len(T) == 0 or T.min() < 0 or T.max() >= len(X) or not np.isfinite(X).all():
        raise ValueError(
            "coarsen needs triangles with valid indices and finite positions; found others: "
            "clean the mesh first"
        )


def check_clean(X: Array, T: Array) -> tuple[dict[str, int], tuple[Array, Array]]:
    """Return topology, edges and triangles per edge after checking for :func:`coarsen`.

    Raises
    ------
    ValueError
        Unless positions are finite, indices valid, vertices in use and edges manifold.
    """
    _check_numbers(X, T)
    found = surface.counted_edges(T, len(X))
    counts = topology(T, *found)
    unused, nonmanifold = len(X) - surface.n_used(T), counts["nonmanifold_edges"]
    if unused or nonmanifold:
        raise ValueError(
            "coarsen needs a manifold mesh without unused vertices; "
            f"found {nonmanifold} edges of three or more triangles and "
            f"{unused} vertices without triangle: clean the mesh first"
        )
    return counts, found


def coarsen(
    mesh: Mesh,
    *,
    n_coarse: int = 6000,
    sampling: str = "normals",
    wrap: bool = False,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Remesh to about `n_coarse` vertices and compute the projection operator U (4.1).

    Parameters
    ----------
    mesh : xarray.Dataset
        A clean mesh with ``position`` and ``corner_vertex``.  It must be manifold and oriented.
        Boundaries and several components are allowed.
    n_coarse : int
        Target number of vertices.  The result has between 95 % and 110 % of it, and usually 95 %,
        as the rest is for samples that the topology needs.  A mesh with hundreds of handles may
        need more if n_coarse is in the hundreds.  A mesh that has no more vertices than n_coarse is
        returned unchanged.
    sampling : {"normals", "geodesic"}
        Sample farthest points in position and normal, or along the surface as in ReMatching.  Then
        U is also that of ReMatching, from the closest point of the whole coarse mesh.
    wrap : bool
        Remesh an alpha wrap of the mesh.  This is meant for scans whose interior is irrelevant, and
        needs the extra ``s4a[wrap]``.
    seed : int
        Seed that selects the first sample; with seed 0 it is an outermost vertex.
    rng : int or numpy.random.Generator, optional
        Replaces `seed`, as in SPEC 7.

    Returns
    -------
    xarray.Dataset
        The coarse mesh, its discrete Laplacian and the projection operator:

        - ``position(vertex, xyz)`` and ``corner_vertex(triangle, corner)``: the coarse manifold
          mesh, in the unit of the input;
        - ``sample_vertex(vertex)``: vertex of the original mesh for each coarse vertex, -1 if it is
          not an original vertex;
        - ``edge_vertex`` and ``cotan_weight``: edges and cotangent weights of the stiffness matrix
          W;
        - ``vertex_area(vertex)``: diagonal of the area matrix A.  The original vertex areas are
          distributed by U, so their sum is the original area.  With `wrap` they are the areas of
          the coarse mesh;
        - ``coarse_vertex`` and ``coarse_weight (original_vertex, corner)``: nonzero entries of U.
          The entries are not negative, and each row has the sum 1.

        The attributes are the numbers of samples, iterations, boundary loops and vertices removed
        with handles that were cut, the Euler characteristic, and the kind of Laplacian ("robust"
        for degenerate triangles).  U keeps the rows of removed vertices.

    Raises
    ------
    ValueError
        If the mesh is not clean or an option is out of range.

    See Also
    --------
    s4a.clean : Repair a mesh before it is remeshed.
    s4a.spectrum : Eigenpairs of the low-resolution mesh.

    Notes
    -----
    The weights of a vertex come from the coarse triangles around the sample of its geodesic Voronoi
    cell, so U never crosses a thin wall.  Vertices are moved by at most 1e-4 of the radius before,
    so U does not depend on the pose of a surface on a grid.  Handles and holes inside one cell are
    lost.  Handles that are about as thin as a cell are cut only if they would need more than
    1.1 n_coarse samples.

    References
    ----------
    F. Maggioli et al. (2024), ReMatching: low-resolution representations for scalable shape
    correspondence, ECCV.
    N. Sharp and K. Crane (2020), A Laplacian for nonmanifold triangle meshes, Computer Graphics
    Forum 39(5).

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> from s4a.geometry.mesh import as_dataset
    >>> x, y = np.meshgrid(np.arange(30.0), np.arange(30.0), indexing="ij")
    >>> i = np.arange(900).reshape(30, 30)[:-1, :-1].ravel()
    >>> T = np.r_[np.c_[i, i + 30, i + 31], np.c_[i, i + 31, i + 1]]
    >>> grid = as_dataset(np.c_[x.ravel(), y.ravel(), 0 * x.ravel()], T)
    >>> coarse = s4a.coarsen(grid, n_coarse=100)
    >>> coarse.attrs["euler_characteristic"]
    1
    >>> bool(np.allclose(coarse["coarse_weight"].sum("corner"), 1))
    True

    A brain with 4,000 and with 500 vertices:

    >>> brain = s4a.synthetic.brains(1, 4000)["original/brain_01"].to_dataset()
    >>> few = s4a.coarsen(brain, n_coarse=500)
    >>> s4a.show.charts.surfaces({"4,000 vertices": brain, "500 vertices": few})
    <TiledFigure ...>
    """
    seed = seed_of(seed, rng)
    mesh = as_mesh(mesh)
    check_count("n_coarse", n_coarse, 4)
    check("sampling", sampling)
    X, T = as_arrays(mesh)
    _check_numbers(X, T)
    X, T, order = _sorted_mesh(X, T)
    before, found = check_clean(X, T)
    attrs: dict[str, int | str] = {
        "n_coarse": int(n_coarse),
        "seed": int(seed),
        "wrapped": int(bool(wrap)),
        "kept_whole": 0,
    }
    V, F = X, T
    if wrap:
        V, F, _ = _sorted_mesh(*alpha_wrap(X, T))
        found = surface.counted_edges(F, len(V))
    if len(V) <= n_coarse:
        Y, C = V, F
        sample = cell = np.arange(len(V))
        attrs.update(
            kept_whole=1, samples_first=len(V), samples_added=0, iterations=0, vertices_cut=0
        )
    else:
        Y, C, sample, cell, counts = _coarse_surface(V, F, found, n_coarse, seed, sampling)
        attrs |= counts
    if wrap:
        sample = np.full(len(Y), -1)
        cell = cell[_nearest_with_normal(X, T, V, F)]
    if sampling == "geodesic":
        triangle, weight = closest_point(X, Y, C)  # (n,), (n, 3)
    else:
        P = without_ties(X, MOVED)
        Q = np.where(sample[:, None] >= 0, P[sample], Y)  # so a sample is its own closest point
        triangle, weight = closest_point_in_star(P, cell, Q, C)
    corner = C[triangle]  # (n, 3)
    if wrap:
        area = vertex_areas(Y, C)
    else:  # U^T a: f and U f have the same integral
        shares = weight * vertex_areas(X, T)[:, None]
        area = np.bincount(corner.ravel(), shares.ravel(), len(Y))
    E, w, area, attrs["laplacian"] = laplacian(Y, C, area)
    attrs |= topology(C, *surface.counted_edges(C))
    attrs |= {f"{name}_original": count for name, count in before.items()}
    rank = np.argsort(order)  # back to the numbering of the input
    return dataset(
        attrs,
        position=Y,
        corner_vertex=C.astype(np.int32),
        vertex_area=area,
        edge_vertex=E.astype(np.int32),
        cotan_weight=w,
        sample_vertex=np.where(sample >= 0, order[sample], -1).astype(np.int32),
        coarse_vertex=corner[rank].astype(np.int32),
        coarse_weight=weight[rank],
    )
