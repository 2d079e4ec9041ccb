"""Spectrum (3.3): eigenfunctions Phi, coefficients Phi^T A f, and functions from coefficients.

L phi = lambda phi with L = A^-1 W, W the cotan stiffness matrix and A the lumped vertex areas, all
for the surface scaled to unit area.
"""

import logging
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import xarray as xr

from s4a.geometry.mesh import stiffness
from s4a.schema import Array, check_count, dataset, require

log = logging.getLogger(__name__)


def eigenpairs(E: Array, w: Array, area: Array, k: int) -> tuple[Array, Array]:
    """Compute the k smallest eigenpairs of W phi = lambda A phi, for the surface of unit area.

    Parameters
    ----------
    E : int ndarray (e, 2)
        Edges.
    w : float ndarray (e,)
        Cotan weights.
    area : float ndarray (n,)
        Lumped vertex areas, in any unit.
    k : int
        Number of eigenpairs, smaller than n.

    Returns
    -------
    eigenvalue : float ndarray (k,)
    Phi : float ndarray (n, k)
        Phi^T A Phi = I for areas of sum 1.  The first is the constant 1, also if several components
        have eigenvalue 0.  Signs are chosen for a positive third moment.
    """
    n = len(area)
    a = area / area.sum()
    # S = A^-1/2 W A^-1/2 is symmetric and has the same eigenvalues; phi = A^-1/2 v
    root = sp.diags(1 / np.sqrt(a))
    S = (root @ stiffness(E, w, n) @ root).tocsc()  # (n, n)
    shift = 1e-8 * S.diagonal().mean()  # keeps the factor away from the null space
    eigenvalue, V = nearest_eigenpairs(S, k, -shift, np.sqrt(a))
    # a power takes 30 times as long
    return canonical(eigenvalue, V / np.sqrt(a)[:, None], a, lambda Phi: a @ (Phi * Phi * Phi))


def nearest_eigenpairs(
    S: sp.spmatrix, k: int, sigma: float, v0: Array | float, M: sp.spmatrix | None = None
) -> tuple[Array, Array]:
    """Return the k eigenpairs of S v = lambda M v nearest to sigma, in ascending order."""
    n = S.shape[0]
    inverse = factor(S - sigma * (sp.identity(n) if M is None else M))
    operator = spla.LinearOperator((n, n), matvec=inverse, dtype=float)
    v0 = v0 + 1e-3 * np.cos(np.arange(n))  # the default of ARPACK is random
    eigenvalue, V = spla.eigsh(S, k=k, M=M, sigma=sigma, OPinv=operator, v0=v0, which="LM")
    order = np.argsort(eigenvalue)
    return eigenvalue[order], V[:, order]


def canonical(
    eigenvalue: Array, Phi: Array, area: Array, third_moment: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Return ascending eigenpairs with exact zeros, the constant 1 first, and the signs chosen."""
    # else heat kernels would use rounding errors
    eigenvalue = np.where(np.abs(eigenvalue) < 1e-9 * max(eigenvalue[-1], 1.0), 0.0, eigenvalue)
    zero = eigenvalue == 0
    Phi[:, zero] = with_constant_first(Phi[:, zero], area)
    Phi *= np.where(third_moment(Phi) < 0, -1.0, 1.0)
    if zero.any():
        Phi[:, 0] = 1.0  # exactly, so that constants stay constant in every map
    return eigenvalue, Phi


def solved(
    solve: Callable[[int], tuple[Array, ...]], k: int, w: Array, n: int, what: str
) -> tuple[tuple[Array, ...], dict[str, int]]:
    """Return the result of `solve`, eigenvalues first, for k pairs or as many as there are.

    Also the attributes ``zero_eigenvalues`` and, if k is reduced, ``k_reduced_from``.

    Raises
    ------
    ValueError
        If k is not a positive integer, the mesh has fewer than 3 of `what`, a weight w is not
        finite, or the solver does not converge.
    """
    check_count("k", k, 1)
    k_possible = min(int(k), n - 2)
    if k_possible < 1:
        raise ValueError(f"a spectrum needs at least 3 {what}; found {n}")
    if not np.isfinite(w).all():
        raise ValueError("cotan weights must be finite; some triangles are too thin")
    try:
        eigenvalue, *others = solve(k_possible)
    except RuntimeError as error:  # of the factor or of ARPACK
        raise ValueError(f"no {k_possible} eigenpairs of {n} {what}: {error}") from error
    attrs = {"zero_eigenvalues": int((eigenvalue == 0).sum())}
    if k_possible < k:
        log.warning("k reduced from %d to %d: the mesh has only %d %s", k, k_possible, n, what)
        attrs["k_reduced_from"] = int(k)
    return (eigenvalue, *others), attrs


def with_constant_first(Z: Array, area: Array) -> Array:
    """Rotate the functions ``(n, z)`` of eigenvalue 0 so that the first is the constant 1.

    For several components the solver returns arbitrary functions that are constant on each.

    Parameters
    ----------
    Z : float ndarray (n, z)
        Orthonormal.
    area : float ndarray (n,)
        Integrals of the functions whose coefficients are Z: vertex areas of sum 1.
    """
    if Z.shape[1] < 2:
        return Z
    c = Z.T @ area  # (z,), coefficients of the constant
    Q = np.linalg.qr(np.column_stack([c, np.eye(len(c))]))[0]
    if Q[:, 0] @ c < 0:
        Q[:, 0] *= -1
    return Z @ Q.astype(Z.dtype)


def factor(S: sp.spmatrix) -> Callable[[Array], Array]:
    """Return a solver of S x = b, for S sparse, symmetric and positive definite."""
    return spla.splu(
        S.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    ).solve


class Diffusion:
    """Implicit steps of heat diffusion, (A + time W) x = b, with cached factors.

    Parameters
    ----------
    area : float ndarray (n,)
        Vertex areas, A.
    W : sparse matrix (n, n)
        Stiffness matrix.

    Examples
    --------
    >>> import numpy as np
    >>> import scipy.sparse as sp
    >>> from s4a.method.spectral import Diffusion
    >>> W = sp.csr_matrix([[1.0, -1], [-1, 1]])
    >>> Diffusion(np.array([0.5, 0.5]), W).step(0.5)(np.array([1.0, 0])).round(3).tolist()
    [1.333, 0.667]
    """

    def __init__(self, area: Array, W: sp.csr_matrix) -> None:
        self.A = sp.diags_array(area)
        self.W = W
        self._steps: dict[float, Callable[[Array], Array]] = {}

    def step(self, time: float, extra: sp.sparray | None = None) -> Callable[[Array], Array]:
        """Return a solver for x ``(n, q)``; with an `extra` term of the matrix it is not cached."""
        if extra is not None:
            return factor(self.A + extra + time * self.W)
        if time not in self._steps:
            self._steps[time] = factor(self.A + time * self.W)
        return self._steps[time]


def project(Phi: Array, area: Array | sp.spmatrix, f: Array) -> Array:
    """Return the coefficients Phi^T A f of a function ``(k,)`` or of several ``(k, d)``.

    Parameters
    ----------
    Phi : float ndarray (n, k)
        Orthonormal in the areas.
    area : float ndarray (n,), of sum 1, or sparse matrix (n, n)
        A, see :func:`unit_mass`.
    f : float ndarray (n,) or (n, d)
    """
    if f.ndim > 1:
        f = f.reshape(len(f), -1)
    if sp.issparse(area):
        return Phi.T @ (area @ f)
    return Phi.T @ (area * f if f.ndim == 1 else area[:, None] * f)


def spectrum(mesh: xr.Dataset, *, k: int = 100) -> xr.Dataset:
    """Compute the Laplace-Beltrami eigenpairs of a low-resolution mesh (3.3).

    Parameters
    ----------
    mesh : xarray.Dataset
        With ``vertex_area``, ``edge_vertex`` and ``cotan_weight`` of :func:`s4a.coarsen`.  An
        existing spectrum is replaced, and variables that depend on it are dropped.
    k : int
        Number of eigenpairs.  It is reduced if the mesh has too few vertices, and the attribute
        ``k_reduced_from`` is set.

    Returns
    -------
    xarray.Dataset
        The mesh with ``eigenvalue(eigenpair)`` and ``eigenfunction(vertex, eigenpair)`` for unit
        area: A^-1 W phi = lambda phi, Phi^T A Phi = I with A of trace 1.  The attribute
        ``zero_eigenvalues`` is the number of connected components.

    Raises
    ------
    ValueError
        If k is not a positive integer, the mesh has fewer than 3 vertices or holds samples of
        SCALABLE, or the solver does not converge.

    See Also
    --------
    s4a.coarsen : Make a low-resolution mesh.
    reconstruct : Truncate a function to the first eigenfunctions.

    References
    ----------
    U. Pinkall and K. Polthier (1993), Computing discrete minimal surfaces and their conjugates,
    Experimental Mathematics 2(1).

    Examples
    --------
    A sphere of radius 1, whose area is 4 pi, has the eigenvalues 0, 2 (three times) and 6 (five
    times):

    >>> import numpy as np
    >>> import s4a
    >>> ball = s4a.spectrum(s4a.coarsen(s4a.synthetic.sphere(2000), n_coarse=1000), k=9)
    >>> (ball["eigenvalue"].values / (4 * np.pi)).round().tolist()
    [0.0, 2.0, 2.0, 2.0, 6.0, 6.0, 6.0, 6.0, 6.0]
    >>> Phi = ball["eigenfunction"].values
    >>> waves = {f"eigenfunction {i}": Phi[:, i] for i in (1, 4, 8)}
    >>> s4a.show.charts.surfaces(dict.fromkeys(waves, ball), waves, label="eigenfunction")
    <TiledFigure ...>
    """
    require(mesh, "vertex_area", "edge_vertex", "cotan_weight", what="mesh")
    if "edge_mass" in mesh:
        raise ValueError(
            "a low-resolution mesh of s4a.coarsen is needed; samples of SCALABLE have a "
            "spectrum: compute them again with another k"
        )
    E, w, area = (mesh[name].values for name in ("edge_vertex", "cotan_weight", "vertex_area"))
    (eigenvalue, Phi), found = solved(
        lambda k: eigenpairs(E, w, area, k), k, w, len(area), "vertices"
    )
    mesh = mesh.drop_dims("eigenpair", errors="ignore")  # of an earlier spectrum
    mesh.attrs.pop("k_reduced_from", None)
    spectrum = dataset(eigenvalue=eigenvalue, eigenfunction=Phi)
    return xr.merge([mesh, spectrum]).assign_attrs(mesh.attrs | found)


def unit_area(mesh: xr.Dataset) -> Array:
    """Return vertex areas scaled to sum 1 ``(n,)``: the A in which Phi is orthonormal."""
    area = mesh["vertex_area"].values
    return area / area.sum()


def unit_mass(mesh: xr.Dataset) -> Array | sp.csr_matrix:
    """Return the A in which Phi is orthonormal: :func:`unit_area`, or U^T A U in SCALABLE.

    Row sums of U^T A U ``(n, n)`` are the vertex areas, so ``edge_mass`` has only the off-diagonal
    entries.
    """
    if "edge_mass" not in mesh:
        return unit_area(mesh)
    total = mesh["vertex_area"].values.sum()
    off_diagonal = stiffness(
        mesh["edge_vertex"].values, mesh["edge_mass"].values / total, mesh.sizes["vertex"]
    )
    return sp.csr_matrix(sp.diags(unit_area(mesh)) - off_diagonal)


def reconstruct(mesh: xr.Dataset, f: Array, *, k: int | None = None) -> Array:
    """Reconstruct a function from its first k coefficients: Phi Phi^T A f.

    On samples of SCALABLE, `f` holds coefficients in the local functions, as the eigenfunctions do.

    Parameters
    ----------
    mesh : xarray.Dataset
        With ``eigenfunction`` and ``vertex_area``.
    f : array_like (vertex, ...)
        One or several functions, for example the positions.
    k : int, optional
        Number of eigenfunctions; all by default.

    Returns
    -------
    float ndarray, of the shape of `f`

    Raises
    ------
    ValueError
        If the mesh lacks a variable, or k is not a positive integer.

    See Also
    --------
    spectrum : Compute the eigenfunctions.
    s4a.synthesize : Reconstruct a shape from principal component scores.

    Examples
    --------
    The positions of a sphere are eigenfunctions, so four of them are enough:

    >>> import s4a
    >>> ball = s4a.spectrum(s4a.coarsen(s4a.synthetic.sphere(2000), n_coarse=1000), k=4)
    >>> bool(abs(s4a.reconstruct(ball, ball["position"]) - ball["position"].values).max() < 0.01)
    True

    A brain from 10 functions and from 100:

    >>> brain = s4a.synthetic.brains(1, 4000)["original/brain_01"].to_dataset()
    >>> few = s4a.spectrum(s4a.coarsen(brain, n_coarse=1500), k=100)
    >>> smooth = {f"k = {k}": s4a.reconstruct(few, few["position"], k=k) for k in (10, 100)}
    >>> pictures = {k: few.assign(position=(few["position"].dims, X)) for k, X in smooth.items()}
    >>> s4a.show.charts.surfaces(pictures)
    <TiledFigure ...>
    """
    require(mesh, "eigenfunction", "vertex_area", what="mesh")
    if k is not None:
        check_count("k", k, 1)
    Phi, f = mesh["eigenfunction"].values[:, :k], np.asarray(f, float)
    return (Phi @ project(Phi, unit_mass(mesh), f)).reshape(f.shape)


def weyl(k: int) -> Array:
    """Eigenvalues of a closed surface of unit area by Weyl's law, about 4 pi i ``(k,)``.

    Examples
    --------
    >>> from s4a.method.spectral import weyl
    >>> weyl(3).round(2).tolist()
    [0.0, 12.57, 25.13]
    """
    return 4 * np.pi * np.arange(k)
