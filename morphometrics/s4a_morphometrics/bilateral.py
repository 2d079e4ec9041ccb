"""Bilateral asymmetry (6.1): directional and fluctuating asymmetry, and antisymmetry.

*Object symmetry* (a skull) compares every shape with its own mirror image.  The mirror image of
the template is registered to the template, which gives the partner tau(v) of each vertex v on the
other side.  *Matching symmetry* (femurs) compares the left and the right shape of a subject; the
left ones are mirrored.  Let y and y' be the two, aligned to a symmetric consensus.  Then
a = (y - y') / 2 is the asymmetry of an individual and s = (y + y') / 2 its symmetric component.
The sums of squares add up (Klingenberg, Barluenga and Meyer 2002): *individuals* (s around its
mean), *sides* (the mean of a, directional asymmetry), and *individuals x sides* (a around its
mean, fluctuating asymmetry and measurement error together).  Size is not removed.
"""

import logging
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from s4a.analysis.inputs import Values, displacements_of, registration_of
from s4a.analysis.permutation import Model, check_permutations
from s4a.geometry.align import rigid_transform
from s4a.geometry.closest import closest_facing_point, interpolate
from s4a.geometry.mesh import as_arrays, as_dataset, edges, vertex_areas, vertex_normals
from s4a.input.subjects import listed
from s4a.method.deform import normal_displacement
from s4a.method.pca import gram, gram_pca
from s4a.schema import check_choice, dataset, in_unit, require, unit_of
from s4a.seeds import RNG, seed_of
from s4a.study.tree import left_out
from s4a_morphometrics.bilateral_pairs import ITERATIONS, Mirror, plane_between, symmetry
from s4a_morphometrics.longitudinal import labels_of

log = logging.getLogger(__name__)

TERMS = ["individuals", "sides", "individuals x sides"]
ALIKE = 1e-6  # relative to the mean size of the asymmetries: smaller values are rounding errors
# The resolution is BEYOND times the largest error in the neighbourhood; 1 / PARTS of it is added
# to the standard error.  Chosen on ellipsoids and a brain, reported on others: docs/decisions.md
BEYOND, PARTS = 4, 6


class Sides(NamedTuple):
    """Both sides of every individual, aligned to one symmetric consensus.

    ``a (s, n, 3)`` is half the difference and ``along (s, n)`` half the distance along the normals;
    ``error_a (n, 3)`` and ``error_along (n,)`` are their errors by triangulation and partners,
    common to all shapes; ``symmetric (s, n, 3)`` is the mean of both sides minus the overall mean,
    ``consensus (n, 3)``, ``area (n,)``, and ``names`` of the individuals.
    """

    a: np.ndarray
    along: np.ndarray
    error_a: np.ndarray
    error_along: np.ndarray
    symmetric: np.ndarray
    consensus: np.ndarray
    area: np.ndarray
    names: list[str]


def object_sides(Y: np.ndarray, partners: xr.Dataset, T: np.ndarray, area: np.ndarray) -> Sides:
    """Align shapes ``(s, n, 3)`` and their own mirror images (object symmetry).

    A vertex and its partner are two points of one configuration.  Exchanging the sides is therefore
    exact for any triangulation.
    """
    points = partners["partner_triangle"].values, partners["partner_barycentric"].values
    Y_partner = np.stack([interpolate(y, T, *points) for y in Y])  # (s, n, 3)
    mean, mean_partner = Y.mean(0), Y_partner.mean(0)
    plane = plane_between(mean, mean_partner, area)
    consensus = (mean + plane(mean_partner)) / 2
    double = np.concatenate([area, area])
    for _ in range(ITERATIONS):
        goal = np.concatenate([consensus, plane(consensus)])
        for i, (y, other) in enumerate(zip(Y, Y_partner, strict=True)):
            R, t, _ = rigid_transform(np.concatenate([y, other]), goal, double)
            Y[i], Y_partner[i] = y @ R.T + t, other @ R.T + t
        consensus = (Y.mean(0) + plane(Y_partner.mean(0))) / 2
    a = half_differences(Y, T, points, plane)
    symmetric = Y - a
    consensus = symmetric.mean(0)
    # along the normals, to the opposite point: insensitive to tangential errors of the partners
    mean, normals = Y.mean(0), vertex_normals(consensus, T)
    facing = vertex_normals(mean, T)
    triangle, weights = closest_facing_point(mean, facing, plane(mean), T[:, ::-1])
    opposite = triangle, weights[:, ::-1]
    along = normal_displacement(half_differences(Y, T, opposite, plane), normals)
    # the consensus is its own mirror image: its differences are errors, common to all shapes
    (error_a,) = half_differences(consensus[None], T, points, plane)
    difference = half_differences(consensus[None], T, opposite, plane)
    (error_along,) = normal_displacement(difference, normals)
    symmetric = symmetric - consensus
    return Sides(a, along, error_a, error_along, symmetric, consensus, area, [])


def largest_around(values: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return the largest of values ``(n,)`` in the 2-ring neighbourhood of each vertex.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.bilateral import largest_around
    >>> T = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
    >>> largest_around(np.array([9, 0, 0, 0, 5, 0]), T).tolist()
    [9, 9, 9, 9, 9, 5]
    """
    ends = edges(T)
    for _ in range(2):
        before, values = values, values.copy()
        for start, end in (ends.T, ends.T[::-1]):
            np.maximum.at(values, start, before[end])
    return values


def half_differences(
    Y: np.ndarray, T: np.ndarray, points: tuple[np.ndarray, np.ndarray], plane: Mirror
) -> np.ndarray:
    """Return half the difference of shapes ``(s, n, 3)`` and their mirror images at these points.

    A point inside a triangle lies below the curved surface, on both sides of all shapes.  This is
    not an asymmetry, so the part that does not change its sign between the sides is subtracted.
    """
    a = np.empty_like(Y)
    for i, y in enumerate(Y):
        half = (y - plane(interpolate(y, T, *points))) / 2
        a[i] = (half - plane.reflected(interpolate(half, T, *points))) / 2
    return a


def matching_sides(first: np.ndarray, second: np.ndarray, T: np.ndarray, area: np.ndarray) -> Sides:
    """Align left and right shapes ``(s, n, 3)``, one side mirrored (matching symmetry)."""
    Y = np.concatenate([first, second])
    for _ in range(ITERATIONS):
        consensus = Y.mean(0)
        for i, y in enumerate(Y):
            R, t, _ = rigid_transform(y, consensus, area)
            Y[i] = y @ R.T + t
    first, second = np.split(Y, 2)
    consensus = Y.mean(0)
    a = (second - first) / 2
    along = normal_displacement(a, vertex_normals(consensus, T))
    exact = np.zeros_like(consensus)  # vertices of both sides correspond
    symmetric = (second + first) / 2 - consensus
    return Sides(a, along, exact, exact[:, 0], symmetric, consensus, area, [])


def asymmetry(
    study: xr.DataTree,
    *,
    subject: Values | None = None,
    side: Values | None = None,
    partners: xr.Dataset | None = None,
    of: str = "normal",
    n_permutations: int = 999,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Analyse bilateral asymmetry: directional, fluctuating, and antisymmetry.

    Parameters
    ----------
    study : DataTree
    subject, side : array_like (shape,), dict of shape to value, or name in /subjects
        For matching symmetry, the subject of each shape and which of two sides it is.  The shapes
        of one side are mirrored, by ``reflect=`` of :func:`s4a.analyse` or in their files.
        Without them object symmetry: every shape is compared with its own mirror image.
    partners : Dataset, optional
        From :func:`symmetry`; computed by default.
    of : {"normal", "vector"}
        Quantity of the tests of directional asymmetry: half the distance along the normals between
        a shape and its mirror image, which tangential errors of :func:`symmetry` hardly affect, or
        the vectors.  The errors of triangulation and partners, measured on the symmetric consensus,
        are subtracted.  The mean is reduced by ``resolution(vertex)``, four times the largest of
        these errors nearby, minus its standard error.
    n_permutations : int
        Changes of sign of the individuals; all of them if there are fewer.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset
        ``asymmetry(individual, vertex, xyz)`` a = (y - y') / 2, for matching symmetry half of the
        second side in sorted order minus the first; ``symmetric(individual, vertex, xyz)`` minus
        its mean, ``symmetric_position(vertex, xyz)``.
        *Directional*: ``directional(vertex, xyz)``, the mean of a; ``directional_normal(vertex)``,
        half the distance along the normals; ``statistic`` (F of sides, of the quantity `of`) and
        ``p_value`` of the whole shape; at every vertex ``explained_share``, ``p_vertex``,
        ``p_family_wise`` (max-T), ``p_false_discovery``, ``effect_size`` (reduced mean over
        standard deviation, Mahalanobis; a part of ``resolution`` is added to the deviation).
        *Fluctuating*: ``fluctuating(vertex)``, ``fluctuating_size(individual)`` and, with the
        directional part, ``asymmetry_size(individual)``.
        *Antisymmetry*: ``kurtosis`` of the individuals on the first component of a, which is low
        for a bimodal distribution, and ``antisymmetry_p``, the share of normal samples with a
        kurtosis at most as large; ``asymmetry_score(individual, component)``.
        For each ``term`` (individuals, sides, individuals x sides): ``sum_of_squares``,
        ``degrees_of_freedom``, ``mean_square``, ``variance_share``, ``f_ratio`` over individuals x
        sides.  For object symmetry also the variables of :func:`symmetry`.

    Raises
    ------
    ValueError
        If there are fewer than 4 individuals, only one of subject and side is given, there are not
        two sides, or a subject has several shapes of one side.

    See Also
    --------
    asymmetry_modes : the asymmetries as modes of variation.
    symmetry : partners of the vertices.

    Notes
    -----
    Fluctuating asymmetry includes the errors of registration and of the scan; only repeated scans
    can separate them.

    References
    ----------
    C. P. Klingenberg, M. Barluenga and A. Meyer (2002), Shape analysis of symmetric structures,
    Evolution 56(10).  A. R. Palmer (1994), Fluctuating asymmetry analyses: a primer.

    Examples
    --------
    With the ``study`` of six small brains, which have no simulated directional asymmetry:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> result = s4a_morphometrics.asymmetry(study, n_permutations=99)
    >>> result["variance_share"]["term"].values.tolist()
    ['individuals', 'sides', 'individuals x sides']
    >>> result["directional"].dims, round(float(result["variance_share"].sum()), 6)
    (('vertex', 'xyz'), 1.0)
    """
    seed = seed_of(seed, rng)
    check_permutations(n_permutations)
    check_choice("of", of, ("vector", "normal"))
    if (subject is None) != (side is None):
        raise ValueError("matching symmetry needs both subject and side; give both or none")
    registration, d, area = displacements_of(study)
    X, T = as_arrays(registration)
    Y = X + d.astype(float)
    attrs: dict[str, str | int | float] = {"of": of, "covariates": ""}
    excluded = left_out(study)
    if subject is None or side is None:
        partners = symmetry(study) if partners is None else partners
        require(partners, "partner_triangle", "partner_barycentric", what="symmetry")
        sides = object_sides(Y, partners, T, area)
        sides = sides._replace(names=registration["shape"].values.tolist())
        attrs |= {"symmetry": "object"} | partners.attrs
    else:
        names, first, second, unpaired, label = paired(study, registration, subject, side)
        excluded = [*excluded, *unpaired]
        sides = matching_sides(Y[first], Y[second], T, area)._replace(names=names)
        attrs |= {"symmetry": "matching", "sides": label}
    model = Model.one_sample(len(sides.a), n_permutations, seed)
    result = asymmetry_of(sides, T, of, model)
    if partners is not None:
        result = result.merge(partners.drop_attrs())
    result = in_unit(result, unit_of(registration["displacement"]))
    return result.assign_coords(individual=sides.names, term=TERMS).assign_attrs(
        left_out=", ".join(excluded), **attrs, **model.attributes()
    )


def paired(
    study: xr.DataTree, registration: xr.Dataset, subject: Values, side: Values
) -> tuple[list[str], list[int], list[int], list[str], str]:
    """Return subjects with both sides, indices of their shapes, shapes left out, and a label."""
    shapes = registration["shape"].values.tolist()
    subjects = labels_of(study, subject, "subject")
    sides = labels_of(study, side, "side")
    valid = [i for i in range(len(shapes)) if subjects[i] and sides[i]]
    two = sorted({sides[i] for i in valid})
    if len(two) != 2:
        raise ValueError(f"side needs two values, such as left and right; found {listed(two)}")
    index: dict[str, dict[str, int]] = {}
    for i in valid:
        if sides[i] in index.setdefault(subjects[i], {}):
            other = shapes[index[subjects[i]][sides[i]]]
            raise ValueError(
                f"subject {subjects[i]!r} has two shapes of the side {sides[i]!r}, {other} and "
                f"{shapes[i]}: keep one of them"
            )
        index[subjects[i]][sides[i]] = i
    unpaired = [shapes[i] for pair in index.values() for i in pair.values() if len(pair) == 1]
    unpaired += [shapes[i] for i in range(len(shapes)) if i not in valid]
    if unpaired:
        log.warning(
            "left out, because the other side of the subject is missing: %s",
            listed(unpaired, most=9),
        )
    names = sorted(name for name, pair in index.items() if len(pair) == 2)
    if len(names) < 4:
        raise ValueError(
            f"asymmetry needs at least 4 subjects with both sides, found {len(names)}"
            + (f"; the other side is missing for {listed(unpaired)}" if unpaired else "")
        )
    _report_sides(study, {shapes[i]: sides[i] for i in valid}, two)
    first, second = ([index[name][value] for name in names] for value in two)
    return names, first, second, unpaired, f"{two[1]} minus {two[0]}"


def _report_sides(study, side_of, two):
    """Warn if the run did not mirror exactly the shapes of one side."""
    report = study["report"].to_dataset() if "report" in study.children else xr.Dataset()
    mirrored = set()
    if "reflected" in report:
        mirrored = set(report["shape"].values[report["reflected"].values.astype(bool)].tolist())
    shapes_of = [{name for name, side in side_of.items() if side == value} for value in two]
    if mirrored & set(side_of) not in shapes_of:
        log.warning(
            "the run mirrored %s, not the shapes of one side: unless files are mirrored, left and "
            "right shapes are compared without mirroring (reflect=)",
            listed(sorted(mirrored)) or "none of the shapes",
        )


def asymmetry_of(sides: Sides, T: np.ndarray, of: str, model: Model) -> xr.Dataset:
    """Return the variables of :func:`asymmetry` for the aligned sides of individuals."""
    a, area, n = sides.a, sides.area, len(sides.a)
    mean = a.mean(0)
    fields, error = a, sides.error_a
    if of == "normal":
        fields, error = sides.along[..., None], sides.error_along[:, None]
    resolution = BEYOND * largest_around(np.linalg.norm(error, axis=1), T)
    fields = reduce_mean(fields - error, resolution)
    size = np.sqrt((a**2).sum(-1).mean(0) @ area)
    if size <= ALIKE * np.ptp(sides.consensus, axis=0).max():
        raise ValueError("left and right are the same in all shapes: there is no asymmetry to test")
    fields = np.where(abs(fields) > ALIKE * size, fields, 0)  # zero at the midline, along normals
    share, p, p_max = model.vertex_test(fields, floor=resolution / PARTS)
    statistic, p_value = sides_test(gram(fields, area), model)
    K = gram(a, area)
    modes = gram_pca(a, area)
    kurtosis, p_kurtosis = antisymmetry_test(
        modes.score * modes.standard_deviation, seed=model.seed
    )
    squares = 2 * np.array([np.trace(gram(sides.symmetric, area)), K.sum() / n, 0.0])
    squares[2] = 2 * np.trace(K) - squares[1]
    degrees = np.array([n - 1, 1, n - 1])
    around = a - mean
    return dataset(
        asymmetry=a.astype(np.float32),
        symmetric=sides.symmetric.astype(np.float32),
        symmetric_position=sides.consensus,
        directional=mean,
        directional_normal=sides.along.mean(0),
        resolution=resolution,
        fluctuating=np.sqrt((around**2).sum(-1).sum(0) / (n - 1)),
        asymmetry_size=np.sqrt((a**2).sum(-1) @ area),
        fluctuating_size=np.sqrt((around**2).sum(-1) @ area),
        asymmetry_score=modes.score,
        statistic=statistic,
        p_value=p_value,
        explained_share=share,
        p_vertex=p,
        p_family_wise=p_max,
        p_false_discovery=stats.false_discovery_control(p),
        effect_size=np.sqrt((n - 1) / n * share / np.maximum(1 - share, 1e-12)),
        kurtosis=kurtosis,
        antisymmetry_p=p_kurtosis,
        sum_of_squares=squares,
        degrees_of_freedom=degrees,
        mean_square=squares / degrees,
        variance_share=squares / squares.sum(),
        f_ratio=squares / degrees / (squares[2] / degrees[2]),
    )


def reduce_mean(fields: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Shorten the mean of fields ``(s, n, k)`` by the possible error of triangles and partners.

    This error is at most `resolution`.  The standard error of the mean is subtracted from it,
    because the test accounts for that part already.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.bilateral import reduce_mean
    >>> reduce_mean(np.array([[[1.0]], [[3.0]]]), np.array([2.0])).tolist()
    [[[0.0]], [[2.0]]]
    """
    mean = fields.mean(0)
    error = np.sqrt(fields.var(0, ddof=1).sum(-1) / len(fields))
    reduction = np.maximum(resolution - error, 0)
    length = np.linalg.norm(mean, axis=1)
    return fields - mean * np.minimum(1, reduction / np.where(length > 0, length, 1))[:, None]


def sides_test(K: np.ndarray, model: Model) -> tuple[float, float]:
    """Return F of sides over individuals x sides, and its p value under changes of sign.

    Parameters
    ----------
    K : float ndarray (s, s)
        Inner products of the asymmetries of individuals.
    model : Model
        Model of the changes of sign.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.permutation import Model, check_permutations
    >>> from s4a_morphometrics.bilateral import sides_test
    >>> a = 1 + 0.1 * np.arange(6.0)
    >>> sides_test(np.outer(a, a), Model.one_sample(6))[1]
    0.03125
    """
    n, total = len(K), np.trace(K)

    def squares_of_sides(signs):
        """Sum of squares of sides under changes of sign, ``(b,)``."""
        S = np.array(signs)
        return np.einsum("pi,ij,pj->p", S, K, S, optimize=True) / n

    squares = squares_of_sides(2 * [np.ones(n)])[0]  # two rows: einsum rounds one row differently
    F = squares / max((total - squares) / (n - 1), 1e-12 * total)
    p, _ = model.p_values(squares_of_sides, squares * (1 - 1e-9), 10_000)
    return float(F), float(p)


def antisymmetry_test(
    coordinates: np.ndarray, *, n_draws: int = 9999, seed: int = 0
) -> tuple[float, float]:
    """Return the kurtosis of individuals ``(s, c)`` on their first component, and its p value.

    Antisymmetry gives a bimodal distribution with a kurtosis near 1, compared with 3 for a normal
    one.  The scores of s normal individuals on their first component have a uniformly distributed
    direction, for any covariance and number of coordinates.  The p value is the share of random
    directions with a kurtosis at most as large.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.bilateral import antisymmetry_test
    >>> rng = np.random.default_rng(0)
    >>> noise = rng.normal(size=(30, 3))
    >>> bimodal = noise + np.outer(rng.choice([-4, 4], 30), [1, 0, 0])
    >>> antisymmetry_test(bimodal)[1] < 0.01 < antisymmetry_test(noise)[1]
    True
    """
    around = coordinates - coordinates.mean(0)
    first = np.linalg.eigh(around @ around.T)[1][:, -1]
    observed = float(stats.kurtosis(first, fisher=False))
    directions = np.random.default_rng(seed).normal(size=(n_draws, len(first)))
    drawn = stats.kurtosis(directions, axis=1, fisher=False)
    return observed, (1 + int((drawn <= observed).sum())) / (1 + n_draws)


def asymmetry_modes(study: xr.DataTree, result: xr.Dataset) -> xr.DataTree:
    """Return the result of :func:`asymmetry` as a study, to show it as modes of variation.

    Parameters
    ----------
    study : DataTree
    result : Dataset
        From :func:`asymmetry`.

    Returns
    -------
    DataTree
        ``/registration`` with the symmetric consensus as its mesh, one shape per individual, and
        ``/pca``: the first component is the directional asymmetry, and its ``score`` the projection
        of each individual; the others are the principal components of fluctuating asymmetry.
        ``explained_variance_ratio`` are shares of the sum of squares of the asymmetries.

    See Also
    --------
    s4a.explore, s4a.write_page : show the modes.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> result = s4a_morphometrics.asymmetry(study, n_permutations=99)
    >>> s4a_morphometrics.asymmetry_modes(study, result)["pca"].sizes["component"]
    6
    """
    registration = registration_of(study)
    area = vertex_areas(*as_arrays(registration))
    a = result["asymmetry"].transpose("individual", "vertex", "xyz").values.astype(float)
    modes = gram_pca(a, area)
    K = gram(a, area)
    size = np.sqrt(max(K.mean(), 1e-300))  # norm of the mean
    squares = np.array([len(a) * size**2, *(len(a) - 1) * modes.standard_deviation**2])
    mean = modes.mean.astype(np.float32)
    pca = dataset(
        {"variable": "asymmetry"},
        mean_displacement=np.zeros_like(mean),
        deformation=np.concatenate([mean[None], modes.deformation.astype(np.float32)]),
        standard_deviation=np.array([size, *modes.standard_deviation]),
        score=np.column_stack([K.mean(1) / size**2, modes.score]),
        explained_variance_ratio=squares / squares.sum(),
    )
    unit = unit_of(registration["displacement"])
    names = result["individual"].values
    mesh = as_dataset(
        result["symmetric_position"].values, registration["corner_vertex"].values
    ).merge(dataset(displacement=a.astype(np.float32)))
    nodes = {
        "/registration": in_unit(mesh, unit).assign_coords(shape=names),
        "/pca": in_unit(pca, unit).assign_coords(shape=names),
    }
    return xr.DataTree.from_dict(nodes, name=study.name)
