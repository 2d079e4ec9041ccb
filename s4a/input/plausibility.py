"""Plausibility (5.1, the data): what looks wrong with a shape beside the others of its collection.

It is named and never changed.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from s4a.geometry.align import Cloud, cloud, icp_each, principal_axes, residual_of
from s4a.geometry.crossing import can_count, count_crossing
from s4a.geometry.mesh import (
    as_arrays,
    components,
    unique_edges,
    vertex_areas,
    vertex_normals,
    volume,
)
from s4a.input.chirality import COMMON_SIDE, MIRROR, OTHER_SIDE, hands
from s4a.input.subjects import listed as first_of
from s4a.schema import dataset

N_POINTS = 3000  # vertices of each shape that are looked at
N_PAIRED = 300  # of them, those that ICP pairs
N_ROUGH = 100  # of them, those that ICP pairs while it compares starts
N_REFERENCES = 6  # shapes beside which every shape is seen
_ENOUGH = 5  # shapes, so that there is a usual spread
_USUAL = 3.0  # spreads within which a shape can be a reference
# least spreads, of logarithms; collections that vary less would make each of their shapes odd
SIZE, COMPACTNESS, MOMENT = 0.05, 0.03, 0.05
_TINY = 1e-3  # gaps below it, of shapes that are the same, are no evidence
_HALF_TURNS = [np.diag(d) for d in itertools.product((1.0, -1.0), repeat=3) if np.prod(d) == 1]


def describe(mesh: xr.Dataset, *, intersections: bool = True) -> xr.Dataset:
    """Descriptor of one shape: some of its vertices and rigidly invariant numbers.

    Parameters
    ----------
    mesh : Dataset
        Clean, as of :func:`s4a.clean`.
    intersections : bool
        Whether triangles that pass through others are counted.

    Returns
    -------
    Dataset
        ``descriptor_position``, ``descriptor_area``, ``descriptor_normal`` of 3,000 vertices,
        evenly from the order of the file, centred and of unit root mean square radius;
        ``descriptor_asymmetry``, how far the mirror image lies above each; ``moment``.  Attributes:
        ``compactness`` (volume over area^1.5), ``chirality`` (skewness along the three axes,
        multiplied; a mirror image has the other sign), ``open_boundary`` (:func:`hole_length` over
        sqrt(area)), ``lattice`` (:func:`lattice_step` over the median edge), ``self_intersections``
        and ``intersecting`` (their share of the triangles); -1 where they were not counted.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.plausibility import describe
    >>> seen = describe(s4a.synthetic.sphere(500), intersections=False)
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
    descriptor = dataset(
        descriptor_position=X[vertex] / size,
        descriptor_area=area[vertex] / area[vertex].sum(),
        descriptor_normal=vertex_normals(X, T)[vertex],
        moment=variance / variance.sum(),
    )
    return descriptor.assign(dataset(descriptor_asymmetry=_asymmetry(descriptor))).assign_attrs(
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
    >>> from s4a.input.plausibility import hole_length
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
    >>> from s4a.input.plausibility import lattice_step
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


def _in_numbers(descriptors):
    """Logarithms of area, compactness and the three moments of shapes (n, 5)."""
    rows = [
        [one.attrs["surface"], one.attrs["compactness"], *one["moment"].values]
        for one in descriptors
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
    >>> from s4a.input.plausibility import excess
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


def pick_references(descriptors: dict[str, xr.Dataset], most: int = N_REFERENCES) -> list[str]:
    """Names of the shapes beside which all are seen: of usual form, spread over the sizes.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.plausibility import pick_references, describe
    >>> shapes = {f"s{n}": s4a.synthetic.sphere(n) for n in (100, 150, 200, 250, 300)}
    >>> shapes["long"] = s4a.synthetic.ellipsoid(300, (9, 1, 1))
    >>> seen = {name: describe(mesh, intersections=False) for name, mesh in shapes.items()}
    >>> "long" in pick_references(seen)
    False
    """
    numbers = _in_numbers(list(descriptors.values()))
    odd = np.zeros(len(numbers), bool)
    if len(numbers) >= _ENOUGH:
        least = np.array([SIZE, COMPACTNESS, MOMENT, MOMENT, MOMENT])
        odd = np.abs(excess(numbers, least)).max(1) > _USUAL
    usual = [
        (size, name)
        for name, size, far in zip(descriptors, numbers[:, 0], odd, strict=True)
        if not far
    ]
    names = [name for _, name in sorted(usual)] or list(descriptors)
    return spread(names, most)


def spread(names: list[str], most: int) -> list[str]:
    """Some of many names, evenly, without the first and the last.

    Examples
    --------
    >>> from s4a.input.plausibility import spread
    >>> spread(["a", "b", "c", "d", "e", "f"], 2), spread(["a"], 2)
    (['b', 'e'], ['a'])
    """
    if len(names) <= most:
        return names
    ranks = ((np.arange(most) + 0.5) * len(names) / most).astype(int)
    return [names[rank] for rank in ranks]


def compare(name: str, descriptor: xr.Dataset, references: dict[str, xr.Dataset]) -> xr.Dataset:
    """A shape beside its references: how closely it fits each, and of which hand it is.

    Parameters
    ----------
    name : str
        Of the shape; where it is one of the references itself, its values there are NaN.
    descriptor : Dataset
        Of :func:`describe`.
    references : dict of str to Dataset
        Portraits of the shapes that :func:`pick_references` names.

    Returns
    -------
    Dataset
        The descriptor without its descriptor, with ``reference`` as coordinate, ``fit`` and
        ``fit_mirrored``, the residual of ICP of the shape and of its mirror image, as shares of
        the root mean square radius; ``hand``, positive where the shape is of the reference's hand
        and negative where its mirror image is, near zero where both could be.
    """
    straight, mirrored = view(descriptor), view(descriptor, MIRROR)
    own_asymmetry = descriptor["descriptor_asymmetry"].values
    rows = []
    for other, seen in references.items():
        if other == name:
            rows.append((np.nan,) * 3)
            continue
        reference, asymmetry = view(seen), seen["descriptor_asymmetry"].values
        fit, gap, alike = _likeness(straight, reference, own_asymmetry, asymmetry)
        fit_mirrored, gap_mirrored, alike_mirrored = _likeness(
            mirrored, reference, own_asymmetry, asymmetry
        )
        nearer = np.log(max(gap_mirrored, _TINY) / max(gap, _TINY))
        rows.append((fit, fit_mirrored, alike - alike_mirrored + nearer))
    fit, fit_mirrored, hand = np.array(rows).reshape(-1, 3).T
    own = descriptor.drop_vars(
        [str(v) for v in descriptor.data_vars if str(v).startswith("sketch_")]
    )
    beside = dataset(fit=fit, fit_mirrored=fit_mirrored, chirality=hand)
    return own.assign(beside.variables).assign_coords(reference=list(references))


def examine(meshes: dict[str, xr.Dataset], *, intersections: bool = True) -> dict[str, xr.Dataset]:
    """:func:`compare` of every shape with the references of the collection.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.plausibility import examine
    >>> seen = examine({"a": s4a.synthetic.sphere(300), "b": s4a.synthetic.ellipsoid(300)})
    >>> seen["a"]["fit"].round(2).values.tolist()
    [nan, 0.23]
    """
    intersections = can_count(intersections)
    seen = {name: describe(mesh, intersections=intersections) for name, mesh in meshes.items()}
    references = {name: seen[name] for name in pick_references(seen)}
    return {name: compare(name, one, references) for name, one in seen.items()}


@dataclass(frozen=True)
class View:
    """A descriptor as ICP takes it; see :func:`view`."""

    cloud: Cloud
    rough: Cloud  # pairs fewer of its vertices
    axes: np.ndarray  # (3, 3)
    normal: np.ndarray  # (n, 3)


def view(descriptor: xr.Dataset, flip: np.ndarray | float = 1.0) -> View:
    """A descriptor, or with ``flip=MIRROR`` its mirror image, ready for ``_best_pose``."""
    X, area = descriptor["descriptor_position"].values * flip, descriptor["descriptor_area"].values
    whole = cloud(X, area, N_PAIRED)
    rough = Cloud(X, area, whole.tree, whole.paired[:N_ROUGH])
    axes = principal_axes(X, area)[1]
    return View(whole, rough, axes, descriptor["descriptor_normal"].values * flip)


def _best_pose(shape, reference):
    """ICP of a shape onto a reference, from eight turns: as it is, by its axes, half turns of both.

    Returns
    -------
    R, t, residual
        As of :func:`s4a.geometry.align.icp_each`.
    """
    turns = _HALF_TURNS + [reference.axes @ half_turn @ shape.axes.T for half_turn in _HALF_TURNS]
    starts = [(R, np.zeros(3)) for R in turns]
    rough = icp_each(shape.rough, reference.rough, starts, tolerance=1e-3, iterations=5)
    best = [(R, t) for R, t, _ in sorted(rough, key=residual_of)[:2]]
    ends = icp_each(shape.cloud, reference.cloud, best, tolerance=1e-4, iterations=30)
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


def _asymmetry(descriptor):
    """How far the mirror image lies above each vertex of a descriptor (n,), centred, tails cut."""
    mirror_image, own = view(descriptor, MIRROR), view(descriptor)
    _, below, _ = _gaps(mirror_image, own, _best_pose(mirror_image, own))
    limit = np.quantile(np.abs(below), 0.95)
    height = -np.clip(below, -limit, limit)
    return height - own.cloud.area @ height


def _likeness(shape, reference, asymmetry, reference_asymmetry):
    """Residual, mean gap along the normals, and how alike the asymmetries are, -1 to 1."""
    end = _best_pose(shape, reference)
    above, below, there = _gaps(shape, reference, end)
    weight, reference_weight = shape.cloud.area, reference.cloud.area
    gap = weight @ np.abs(above) + reference_weight @ np.abs(below)
    a, b = asymmetry, reference_asymmetry[there]
    b = b - weight @ b
    alike = weight @ (a * b) / np.sqrt(max((weight @ a**2) * (weight @ b**2), 1e-300))
    return end[2], gap, alike


_AREA_DROPPED = 0.1
_UNITS = {10.0**e: f"10^{e}" for e in (-9, -6, -4, -3, -2, -1, 1, 2, 3, 4, 6, 9)}
_UNITS |= {25.4: "25.4", 1 / 25.4: "1/25.4", 2.54: "2.54", 1 / 2.54: "1/2.54"}  # inches

# Thresholds, chosen on synthetic brains, cats, faces and ten bodies (docs/plausibility.md)
_ODD_SIZE = 1.8  # times the size of the others, or less than one over it
_OTHER_SIZE = 3.0  # the same, that no anatomy has
SPREADS = 5.0  # times the usual spread of a size, a boundary or a form: a warning
_EXTENT_SPREADS = 7.0  # the same of extents, which poses change
FAR = 8.0  # the same: flagged
_FIT = 0.12  # least spread of the logarithm of the residual
_BOUNDARY = 0.12  # least spread of lengths over sqrt(area)
SAME = 1e-4  # largest difference of two files of one scan, of every number below
_CROSSING = 0.01  # share of the triangles that pass through others
_LATTICE = 0.2  # step of rounded coordinates, of the median edge
_MUCH_MORE = 10.0  # times the others' share of crossing triangles, or step
CLOSE = 2.0  # times the usual residual; a part is no mirror image


# kind: whether nobody but the user knows what is meant, so that the shape is flagged (an honest
# outlier is only named); what was found beside what; the remedy, with the flags of `s4a run`
# fmt: off
KINDS = {
    "dropped": (False, "{percent:.0f} % of the area was in dropped components; "
        'components=N or "all" keeps more', "--components all keeps more of them"),
    "unit": (True, "{ratio:.3g} times the size of the others, near {unit}: another unit, such as "
        "mm for m? its size was kept; scale the file if that is wrong",
        "scale the files to the unit of the others"),
    "size": (False, "{ratio:.3g} times the size of the others; its size was kept; scale the file "
        "if that is wrong", "scale the files, if their size is wrong"),
    "genus": (False, "genus {genus}, but {usual} in {number} of {n} shapes; wrap=True closes "
        "tunnels", "--wrap closes tunnels"),
    "intersections": (False, "{number} triangles pass through others, {percent:.1f} % (in the "
        "others {usual_percent:.1f} %); wrap=True makes a surface that does not",
        "--wrap makes surfaces without"),
    "duplicate": (True, "the same surface as {other}, under two names{mirrored}; leave one of them "
        "out, or it counts twice", "keep one file of each shape"),
    "mirrored": (True, "fits as a mirror image (ICP residual beside most others {fit:.3f} as it "
        "is, {fit_mirrored:.3f} reflected): left for right? It is as its file has it; reflect= "
        "mirrors it", "--reflect mirrors them, if left and right are exchanged"),
    "partial": (True, "its holes are {value:.2g} of sqrt(area) long, of the others {usual:.2g}: is "
        "a part cut off? Complete the scan, leave it out, or close_holes=True where it only has "
        "holes", "scan again, or take the files away"),
    "spacing": (False, "its coordinates are rounded, to {value:.2f} of an edge (in the others "
        "{usual:.2f}); export it with more digits", "export the files with more digits"),
    "kind": (False, "unlike the others: {what} {spreads:.0f} times the usual spread away; another "
        "kind of shape, stretched, or a part? Look at it, and leave it out if it does not belong",
        "take the files away, if of another kind"),
    "registration": (True, "{sure} registered wrongly ({registration_error:.3f}{distortion}): "
        "look at it in s4a view, compare its file with the template's, or leave it out",
        "look at the page; a larger --n-coarse may help"),
}
# fmt: on
# kind: attribute of the evidence, and the least that is told where it is many times the others'
_MUCH_MORE_OF = {"intersections": ("intersecting", _CROSSING), "spacing": ("lattice", _LATTICE)}


class Flag(NamedTuple):
    """What looks wrong with a shape: a key of :data:`KINDS`, its words, whether it is flagged."""

    kind: str
    words: str
    flagged: bool


Flags = dict[str, list[Flag]]  # name of a shape -> what looks wrong with it


def flag(kind: str, flagged: bool | None = None, **found: Any) -> Flag:
    """A flag of a kind, whose words take what was `found`.

    The kind says whether it makes the shape flagged, unless that is given.

    Examples
    --------
    >>> from s4a.input.plausibility import flag
    >>> flag("genus", genus=1, usual=0, number=5, n=6).words
    'genus 1, but 0 in 5 of 6 shapes; wrap=True closes tunnels'
    """
    usually, words, _ = KINDS[kind]
    return Flag(kind, words.format(**found), usually if flagged is None else bool(flagged))


def in_words(flags: list[Flag]) -> str:
    """The sentences of all flags about a shape, as they stand in the report's ``warning``."""
    return "; ".join(one.words for one in flags)


def find_warnings(
    attrs: dict[str, dict[str, Any]], evidence: Mapping[str, xr.Dataset]
) -> tuple[Flags, list[str]]:
    """What looks wrong with each shape, and, in words, with the collection.

    Parameters
    ----------
    attrs : dict
        Name of every shape that is used -> attributes, as of :func:`s4a.clean`.
    evidence : dict
        Name -> :func:`compare`; may be empty.

    Returns
    -------
    of_shape : dict of str to list of Doubt
        Every name; an empty list where nothing looks wrong.
    of_all : list of str
    """
    told: Flags = {name: [] for name in attrs}
    of_all: list[str] = []
    seen = {name: evidence[name] for name in attrs if name in evidence}
    # each check yields names and flags, and adds to `of_all` what concerns several shapes
    checks = [_dropped(attrs), _sizes(attrs, of_all), _genus(attrs, of_all)]
    if len(seen) > 1:
        checks += [_much_more("intersections", seen), _duplicates(seen), _mirrored(seen, of_all)]
    if len(seen) >= _ENOUGH:
        checks += [_boundaries(seen), _much_more("spacing", seen), _forms(seen, told)]
    for check in checks:
        for name, one in check:
            told[name].append(one)
    return told, of_all


def _dropped(attrs):
    for name, said in attrs.items():
        if said.get("area_dropped", 0) > _AREA_DROPPED:
            yield name, flag("dropped", percent=100 * said["area_dropped"])


def _sizes(attrs, of_all):
    """Those of another size, or unit; of two groups of sizes, the smaller group."""
    size = {n: np.log(said["area"]) / 2 for n, said in attrs.items() if said.get("area", 0) > 0}
    names, values = np.array(list(size)), np.array(list(size.values()))
    group = _two_sizes(values)
    if group.any():
        times = np.exp(abs(np.median(values[~group]) - np.median(values[group])))
        of_all.append(
            f"two sizes, {times:.3g} times apart: {first_of(names[group], most=6)}, and the "
            "others; no size was changed: scale the files of one of them if their units differ"
        )
    _different_units(attrs, of_all)
    if len(names) < 2:
        return
    far = np.abs(excess(values, SIZE)) if len(names) >= _ENOUGH else np.zeros(len(names))
    for i in np.flatnonzero(group) if group.any() else range(len(names)):
        usual = np.median(values[~group] if len(names) > 2 else np.delete(values, i))
        ratio = np.exp(values[i] - usual)
        off = max(ratio, 1 / ratio)
        if off >= _OTHER_SIZE or (off > _ODD_SIZE and (far[i] > SPREADS or group[i])):
            unit = next((text for factor, text in _UNITS.items() if _near(ratio, factor)), None)
            kind = "unit" if unit else "size"
            yield names[i], flag(kind, off > _OTHER_SIZE or bool(unit), ratio=ratio, unit=unit)


def _near(ratio, factor):
    within = 1.4 if max(factor, 1 / factor) > 5 else 1.15  # 2.54 is near what anatomies differ by
    return 1 / within < ratio / factor < within


def _two_sizes(values):
    """Those of the smaller of two groups of sizes far apart, of two shapes or more each, (n,)."""
    odd = np.zeros(len(values), bool)
    if len(values) < 4:
        return odd
    order = np.argsort(values, kind="stable")
    step = np.diff(values[order])
    cut = 1 + int(np.argmax(step))
    low, high = order[:cut], order[cut:]
    within = max(np.ptp(values[low]), np.ptp(values[high]))
    if min(len(low), len(high)) >= 2 and step[cut - 1] >= max(np.log(_ODD_SIZE), 2 * within):
        # of as many on both sides the first name stays
        odd[low if (len(low), 0 in low) < (len(high), 0 in high) else high] = True
    return odd


def _different_units(attrs, of_all):
    for key in ("unit", "coordinate_system"):
        values = {name: said[key] for name, said in attrs.items() if said.get(key)}
        if len(set(values.values())) > 1:
            of_all.append(
                f"the files name different {key.replace('_', ' ')}s, and none was converted "
                f"({_names_by(values)})"
            )


def _genus(attrs, of_all):
    genus = {name: said["genus"] for name, said in attrs.items() if "genus" in said}
    count = Counter(genus.values())
    if len(count) < 2:
        return
    of_all.append(f"the shapes differ in genus ({_names_by(genus, 'genus ')})")
    usual, number = count.most_common(1)[0]
    for name, g in genus.items():
        if g != usual and number > len(genus) / 2:
            yield name, flag("genus", genus=g, usual=usual, number=number, n=len(genus))


def _much_more(kind, evidence):
    """Those with more than the least of a number, and many times the usual of the others."""
    attr, least = _MUCH_MORE_OF[kind]
    values = np.array([seen.attrs[attr] for seen in evidence.values()])
    for i, (name, seen) in enumerate(evidence.items()):
        usual = max(float(np.median(np.delete(values, i))), 0.0)
        if values[i] > max(least, _MUCH_MORE * usual):
            percent = {"percent": 100 * values[i], "usual_percent": 100 * usual}
            number = seen.attrs["self_intersections"]
            yield name, flag(kind, value=values[i], usual=usual, number=number, **percent)


def _duplicates(evidence):
    """Shapes with the same numbers, which no transform, no order of vertices and no format changes.

    A reflection changes the sign of the chirality, which of a symmetric shape is none.
    """
    chirality = [seen.attrs["chirality"] for seen in evidence.values()]
    numbers = np.column_stack([_in_numbers(list(evidence.values())), chirality])
    names = list(evidence)
    first: dict[int, int] = {}
    for i, j in sorted(cKDTree(numbers).query_pairs(SAME, p=np.inf)):
        first.setdefault(j, i)
    for j, i in first.items():
        is_symmetric = abs(chirality[i] + chirality[j]) < SAME
        mirrored = " (or its mirror image)" if is_symmetric else ""
        yield names[j], flag("duplicate", other=names[i], mirrored=mirrored)


def _mirrored(evidence, of_all):
    """Those of the rarer hand, where the collection has a hand."""
    fits = ("fit", "fit_mirrored")
    names, mean = np.array(list(evidence)), hands(evidence)
    fit, fit_mirrored = (
        np.array([np.nanmedian(seen[way]) for seen in evidence.values()]) for way in fits
    )
    usual = np.median(np.minimum(fit, fit_mirrored))
    close = (fit_mirrored < CLOSE * usual) | (fit_mirrored < fit / CLOSE)
    other = (mean < -OTHER_SIDE) & close
    if np.median(np.abs(mean)) < COMMON_SIDE or not other.any():
        return
    if 2 * other.sum() == len(names):
        of_all.append(
            f"mirror images of each other, by ICP: {first_of(names[~other], most=6)} and "
            f"{first_of(names[other], most=6)}; kept as they are"
        )
    for name in names[other] if len(names) > 2 else ():
        seen = evidence[name]
        beside = ~np.isin(seen["reference"].values, names[other])
        beside |= not beside.any()
        yield name, flag("mirrored", **{w: np.nanmedian(seen[w].values[beside]) for w in fits})


def _boundaries(evidence):
    length = np.array([seen.attrs["open_boundary"] for seen in evidence.values()])
    for i, (name, more) in enumerate(zip(evidence, excess(length, _BOUNDARY), strict=True)):
        if more > SPREADS:
            usual = np.median(np.delete(length, i))
            yield name, flag("partial", value=length[i], usual=usual)


def _forms(evidence, told):
    """Those unlike the others; where something is told already, that may be the reason."""
    seen = list(evidence.values())
    fit = np.log([max(float(np.nanmedian(one["fit"])), 1e-9) for one in seen])
    _, compactness, *moment = _in_numbers(seen).T
    # of extents: poses change them most, so that they need more
    extents = np.abs(excess(np.array(moment).T, MOMENT)).max(1) * SPREADS / _EXTENT_SPREADS
    far = {
        "its distance from them after alignment is": excess(fit, _FIT),
        "its volume for its area is": np.abs(excess(compactness, COMPACTNESS)),
        "its extents are": extents,
    }
    for i, name in enumerate(evidence):
        what = max(far, key=lambda what: far[what][i])
        spreads = far[what][i]
        known = any(one.kind in ("partial", "duplicate") for one in told[name])
        if spreads > SPREADS and not known:
            yield name, flag("kind", spreads > FAR, what=what, spreads=spreads)


def _names_by(values, prefix=""):
    """The shapes of each value: ``m: a; mm: b, c``."""
    groups = {v: [name for name in values if values[name] == v] for v in set(values.values())}
    return "; ".join(f"{prefix}{v}: {first_of(groups[v], most=6)}" for v in sorted(groups))


class Decision(NamedTuple):
    """What only the user can say of some shapes: the kind of their flags, and what to do."""

    kind: str
    names: list[str]
    remedy: str


def _by_kind(kinds):
    """One decision for each kind, that of most shapes first; `kinds` of a shape are words."""
    names: dict[str, list[str]] = {}
    for name, words in kinds.items():
        for kind in words.split():
            names.setdefault(kind, []).append(name)
    order = sorted(names, key=lambda kind: -len(names[kind]))
    otherwise = (False, "", "look at the page")
    return [Decision(kind, names[kind], KINDS.get(kind, otherwise)[2]) for kind in order]


def decisions(report: xr.Dataset, column: str = "flag_kinds") -> list[Decision]:
    """What is to decide on the flagged shapes of a report, that of most shapes first."""
    if column not in report:
        return []
    names, words = report["shape"].values.tolist(), report[column].values.tolist()
    return _by_kind(dict(zip(names, words, strict=True)))


def notices(report: xr.Dataset) -> list[Decision]:
    """What else looks wrong with shapes, and makes none of them flagged."""
    return decisions(report, "warning_kinds")


def flagged_lines(kinds: dict[str, str]) -> list[str]:
    """A line for each kind: how many shapes, which, what to do.

    Parameters
    ----------
    kinds : dict of str to str
        Name of a shape -> the kinds of its flags, with blanks between them.

    Examples
    --------
    >>> from s4a.input.plausibility import flagged_lines
    >>> flagged_lines({"a": "unit", "b": "unit"})
    ['2 unit: a, b (scale the files to the unit of the others)']
    """
    return [
        f"{len(one.names)} {one.kind}: {listed(one.names, 50)} ({one.remedy})"
        for one in _by_kind(kinds)
    ]


def listed(names: Sequence[str], room: int, longest: int = 24) -> str:
    """As many names as the room has letters, one at least, and how many more there are.

    Examples
    --------
    >>> from s4a.input.plausibility import listed
    >>> listed(["brain_01", "brain_02", "brain_03"], 26)
    'brain_01, brain_02, 1 more'
    """
    names = shortened(names, longest)
    text, shown = ", ".join(names), len(names)
    while len(text) > room and shown > 1:
        shown -= 1
        text = ", ".join([*names[:shown], f"{len(names) - shown} more"])
    return text


def shortened(texts: Iterable[str], longest: int) -> list[str]:
    """Texts of at most so many letters; of a longer one the middle is left out.

    Examples
    --------
    >>> from s4a.input.plausibility import shortened
    >>> shortened(["subject_0001_left_hippocampus", "b"], 15)
    ['subject…ocampus', 'b']
    """
    half = (longest - 1) // 2
    return [t if len(t) <= longest else f"{t[:half]}…{t[-half:]}" for t in texts]
