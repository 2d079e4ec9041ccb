"""Evidence (5.1, the data): what a shape looks like, alone and beside others of its collection.

Numbers only; :mod:`s4a.input.plausibility` says what they mean.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr

from s4a.geometry.align import Cloud, End, cloud, icp_each, principal_axes, residual_of
from s4a.geometry.crossing import can_count, count_crossing
from s4a.geometry.mesh import (
    as_arrays,
    components,
    unique_edges,
    vertex_areas,
    vertex_normals,
    volume,
)
from s4a.schema import dataset

N_POINTS = 3000  # vertices of each shape that are looked at
N_PAIRED = 300  # of them, those that ICP pairs
N_ROUGH = 100  # of them, those that ICP pairs while it compares starts
N_REFERENCES = 6  # shapes beside which every shape is seen
ENOUGH = 5  # shapes, so that there is a usual spread
USUAL = 3.0  # spreads within which a shape can be a reference
# least spreads, of logarithms; collections that vary less would make each of their shapes odd
SIZE, COMPACTNESS, MOMENT = 0.05, 0.03, 0.05
TINY = 1e-3  # gaps below it, of shapes that are the same, are no evidence
MIRROR = np.array([-1.0, 1.0, 1.0])
HALF_TURNS = [np.diag(d) for d in itertools.product((1.0, -1.0), repeat=3) if np.prod(d) == 1]


def portray(mesh: xr.Dataset, *, intersections: bool = True) -> xr.Dataset:
    """A shape on its own: a sketch of some vertices, and numbers that no rigid motion changes.

    Parameters
    ----------
    mesh : Dataset
        Clean, as of :func:`s4a.clean`.
    intersections : bool
        Whether triangles that pass through others are counted.

    Returns
    -------
    Dataset
        ``sketch_position``, ``sketch_area``, ``sketch_normal`` of 3,000 vertices, evenly from the
        order of the file, centred and of unit root mean square radius; ``sketch_asymmetry``, how
        far the mirror image lies above each; ``moment``.  Attributes: ``compactness`` (volume over
        area^1.5), ``chirality`` (skewness along the three axes, multiplied; a mirror image has the
        other sign), ``open_boundary`` (:func:`hole_length` over sqrt(area)), ``lattice``
        (:func:`lattice_step` over the median edge), ``self_intersections`` and ``intersecting``
        (their share of the triangles); -1 where they were not counted.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.evidence import portray
    >>> seen = portray(s4a.synthetic.sphere(500), intersections=False)
    >>> seen["moment"].values.round(2).tolist(), round(seen.attrs["compactness"], 3)
    ([0.33, 0.33, 0.33], 0.094)
    """
    X, T = as_arrays(mesh)
    area = vertex_areas(X, T)
    total = area.sum()
    center, axes = principal_axes(X, area)
    X = X - center
    along = X @ axes  # (n, 3)
    variance = area @ along**2 / total
    skewness = area @ along**3 / total / np.maximum(variance, 1e-300) ** 1.5
    size = np.sqrt(variance.sum())
    vertex = np.linspace(0, len(X) - 1, min(len(X), N_POINTS)).astype(int)
    edge, _, count = unique_edges(T, len(X))
    length = np.linalg.norm(X[edge[:, 0]] - X[edge[:, 1]], axis=1)
    number = count_crossing(mesh["position"].values, T) if intersections else -1
    sketch = dataset(
        sketch_position=X[vertex] / size,
        sketch_area=area[vertex] / area[vertex].sum(),
        sketch_normal=vertex_normals(X, T)[vertex],
        moment=variance / variance.sum(),
    )
    return sketch.assign(dataset(sketch_asymmetry=_asymmetry(sketch))).assign_attrs(
        surface=float(total),
        compactness=abs(volume(X, T)) / float(total) ** 1.5,
        chirality=float(np.linalg.det(axes) * skewness.prod()),
        open_boundary=hole_length(X, edge[count == 1]) / float(np.sqrt(total)),
        lattice=lattice_step(mesh["position"].values) / float(np.median(length)),
        self_intersections=number,
        intersecting=number / len(T) if number >= 0 else -1.0,
    )


def hole_length(X: np.ndarray, boundary: np.ndarray) -> float:
    """Length of the loops of boundary edges (b, 2), root of the sum of squares.

    One long loop is a part cut off; many short ones are holes of a scan, and count for little.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.evidence import hole_length
    >>> hole_length(np.array([[0, 0, 0], [3, 0, 0], [3, 4, 0]]), np.array([[0, 1], [1, 2], [2, 0]]))
    12.0
    """
    length = np.linalg.norm(X[boundary[:, 0]] - X[boundary[:, 1]], axis=1)
    loop = components(boundary, len(X))[boundary[:, 0]]
    return float(np.linalg.norm(np.bincount(loop, length))) if len(boundary) else 0.0


def lattice_step(X: np.ndarray) -> float:
    """Step of the lattice that coordinates are rounded to, the least of the three; else zero.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.evidence import lattice_step
    >>> X = 4 * np.array([[0, 0, 0], [1, 0, 5], [3, 4, 1], [2, 1, 0]])
    >>> lattice_step(X), lattice_step(X + 0.1 * X**0.5)
    (4.0, 0.0)
    """
    steps = []
    for x in np.asarray(X, np.float64).T:
        step = np.diff(np.unique(x))
        step = step[step > 1e-6 * np.ptp(x)]  # shorter ones are rounding of the file
        least = step.min(initial=np.inf)
        whole = np.abs(step / least - np.round(step / least)) < 0.02
        steps.append(float(least) if len(step) and whole.all() else 0.0)
    return min(steps)


def in_numbers(portraits: list[xr.Dataset]) -> np.ndarray:
    """Logarithms of area, compactness and the three moments of shapes (n, 5)."""
    rows = [
        [one.attrs["surface"], one.attrs["compactness"], *one["moment"].values] for one in portraits
    ]
    return np.log(np.maximum(rows, 1e-300)).reshape(-1, 5)


def excess(values: np.ndarray, least: float | np.ndarray) -> np.ndarray:
    """How far each value lies from the median of the others, in their spreads.

    The spread is 1.48 times the median distance from that median, widened where the others are few,
    and at least `least`.

    Parameters
    ----------
    values : float ndarray (n,) or (n, d)
    least : float

    Returns
    -------
    float ndarray, as `values`

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.evidence import excess
    >>> excess(np.array([1.0, 1.1, 0.9, 1.0, 3.0]), 0.1).round(1).tolist()
    [-0.2, 0.6, -0.9, -0.2, 12.2]
    """
    found = np.empty(np.shape(values))
    for i in range(len(values)):
        others = np.delete(values, i, axis=0)
        middle = np.median(others, axis=0)
        spread = 1.4826 * np.median(np.abs(others - middle), axis=0) * (1 + 3 / len(others))
        found[i] = (values[i] - middle) / np.hypot(spread, least)
    return found


def pick_references(portraits: dict[str, xr.Dataset], most: int = N_REFERENCES) -> list[str]:
    """Names of the shapes beside which all are seen: of usual form, spread over the sizes.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.evidence import pick_references, portray
    >>> shapes = {f"s{n}": s4a.synthetic.sphere(n) for n in (100, 150, 200, 250, 300)}
    >>> shapes["long"] = s4a.synthetic.ellipsoid(300, (9, 1, 1))
    >>> seen = {name: portray(mesh, intersections=False) for name, mesh in shapes.items()}
    >>> "long" in pick_references(seen)
    False
    """
    numbers = in_numbers(list(portraits.values()))
    odd = np.zeros(len(numbers), bool)
    if len(numbers) >= ENOUGH:
        least = np.array([SIZE, COMPACTNESS, MOMENT, MOMENT, MOMENT])
        odd = np.abs(excess(numbers, least)).max(1) > USUAL
    usual = [
        (size, name)
        for name, size, far in zip(portraits, numbers[:, 0], odd, strict=True)
        if not far
    ]
    names = [name for _, name in sorted(usual)] or list(portraits)
    return spread(names, most)


def spread(names: list[str], most: int) -> list[str]:
    """Some of many names, evenly, without the first and the last.

    Examples
    --------
    >>> from s4a.input.evidence import spread
    >>> spread(["a", "b", "c", "d", "e", "f"], 2), spread(["a"], 2)
    (['b', 'e'], ['a'])
    """
    if len(names) <= most:
        return names
    ranks = ((np.arange(most) + 0.5) * len(names) / most).astype(int)
    return [names[rank] for rank in ranks]


def compare(name: str, portrait: xr.Dataset, references: dict[str, xr.Dataset]) -> xr.Dataset:
    """A shape beside its references: how closely it fits each, and of which hand it is.

    Parameters
    ----------
    name : str
        Of the shape; where it is one of the references itself, its values there are NaN.
    portrait : Dataset
        Of :func:`portray`.
    references : dict of str to Dataset
        Portraits of the shapes that :func:`pick_references` names.

    Returns
    -------
    Dataset
        The portrait without its sketch, with ``reference`` as coordinate, ``fit`` and
        ``fit_mirrored``, the residual of ICP of the shape and of its mirror image, as shares of
        the root mean square radius; ``hand``, positive where the shape is of the reference's hand
        and negative where its mirror image is, near zero where both could be.
    """
    straight, mirrored = view(portrait), view(portrait, MIRROR)
    own_asymmetry = portrait["sketch_asymmetry"].values
    rows = []
    for other, seen in references.items():
        if other == name:
            rows.append((np.nan,) * 3)
            continue
        reference, asymmetry = view(seen), seen["sketch_asymmetry"].values
        fit, gap, alike = _likeness(straight, reference, own_asymmetry, asymmetry)
        fit_mirrored, gap_mirrored, alike_mirrored = _likeness(
            mirrored, reference, own_asymmetry, asymmetry
        )
        nearer = np.log(max(gap_mirrored, TINY) / max(gap, TINY))
        rows.append((fit, fit_mirrored, alike - alike_mirrored + nearer))
    fit, fit_mirrored, hand = np.array(rows).reshape(-1, 3).T
    own = portrait.drop_vars([str(v) for v in portrait.data_vars if str(v).startswith("sketch_")])
    beside = dataset(fit=fit, fit_mirrored=fit_mirrored, hand=hand)
    return own.assign(beside.variables).assign_coords(reference=list(references))


def examine(meshes: dict[str, xr.Dataset], *, intersections: bool = True) -> dict[str, xr.Dataset]:
    """:func:`compare` of every shape with the references of the collection.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.evidence import examine
    >>> seen = examine({"a": s4a.synthetic.sphere(300), "b": s4a.synthetic.ellipsoid(300)})
    >>> seen["a"]["fit"].round(2).values.tolist()
    [nan, 0.23]
    """
    intersections = can_count(intersections)
    seen = {name: portray(mesh, intersections=intersections) for name, mesh in meshes.items()}
    references = {name: seen[name] for name in pick_references(seen)}
    return {name: compare(name, one, references) for name, one in seen.items()}


@dataclass(frozen=True)
class View:
    """A sketch as ICP takes it; see :func:`view`."""

    cloud: Cloud
    rough: Cloud  # pairs fewer of its vertices
    axes: np.ndarray  # (3, 3)
    normal: np.ndarray  # (n, 3)


def view(sketch: xr.Dataset, flip: np.ndarray | float = 1.0) -> View:
    """A sketch, or with ``flip=MIRROR`` its mirror image, ready for :func:`best_pose`."""
    X, area = sketch["sketch_position"].values * flip, sketch["sketch_area"].values
    whole = cloud(X, area, N_PAIRED)
    rough = Cloud(X, area, whole.tree, whole.paired[:N_ROUGH])
    axes = principal_axes(X, area)[1]
    return View(whole, rough, axes, sketch["sketch_normal"].values * flip)


def best_pose(shape: View, reference: View) -> End:
    """ICP of a shape onto a reference, from eight turns: as it is, by its axes, half turns of both.

    Returns
    -------
    R, t, residual
        As of :func:`s4a.geometry.align.icp_each`.
    """
    turns = HALF_TURNS + [reference.axes @ half_turn @ shape.axes.T for half_turn in HALF_TURNS]
    starts = [(R, np.zeros(3)) for R in turns]
    rough = icp_each(shape.rough, reference.rough, starts, tolerance=1e-3, rounds=5)
    best = [(R, t) for R, t, _ in sorted(rough, key=residual_of)[:2]]
    ends = icp_each(shape.cloud, reference.cloud, best, tolerance=1e-4, rounds=30)
    return min(ends, key=residual_of)


def _gaps(shape, reference, end):
    """Signed distances along the normals, (n,) and (p,), and the vertices that face each other."""
    R, t, _ = end
    X, Y = shape.cloud.X @ R.T + t, reference.cloud.X
    there = reference.cloud.tree.query(X)[1]  # (n,)
    back = shape.cloud.tree.query((Y - t) @ R)[1]  # (p,)
    above = ((X - Y[there]) * reference.normal[there]).sum(1)
    below = ((Y - X[back]) * (shape.normal[back] @ R.T)).sum(1)
    return above, below, there


def _asymmetry(sketch):
    """How far the mirror image lies above each vertex of a sketch (n,), centred, tails cut."""
    mirror_image, own = view(sketch, MIRROR), view(sketch)
    _, below, _ = _gaps(mirror_image, own, best_pose(mirror_image, own))
    limit = np.quantile(np.abs(below), 0.95)
    height = -np.clip(below, -limit, limit)
    return height - own.cloud.area @ height


def _likeness(shape, reference, asymmetry, reference_asymmetry):
    """Residual, mean gap along the normals, and how alike the asymmetries are, -1 to 1."""
    end = best_pose(shape, reference)
    above, below, there = _gaps(shape, reference, end)
    weight, reference_weight = shape.cloud.area, reference.cloud.area
    gap = weight @ np.abs(above) + reference_weight @ np.abs(below)
    a, b = asymmetry, reference_asymmetry[there]
    b = b - weight @ b
    alike = weight @ (a * b) / np.sqrt(max((weight @ a**2) * (weight @ b**2), 1e-300))
    return end[2], gap, alike
