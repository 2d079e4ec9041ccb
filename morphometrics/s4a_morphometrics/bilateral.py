"""Left against right (6.1): directional and fluctuating asymmetry, antisymmetry, their shares.

Of *object symmetry* (a skull) every shape stands against its own mirror image, through the
template: its mirror image is registered onto it, which gives each vertex v the place tau(v) of its
partner on the other side.  Of *matching symmetry* (femurs) the left and the right shape of one
subject stand against each other, the left ones mirrored.  With y the one and y' the other, aligned
to a symmetric consensus, a = (y - y') / 2 is the asymmetry of an individual and s = (y + y') / 2
its symmetric component, and the sums of squares add up (Klingenberg, Barluenga and Meyer 2002): of
*individuals* (s around its mean), *sides* (the mean of a, directional asymmetry), and *individuals
x sides* (a around that, fluctuating asymmetry and the error of measurement together).  Size is
kept.
"""

import logging
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from s4a.analysis.inputs import Values, displacements_of, registration_of, values_of
from s4a.analysis.permutation import Model, check_permutations
from s4a.geometry.align import rigid_transform
from s4a.geometry.closest import closest_facing_point, interpolate
from s4a.geometry.mesh import as_arrays, as_dataset, edges, vertex_areas, vertex_normals
from s4a.input.subjects import listed
from s4a.method.deform import normal_displacement
from s4a.method.pca import gram, gram_pca
from s4a.schema import dataset, in_unit, require, unit_of
from s4a.seeds import RNG, seed_of
from s4a.study.tree import left_out
from s4a_morphometrics.bilateral_pairs import ITERATIONS, Mirror, plane_between, symmetry

log = logging.getLogger(__name__)

TERMS = ["individuals", "sides", "individuals x sides"]
ALIKE = 1e-6  # of the mean size of the asymmetries: below it they are rounding
# A mean counts from so many times the largest error around on, and to a standard error belongs the
# sixth part of that, too.  Chosen on ellipsoids and a brain, reported on others: docs/decisions.md
BEYOND, PARTS = 4, 6


class Sides(NamedTuple):
    """Both sides of every individual, aligned to one symmetric consensus.

    ``a (s, n, 3)`` is half the difference, ``along (s, n)`` half the gap along the normals; of both
    ``error_a (n, 3)`` and ``error_along (n,)`` are what triangles and partners leave in all shapes;
    ``symmetric (s, n, 3)`` the mean of both less that of all, ``consensus (n, 3)`` and
    ``area (n,)``; ``names`` of the individuals.
    """

    a: np.ndarray
    along: np.ndarray
    error_a: np.ndarray
    error_along: np.ndarray
    symmetric: np.ndarray
    consensus: np.ndarray
    area: np.ndarray
    names: list[str]


def own_sides(Y: np.ndarray, halves: xr.Dataset, T: np.ndarray, area: np.ndarray) -> Sides:
    """Shapes ``(s, n, 3)`` and their own mirror images, aligned (object symmetry).

    Every vertex and its partner are two points of one configuration, so that the change of sides is
    exact whatever the triangles are.
    """
    place = halves["partner_triangle"].values, halves["partner_barycentric"].values
    there = np.stack([interpolate(y, T, *place) for y in Y])  # (s, n, 3)
    mean, mean_there = Y.mean(0), there.mean(0)
    plane = plane_between(mean, mean_there, area)
    consensus = (mean + plane(mean_there)) / 2
    double = np.concatenate([area, area])
    for _ in range(ITERATIONS):
        goal = np.concatenate([consensus, plane(consensus)])
        for i, (y, other) in enumerate(zip(Y, there, strict=True)):
            R, t, _ = rigid_transform(np.concatenate([y, other]), goal, double)
            Y[i], there[i] = y @ R.T + t, other @ R.T + t
        consensus = (Y.mean(0) + plane(there.mean(0))) / 2
    a = half_differences(Y, T, place, plane)
    symmetric = Y - a
    consensus = symmetric.mean(0)
    # along the normals: what of the partner lies opposite, whatever an error along the surface
    mean, normals = Y.mean(0), vertex_normals(consensus, T)
    facing = vertex_normals(mean, T)
    triangle, weights = closest_facing_point(mean, facing, plane(mean), T[:, ::-1])
    opposite = triangle, weights[:, ::-1]
    along = normal_displacement(half_differences(Y, T, opposite, plane), normals)
    # the consensus is its own mirror image: its gaps are errors, which all shapes have
    one = consensus[None]
    (error_a,) = half_differences(one, T, place, plane)
    (error_along,) = normal_displacement(half_differences(one, T, opposite, plane), normals)
    symmetric = symmetric - consensus
    return Sides(a, along, error_a, error_along, symmetric, consensus, area, [])


def largest_around(values: np.ndarray, T: np.ndarray) -> np.ndarray:
    """The largest of numbers ``(n,)`` at each vertex and the two rings around it.

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
        for here, there in (ends.T, ends.T[::-1]):
            np.maximum.at(values, here, before[there])
    return values


def half_differences(
    Y: np.ndarray, T: np.ndarray, place: tuple[np.ndarray, np.ndarray], plane: Mirror
) -> np.ndarray:
    """Half of shapes ``(s, n, 3)`` less their mirror images, whose vertices are at these places.

    A place between the vertices lies too deep in all shapes, on both sides alike, which no
    difference of sides is; so what does not change its sign from one side to the other is left out.
    """
    a = np.empty_like(Y)
    for i, y in enumerate(Y):
        own = (y - plane(interpolate(y, T, *place))) / 2
        a[i] = (own - plane.turned(interpolate(own, T, *place))) / 2
    return a


def both_sides(first: np.ndarray, second: np.ndarray, T: np.ndarray, area: np.ndarray) -> Sides:
    """Shapes ``(s, n, 3)`` of one side and the other, of one hand, aligned (matching symmetry)."""
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
    exact = np.zeros_like(consensus)  # both sides have their vertices in the same places
    symmetric = (second + first) / 2 - consensus
    return Sides(a, along, exact, exact[:, 0], symmetric, consensus, area, [])


def asymmetry(
    study: xr.DataTree,
    *,
    subject: Values | None = None,
    side: Values | None = None,
    halves: xr.Dataset | None = None,
    of: str = "normal",
    n_permutations: int = 999,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """How far, and where, are left and right different?

    Parameters
    ----------
    study : DataTree
    subject, side : array_like (shape,), dict of shape to value, or name in /subjects
        Matching symmetry: which shapes are of one subject, and which of two sides each is.  The
        shapes of one side are mirrored, by ``reflect=`` of :func:`s4a.analyse` or in their files.
        Without them object symmetry: every shape against its own mirror image.
    halves : Dataset, optional
        Of :func:`symmetry`, where it is there already.
    of : {"normal", "vector"}
        What the tests of directional asymmetry are of: half the gap along the normals between the
        shapes and their mirror images, opposite to which an error of :func:`symmetry` along the
        surface matters little.  Or vectors.  The symmetric consensus has such gaps, too, by its
        triangles and partners: they are taken from all, and a mean counts from
        ``resolution(vertex)`` on, four times the largest of them around, less its standard error.
    n_permutations : int
        Changes of sign of the individuals; all where fewer are different.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset
        ``asymmetry(individual, vertex, xyz)`` a = (y - y') / 2, of matching symmetry half of the
        second side in sorted order less the first; ``symmetric(individual, vertex, xyz)`` less
        their mean, ``symmetric_position(vertex, xyz)``.
        *Directional*: ``directional(vertex, xyz)``, the mean of a, ``directional_normal(vertex)``,
        half the gap along the normals, ``statistic`` and ``p_value`` of the whole shape (F of
        sides in what `of` names, less what is not known), at every vertex ``explained_share``,
        ``p_vertex``, ``p_family_wise`` (max-T), ``p_false_discovery``, ``effect_size`` (mean over
        standard deviation, Mahalanobis; of what is left by ``resolution``, a part of which is
        added to the deviation).
        *Fluctuating*: ``fluctuating(vertex)``, and ``fluctuating_size(individual)`` beside
        ``asymmetry_size(individual)``.
        *Antisymmetry*: ``kurtosis`` of the individuals on the first component of a, and
        ``antisymmetry_p``: how often normal ones are as low, as two humps are; look at
        ``asymmetry_score(individual, component)``, too.
        Of the ``term`` individuals, sides and individuals x sides: ``sum_of_squares``,
        ``degrees_of_freedom``, ``mean_square``, ``variance_share``, ``f_ratio`` over individuals x
        sides.  Object symmetry also has what :func:`symmetry` gives.

    Raises
    ------
    ValueError
        When there are fewer than 4 individuals, one of subject and side is given, there are not two
        sides, or a subject has several shapes of one side.

    Notes
    -----
    Fluctuating asymmetry holds the error of registration and of the scan; only scans done twice
    tell them apart.  See Klingenberg, Barluenga and Meyer (2002), and Palmer (1994) on kurtosis.

    Examples
    --------
    With the ``study`` of six small brains, which have directional asymmetry simulated nowhere:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> found = s4a_morphometrics.asymmetry(study, n_permutations=99)
    >>> found["variance_share"]["term"].values.tolist()
    ['individuals', 'sides', 'individuals x sides']
    >>> found["directional"].dims, round(float(found["variance_share"].sum()), 6)
    (('vertex', 'xyz'), 1.0)
    """
    seed = seed_of(seed, rng)
    check_permutations(n_permutations)
    if of not in ("vector", "normal"):
        raise ValueError(f"of must be 'vector' or 'normal', found {of!r}")
    if (subject is None) != (side is None):
        raise ValueError("matching symmetry needs both subject and side; give both or none")
    registration, d, area = displacements_of(study)
    X, T = as_arrays(registration)
    Y = X + d.astype(float)
    attrs: dict[str, str | int | float] = {"of": of, "covariates": ""}
    without = left_out(study)
    if subject is None or side is None:
        halves = symmetry(study) if halves is None else halves
        require(halves, "partner_triangle", "partner_barycentric", what="symmetry")
        sides = own_sides(Y, halves, T, area)
        sides = sides._replace(names=registration["shape"].values.tolist())
        attrs |= {"symmetry": "object"} | halves.attrs
    else:
        names, first, second, alone, words = paired(study, registration, subject, side)
        without = [*without, *alone]
        sides = both_sides(Y[first], Y[second], T, area)._replace(names=names)
        attrs |= {"symmetry": "matching", "sides": words}
    model = Model.one_sample(len(sides.a), n_permutations, seed)
    result = measured(sides, T, of, model)
    if halves is not None:
        result = result.merge(halves.drop_attrs())
    result = in_unit(result, unit_of(registration["displacement"]))
    return result.assign_coords(individual=sides.names, term=TERMS).assign_attrs(
        left_out=", ".join(without), **attrs, **model.attributes()
    )


def paired(
    study: xr.DataTree, registration: xr.Dataset, subject: Values, side: Values
) -> tuple[list[str], list[int], list[int], list[str], str]:
    """Subjects with both sides, places of their shapes, shapes left out, the sides in words."""
    shapes = registration["shape"].values.tolist()
    of = [str(one).strip() for one in values_of(study, subject, "subject").tolist()]
    sides = [str(one).strip() for one in values_of(study, side, "side").tolist()]
    known = [i for i in range(len(of)) if not {of[i], sides[i]} & {"", "nan"}]
    two = sorted({sides[i] for i in known})
    if len(two) != 2:
        raise ValueError(f"side needs two values, such as left and right; found {listed(two)}")
    place: dict[str, dict[str, int]] = {}
    for i in known:
        if sides[i] in place.setdefault(of[i], {}):
            other = shapes[place[of[i]][sides[i]]]
            raise ValueError(
                f"subject {of[i]!r} has two shapes of the side {sides[i]!r}, {other} and "
                f"{shapes[i]}: keep one of them"
            )
        place[of[i]][sides[i]] = i
    alone = [shapes[i] for name in place for i in place[name].values() if len(place[name]) == 1]
    alone += [shapes[i] for i in range(len(of)) if i not in known]
    if alone:
        log.warning("left out, as the other side of their subject lacks: %s", listed(alone, most=9))
    names = sorted(name for name in place if len(place[name]) == 2)
    if len(names) < 4:
        raise ValueError(
            f"asymmetry needs at least 4 subjects with both sides, found {len(names)}"
            + (f"; one side lacks beside {listed(alone)}" if alone else "")
        )
    _report_sides(study, {shapes[i]: sides[i] for i in known}, two)
    first, second = ([place[name][one] for name in names] for one in two)
    return names, first, second, alone, f"{two[1]} less {two[0]}"


def _report_sides(study, side_of, two):
    """Say so where the run did not mirror just the shapes of one side."""
    report = study["report"].to_dataset() if "report" in study.children else xr.Dataset()
    mirrored = set()
    if "reflected" in report:
        mirrored = set(report["shape"].values[report["reflected"].values.astype(bool)].tolist())
    whole = [{name for name, side in side_of.items() if side == one} for one in two]
    if mirrored & set(side_of) not in whole:
        log.warning(
            "the run mirrored %s, not the shapes of one side: unless their files are mirrored, "
            "what is found is left against right (reflect=)",
            listed(sorted(mirrored)) or "none of the shapes",
        )


def measured(sides: Sides, T: np.ndarray, of: str, model: Model) -> xr.Dataset:
    """All that :func:`asymmetry` says of the sides of individuals."""
    a, area, n = sides.a, sides.area, len(sides.a)
    mean = a.mean(0)
    fields, error = a, sides.error_a
    if of == "normal":
        fields, error = sides.along[..., None], sides.error_along[:, None]
    resolution = BEYOND * largest_around(np.linalg.norm(error, axis=1), T)
    fields = unflagged(fields - error, resolution)
    size = np.sqrt((a**2).sum(-1).mean(0) @ area)
    if size <= ALIKE * np.ptp(sides.consensus, axis=0).max():
        raise ValueError("left and right are the same in all shapes: there is no asymmetry to test")
    fields = np.where(abs(fields) > ALIKE * size, fields, 0)  # the midline has none along normals
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


def unflagged(fields: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Fields ``(s, n, k)`` less what of their mean triangles and partners may have made.

    That is as long as `resolution` at most, and what is shorter than the standard error of the mean
    needs no such care: chance does as much.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.bilateral import unflagged
    >>> unflagged(np.array([[[1.0]], [[3.0]]]), np.array([2.0])).tolist()
    [[[0.0]], [[2.0]]]
    """
    mean = fields.mean(0)
    error = np.sqrt(fields.var(0, ddof=1).sum(-1) / len(fields))
    flag = np.maximum(resolution - error, 0)
    length = np.linalg.norm(mean, axis=1)
    return fields - mean * np.minimum(1, flag / np.where(length > 0, length, 1))[:, None]


def sides_test(K: np.ndarray, model: Model) -> tuple[float, float]:
    """F of sides over individuals x sides, and p under changes of sign of the individuals.

    Parameters
    ----------
    K : float ndarray (s, s)
        Inner products of their asymmetries.
    model : Model
        Of changes of their signs.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.permutation import Model
    >>> from s4a_morphometrics.bilateral import sides_test
    >>> a = 1 + 0.1 * np.arange(6.0)
    >>> sides_test(np.outer(a, a), Model.one_sample(6))[1]
    0.03125
    """
    n, total = len(K), np.trace(K)

    def of(signs):
        """The sum of squares of sides under changes of sign, ``(b,)``."""
        S = np.array(signs)
        return np.einsum("pi,ij,pj->p", S, K, S, optimize=True) / n

    of_sides = of(2 * [np.ones(n)])[0]  # of two rows: einsum iterations one alone in another way
    F = of_sides / max((total - of_sides) / (n - 1), 1e-12 * total)
    p, _ = model.p_values(of, of_sides * (1 - 1e-9), 10_000)
    return float(F), float(p)


def antisymmetry_test(
    coordinates: np.ndarray, *, n_draws: int = 9999, seed: int = 0
) -> tuple[float, float]:
    """Kurtosis of individuals ``(s, c)`` along their first component, and p that it is so low.

    Individuals of one side or the other make two humps, which have a kurtosis towards 1, beside 3
    of normal ones.  Scores of s normal individuals on their first component have every direction
    around their mean alike, whatever the covariance and however many the coordinates are: p is the
    share of such directions with a kurtosis as low.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.bilateral import antisymmetry_test
    >>> rng = np.random.default_rng(0)
    >>> noise = rng.normal(size=(30, 3))
    >>> humps = noise + np.outer(rng.choice([-4, 4], 30), [1, 0, 0])
    >>> antisymmetry_test(humps)[1] < 0.01 < antisymmetry_test(noise)[1]
    True
    """
    around = coordinates - coordinates.mean(0)
    first = np.linalg.eigh(around @ around.T)[1][:, -1]
    found = float(stats.kurtosis(first, fisher=False))
    directions = np.random.default_rng(seed).normal(size=(n_draws, len(first)))
    drawn = stats.kurtosis(directions, axis=1, fisher=False)
    return found, (1 + int((drawn <= found).sum())) / (1 + n_draws)


def asymmetry_modes(study: xr.DataTree, found: xr.Dataset) -> xr.DataTree:
    """An :func:`asymmetry` in the form of a study, for everything that shows modes.

    ``s4a.explore`` and the panel of the modes play it, :func:`s4a.write_page` makes it a file.

    Parameters
    ----------
    study : DataTree
    found : Dataset
        Of :func:`asymmetry`.

    Returns
    -------
    DataTree
        ``/registration`` with the symmetric consensus as its mesh, a shape each individual, and
        ``/pca``: the first component deforms it by the directional asymmetry, its ``score`` is each
        individual's share of that; the others are the principal components of what fluctuates.
        ``explained_variance_ratio`` are shares of the sum of squares of the asymmetries.

    Examples
    --------
    With the ``study`` of six small brains:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> found = s4a_morphometrics.asymmetry(study, n_permutations=99)
    >>> s4a_morphometrics.asymmetry_modes(study, found)["pca"].sizes["component"]
    6
    """
    registration = registration_of(study)
    area = vertex_areas(*as_arrays(registration))
    a = found["asymmetry"].transpose("individual", "vertex", "xyz").values.astype(float)
    modes = gram_pca(a, area)
    K = gram(a, area)
    size = np.sqrt(max(K.mean(), 1e-300))  # of the mean
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
    names = found["individual"].values
    mesh = as_dataset(
        found["symmetric_position"].values, registration["corner_vertex"].values
    ).merge(dataset(displacement=a.astype(np.float32)))
    nodes = {
        "/registration": in_unit(mesh, unit).assign_coords(shape=names),
        "/pca": in_unit(pca, unit).assign_coords(shape=names),
    }
    return xr.DataTree.from_dict(nodes, name=study.name)
