"""Plausibility (5.1, the data): detect shapes that differ suspiciously from their collection.

Suspect shapes are reported and never changed.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from s4a.geometry.align import (
    Cloud,
    cloud,
    icp_each,
    initial_transforms,
    principal_axes,
    residual_of,
)
from s4a.geometry.crossing import can_count, count_crossing
from s4a.geometry.mesh import (
    as_arrays,
    components,
    counted_edges,
    vertex_areas,
    vertex_normals,
    volume,
)
from s4a.input.chirality import (
    COMMON_SIDE,
    MIRROR,
    OTHER_SIDE,
    clearly_mirrored,
    fits_mirrored,
    mean_chirality,
)
from s4a.input.subjects import listed as first_of
from s4a.schema import Array, dataset

N_POINTS = 3000  # vertices of each shape that are used
N_PAIRED = 300  # of them, those that ICP pairs
N_ROUGH = 100  # of them, those that ICP pairs while it compares initialisations
TRIM = 0.1  # share of the pairs that ICP drops, the farthest ones, such as missing parts
N_REFERENCES = 6  # shapes that every shape is compared with
_ENOUGH = 5  # shapes from which deviations are estimated
_USUAL = 3.0  # deviations within which a shape can be a reference
# least deviations, of logarithms; in collections that vary less every shape would be an outlier
SIZE, COMPACTNESS, MOMENT = 0.05, 0.03, 0.05
_CLOSE_POSE = 1.2  # residual over that of the best pose, up to which ICP goes on from a pose
_TINY = 1e-3  # smaller distances, of identical shapes, are no evidence


def describe(mesh: xr.Dataset, *, intersections: bool = True) -> xr.Dataset:
    """Descriptor of one shape: a sample of its vertices and rigidly invariant numbers.

    Parameters
    ----------
    mesh : Dataset
        Clean mesh, see :func:`s4a.clean`.
    intersections : bool
        Count self-intersecting triangles.

    Returns
    -------
    Dataset
        ``descriptor_position``, ``descriptor_area``, ``descriptor_normal`` of 3,000 vertices,
        evenly from the order of the file, centred and of unit root mean square radius;
        ``descriptor_asymmetry``, signed distance of the mirror image; ``moment``.  Attributes:
        ``compactness`` (volume over area^1.5), ``chirality`` (product of the skewness along the
        three axes; a mirror image has the other sign), ``open_boundary`` (:func:`hole_length` over
        sqrt(area)), ``lattice`` (:func:`lattice_step` over the median edge), ``self_intersections``
        and ``intersecting`` (share of the triangles); -1 if they were not counted.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.plausibility import describe
    >>> sphere = describe(s4a.synthetic.sphere(500), intersections=False)
    >>> sphere["moment"].values.round(2).tolist(), round(sphere.attrs["compactness"], 3)
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
    edge, count = counted_edges(T, len(X))
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


def hole_length(X: Array, boundary: Array) -> float:
    """Root of the sum of squared lengths of the loops of boundary edges ``(b, 2)``.

    One long loop, a missing part, counts more than many short ones, holes of a scan.

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


def lattice_step(X: Array) -> float:
    """Step of the lattice that coordinates are rounded to, the least of the axes; 0 if none.

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


def _log_measures(descriptors):
    """Logarithms of area, compactness and the three moments of shapes ``(n, 5)``."""
    rows = [[d.attrs["surface"], d.attrs["compactness"], *d["moment"].values] for d in descriptors]
    return np.log(np.maximum(rows, 1e-300)).reshape(-1, 5)


def excess(values: Array, least: float | Array) -> Array:
    """Leave-one-out robust z-score: distance from the median of the other values, in deviations.

    The deviation is 1.48 times the median absolute deviation, increased if there are few values,
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
    score = np.empty(np.shape(values))
    for i in range(len(values)):
        others = np.delete(values, i, axis=0)
        median = np.median(others, axis=0)
        deviation = 1.4826 * np.median(np.abs(others - median), axis=0) * (1 + 3 / len(others))
        score[i] = (values[i] - median) / np.hypot(deviation, least)
    return score


def pick_references(descriptors: dict[str, xr.Dataset], most: int = N_REFERENCES) -> list[str]:
    """Names of the reference shapes: without outliers, evenly over the sizes.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.plausibility import pick_references, describe
    >>> shapes = {f"s{n}": s4a.synthetic.sphere(n) for n in (100, 150, 200, 250, 300)}
    >>> shapes["long"] = s4a.synthetic.ellipsoid(300, (9, 1, 1))
    >>> "long" in pick_references({n: describe(m, intersections=False) for n, m in shapes.items()})
    False
    """
    numbers = _log_measures(list(descriptors.values()))
    is_outlier = np.zeros(len(numbers), bool)
    if len(numbers) >= _ENOUGH:
        least = np.array([SIZE, COMPACTNESS, MOMENT, MOMENT, MOMENT])
        is_outlier = np.abs(excess(numbers, least)).max(1) > _USUAL
    usual = [
        (size, name)
        for name, size, skip in zip(descriptors, numbers[:, 0], is_outlier, strict=True)
        if not skip
    ]
    names = [name for _, name in sorted(usual)] or list(descriptors)
    return evenly_chosen(names, most)


def evenly_chosen(names: list[str], most: int) -> list[str]:
    """Choose at most `most` of the names, evenly, without the first and the last.

    Examples
    --------
    >>> from s4a.input.plausibility import evenly_chosen
    >>> evenly_chosen(["a", "b", "c", "d", "e", "f"], 2), evenly_chosen(["a"], 2)
    (['b', 'e'], ['a'])
    """
    if len(names) <= most:
        return names
    ranks = ((np.arange(most) + 0.5) * len(names) / most).astype(int)
    return [names[rank] for rank in ranks]


def compare(name: str, descriptor: xr.Dataset, references: dict[str, xr.Dataset]) -> xr.Dataset:
    """Compare a shape with references: quality of fit, and chirality.

    Parameters
    ----------
    name : str
        Name of the shape; if it is a reference itself, its values there are NaN.
    descriptor : Dataset
        See :func:`describe`.
    references : dict of str to Dataset
        Descriptors of the shapes that :func:`pick_references` names.

    Returns
    -------
    Dataset
        ``moment`` and the attributes of the descriptor, with ``reference`` as coordinate; ``fit``
        and ``fit_mirrored``, the ICP residuals of the shape and of its mirror image, as shares of
        the root mean square radius; ``chirality``, positive if the shape is of the same side as
        the reference, negative if its mirror image is, near zero if that is not clear.
    """
    shape, mirrored = view(descriptor), view(descriptor, MIRROR)
    shape_asymmetry = descriptor["descriptor_asymmetry"].values
    rows = []
    for other, data in references.items():
        if other == name:
            rows.append((np.nan,) * 3)
            continue
        reference, asymmetry = view(data), data["descriptor_asymmetry"].values
        fit, distance, correlation = _similarity(shape, reference, shape_asymmetry, asymmetry)
        fit_mirrored, distance_mirrored, correlation_mirrored = _similarity(
            mirrored, reference, shape_asymmetry, asymmetry
        )
        closer = np.log(max(distance_mirrored, _TINY) / max(distance, _TINY))
        rows.append((fit, fit_mirrored, correlation - correlation_mirrored + closer))
    fit, fit_mirrored, chirality = np.array(rows).reshape(-1, 3).T
    arrays = [str(v) for v in descriptor.data_vars if str(v).startswith("descriptor_")]
    comparison = dataset(fit=fit, fit_mirrored=fit_mirrored, chirality=chirality)
    data = descriptor.drop_vars(arrays).assign(comparison.variables)
    return data.assign_coords(reference=list(references))


def examine(meshes: dict[str, xr.Dataset], *, intersections: bool = True) -> dict[str, xr.Dataset]:
    """:func:`compare` every shape with the references of the collection.

    Examples
    --------
    >>> import s4a
    >>> from s4a.input.plausibility import examine
    >>> shapes = examine({"a": s4a.synthetic.sphere(300), "b": s4a.synthetic.ellipsoid(300)})
    >>> shapes["a"]["fit"].round(2).values.tolist()
    [nan, 0.23]
    """
    intersections = can_count(intersections)
    descriptors = {name: describe(m, intersections=intersections) for name, m in meshes.items()}
    references = {name: descriptors[name] for name in pick_references(descriptors)}
    return {name: compare(name, data, references) for name, data in descriptors.items()}


@dataclass(frozen=True)
class View:
    """Input of ICP, made from a descriptor by :func:`view`."""

    cloud: Cloud
    rough: Cloud  # pairs fewer of its vertices
    normal: Array  # (n, 3)


def view(descriptor: xr.Dataset, flip: Array | float = 1.0) -> View:
    """Prepare a descriptor, or with ``flip=MIRROR`` its mirror image, for ``_best_pose``."""
    X, area = descriptor["descriptor_position"].values * flip, descriptor["descriptor_area"].values
    fine = cloud(X, area, N_PAIRED)
    rough = Cloud(X, area, fine.tree, fine.paired[:N_ROUGH])
    return View(fine, rough, descriptor["descriptor_normal"].values * flip)


def _best_pose(shape, reference):
    """Align a shape to a reference by ICP from rotations that align principal axes.

    Returns
    -------
    R, t, residual
        As of :func:`s4a.geometry.align.icp_each`.
    """
    poses = initial_transforms(shape.cloud, reference.cloud)
    rough, fine = (shape.rough, reference.rough), (shape.cloud, reference.cloud)
    # pairs, tolerance, iterations, and how many poses are kept: more points for fewer poses
    stages = [(rough, 1e-3, 2, 4), (rough, 1e-3, 4, 2), (fine, 1e-4, 30, 1)]
    for clouds, tolerance, iterations, most in stages:
        ends = icp_each(*clouds, poses, tolerance=tolerance, iterations=iterations, trim=TRIM)
        ends = sorted(ends, key=residual_of)[:most]
        poses = [end[:2] for end in ends if end[2] <= _CLOSE_POSE * ends[0][2]]
    return ends[0]


def _distances(shape, reference, pose):
    """Signed distances along the normals, (n,) and (p,), and the nearest vertices (n,)."""
    R, t, _ = pose
    X, Y = shape.cloud.X @ R.T + t, reference.cloud.X
    nearest = reference.cloud.tree.query(X)[1]  # (n,)
    nearest_of_reference = shape.cloud.tree.query((Y - t) @ R)[1]  # (p,)
    normal = shape.normal[nearest_of_reference] @ R.T
    above = ((X - Y[nearest]) * reference.normal[nearest]).sum(1)
    below = ((Y - X[nearest_of_reference]) * normal).sum(1)
    return above, below, nearest


def _asymmetry(descriptor):
    """Signed distance of the mirror image at each vertex of a descriptor ``(n,)``.

    Values beyond the 95 % quantile are clipped, and the mean is subtracted.
    """
    mirrored, shape = view(descriptor, MIRROR), view(descriptor)
    _, below, _ = _distances(mirrored, shape, _best_pose(mirrored, shape))
    limit = np.quantile(np.abs(below), 0.95)
    height = -np.clip(below, -limit, limit)
    return height - shape.cloud.area @ height


def _similarity(shape, reference, asymmetry, reference_asymmetry):
    """Residual, mean distance along the normals, and correlation of the asymmetries."""
    pose = _best_pose(shape, reference)
    above, below, nearest = _distances(shape, reference, pose)
    weight, reference_weight = shape.cloud.area, reference.cloud.area
    distance = weight @ np.abs(above) + reference_weight @ np.abs(below)
    a, b = asymmetry, reference_asymmetry[nearest]
    b = b - weight @ b
    correlation = weight @ (a * b) / np.sqrt(max((weight @ a**2) * (weight @ b**2), 1e-300))
    return pose[2], distance, correlation


_AREA_DROPPED = 0.1
_UNITS = {10.0**e: f"10^{e}" for e in (-9, -6, -4, -3, -2, -1, 1, 2, 3, 4, 6, 9)}
_UNITS |= {25.4: "25.4", 1 / 25.4: "1/25.4", 2.54: "2.54", 1 / 2.54: "1/2.54"}  # inches

# Thresholds, chosen on synthetic brains, cats, faces and ten bodies (docs/plausibility.md)
_SUSPECT_SIZE = 1.8  # times the size of the others, or less than one over it
_IMPLAUSIBLE_SIZE = 3.0  # the same, beyond anatomical variation
WARNED = 5.0  # deviations of a size, a boundary or a form: a warning
_WARNED_EXTENT = 7.0  # the same of extents, which poses change
FLAGGED = 8.0  # deviations of a form: flagged
_FIT = 0.12  # least deviation of the logarithm of the residual
_BOUNDARY = 0.12  # least deviation of lengths over sqrt(area)
SAME = 1e-4  # largest difference of two files of one scan, in every number below
_CROSSING = 0.01  # share of self-intersecting triangles
_LATTICE = 0.2  # step of rounded coordinates, in median edges
_MUCH_MORE = 10.0  # times the share of self-intersections, or the step, of the others
CLOSE = 2.0  # times the usual residual; a part is not a mirror image


# kind -> whether it flags the shape, message with what was found and expected, remedy
KINDS = {
    kind: (flags == "flag", message, remedy)
    for line in Path(__file__).with_name("kinds.txt").read_text(encoding="utf-8").splitlines()
    if line[0] != "#"
    for kind, flags, message, remedy in [line.split(" | ")]
}
# kind: attribute of the comparison, and the least value that is reported
_MUCH_MORE_OF = {"intersections": ("intersecting", _CROSSING), "spacing": ("lattice", _LATTICE)}


class Flag(NamedTuple):
    """Finding about a shape: a key of :data:`KINDS`, the message, whether it flags the shape."""

    kind: str
    words: str
    flagged: bool


Flags = dict[str, list[Flag]]  # name of a shape -> findings


def flag(kind: str, flagged: bool | None = None, **values: Any) -> Flag:
    """Make a flag of a kind, with `values` in its message.

    `flagged` is that of the kind by default.

    Examples
    --------
    >>> from s4a.input.plausibility import flag
    >>> flag("genus", genus=1, usual=0, number=5, n=6).words
    'genus 1, but 0 in 5 of 6 shapes; wrap=True closes tunnels'
    """
    usually, words, _ = KINDS[kind]
    return Flag(kind, words.format(**values), usually if flagged is None else bool(flagged))


def in_words(flags: list[Flag]) -> str:
    """Messages of all flags of a shape, for the report's ``warning``."""
    return "; ".join(flag.words for flag in flags)


def find_warnings(
    attrs: dict[str, dict[str, Any]], comparisons: Mapping[str, xr.Dataset]
) -> tuple[Flags, list[str]]:
    """Find suspect shapes, and faults of the collection.

    Parameters
    ----------
    attrs : dict
        Name of every shape that is used -> attributes of :func:`s4a.clean`.
    comparisons : dict
        Name -> :func:`compare`; may be empty.

    Returns
    -------
    flags : dict of str to list of Flag
        Every name, with an empty list if nothing was found.
    remarks : list of str
        Findings about several shapes.
    """
    flags: Flags = {name: [] for name in attrs}
    remarks: list[str] = []
    used = {name: comparisons[name] for name in attrs if name in comparisons}
    # each check yields names and flags, and appends to `remarks`
    checks = [_dropped(attrs), _sizes(attrs, remarks), _genus(attrs, remarks)]
    if len(used) > 1:
        checks += [_much_more("intersections", used), _duplicates(used), _mirrored(used, remarks)]
    if len(used) >= _ENOUGH:
        checks += [_boundaries(used), _much_more("spacing", used), _forms(used, flags)]
    for check in checks:
        for name, flag_of_check in check:
            flags[name].append(flag_of_check)
    return flags, remarks


def _dropped(attrs):
    for name, values in attrs.items():
        if values.get("area_dropped", 0) > _AREA_DROPPED:
            yield name, flag("dropped", percent=100 * values["area_dropped"])


def _sizes(attrs, remarks):
    """Flags of another size or unit; of two groups of sizes, those of the smaller group."""
    size = {n: np.log(a["area"]) / 2 for n, a in attrs.items() if a.get("area", 0) > 0}
    names, values = np.array(list(size)), np.array(list(size.values()))
    group = _two_sizes(values)
    if group.any():
        ratio = np.exp(abs(np.median(values[~group]) - np.median(values[group])))
        remarks.append(
            f"two groups of sizes, with the ratio {ratio:.3g}: {first_of(names[group], most=6)}, "
            "and the others; no size was changed: scale the files of one group if units differ"
        )
    if len(names) < 2:
        return
    far = np.abs(excess(values, SIZE)) if len(names) >= _ENOUGH else np.zeros(len(names))
    for i in np.flatnonzero(group) if group.any() else range(len(names)):
        usual = np.median(values[~group] if len(names) > 2 else np.delete(values, i))
        ratio = np.exp(values[i] - usual)
        off = max(ratio, 1 / ratio)
        if off >= _IMPLAUSIBLE_SIZE or (off > _SUSPECT_SIZE and (far[i] > WARNED or group[i])):
            unit = next((text for factor, text in _UNITS.items() if _near(ratio, factor)), None)
            kind = "unit" if unit else "size"
            yield (
                names[i],
                flag(kind, off > _IMPLAUSIBLE_SIZE or bool(unit), ratio=ratio, unit=unit),
            )


def _near(ratio, factor):
    within = 1.4 if max(factor, 1 / factor) > 5 else 1.15  # 2.54 is near anatomical variation
    return 1 / within < ratio / factor < within


def _two_sizes(values):
    """Mask ``(n,)`` of the smaller of two distinct groups of sizes, of at least two shapes each."""
    group = np.zeros(len(values), bool)
    if len(values) < 4:
        return group
    order = np.argsort(values, kind="stable")
    step = np.diff(values[order])
    cut = 1 + int(np.argmax(step))
    low, high = order[:cut], order[cut:]
    within = max(np.ptp(values[low]), np.ptp(values[high]))
    if min(len(low), len(high)) >= 2 and step[cut - 1] >= max(np.log(_SUSPECT_SIZE), 2 * within):
        # on a tie, the group of the first name stays
        group[low if (len(low), 0 in low) < (len(high), 0 in high) else high] = True
    return group


def _genus(attrs, remarks):
    genus = {name: values["genus"] for name, values in attrs.items() if "genus" in values}
    count = Counter(genus.values())
    if len(count) < 2:
        return
    names = {g: first_of([n for n in genus if genus[n] == g], most=6) for g in sorted(count)}
    listed = "; ".join(f"genus {g}: {of_genus}" for g, of_genus in names.items())
    remarks.append(f"the shapes differ in genus ({listed})")
    usual, number = count.most_common(1)[0]
    for name, g in genus.items():
        if g != usual and number > len(genus) / 2:
            yield name, flag("genus", genus=g, usual=usual, number=number, n=len(genus))


def _much_more(kind, comparisons):
    """Flags of values above a limit and many times the median of the others."""
    attr, least = _MUCH_MORE_OF[kind]
    values = np.array([data.attrs[attr] for data in comparisons.values()])
    for i, (name, data) in enumerate(comparisons.items()):
        usual = max(float(np.median(np.delete(values, i))), 0.0)
        if values[i] > max(least, _MUCH_MORE * usual):
            percent = {"percent": 100 * values[i], "usual_percent": 100 * usual}
            number = data.attrs["self_intersections"]
            yield name, flag(kind, value=values[i], usual=usual, number=number, **percent)


def _duplicates(comparisons):
    """Flags of equal numbers, which do not depend on pose, order of vertices or format.

    A reflection changes the sign of the chirality, which is zero for a symmetric shape.
    """
    chirality = [data.attrs["chirality"] for data in comparisons.values()]
    numbers = np.column_stack([_log_measures(list(comparisons.values())), chirality])
    names = list(comparisons)
    copy_of: dict[int, int] = {}
    for i, j in sorted(cKDTree(numbers).query_pairs(SAME, p=np.inf)):
        copy_of.setdefault(j, i)
    for j, i in copy_of.items():
        is_symmetric = abs(chirality[i] + chirality[j]) < SAME
        mirrored = " (or its mirror image)" if is_symmetric else ""
        yield names[j], flag("duplicate", other=names[i], mirrored=mirrored)


def _mirrored(comparisons, remarks):
    """Flags of shapes of the less common side, if the shapes of the collection are chiral."""
    names, mean = np.array(list(comparisons)), mean_chirality(comparisons)
    fit, fit_mirrored = (
        np.array([np.nanmedian(data[key]) for data in comparisons.values()])
        for key in ("fit", "fit_mirrored")
    )
    usual = np.median(np.minimum(fit, fit_mirrored))
    close = (fit_mirrored < CLOSE * usual) | (fit_mirrored < fit / CLOSE)
    other = names[(mean < -OTHER_SIDE) & close].tolist()
    clear = clearly_mirrored(comparisons, other)
    if np.median(np.abs(mean)) < COMMON_SIDE or not clear:
        return
    if 2 * len(clear) == len(names):
        rest = [name for name in names if name not in clear]
        remarks.append(
            f"mirror images of each other, by ICP: {first_of(rest, most=6)} and "
            f"{first_of(clear, most=6)}; none was changed"
        )
    for name, fits in fits_mirrored(comparisons, clear if len(names) > 2 else []).items():
        yield name, flag("mirrored", fit=fits[0], fit_mirrored=fits[1])


def _boundaries(comparisons):
    length = np.array([data.attrs["open_boundary"] for data in comparisons.values()])
    for i, (name, score) in enumerate(zip(comparisons, excess(length, _BOUNDARY), strict=True)):
        if score > WARNED:
            usual = np.median(np.delete(length, i))
            yield name, flag("partial", value=length[i], usual=usual)


def _forms(comparisons, flags):
    """Flags of outliers in form; a missing part or a duplicate is reported as such only."""
    data = list(comparisons.values())
    fit = np.log([max(float(np.nanmedian(shape["fit"])), 1e-9) for shape in data])
    _, compactness, *moment = _log_measures(data).T
    # poses change the extents most, so their limit is higher
    extents = np.abs(excess(np.array(moment).T, MOMENT)).max(1) * WARNED / _WARNED_EXTENT
    scores = {
        "its distance from the others after alignment is": excess(fit, _FIT),
        "its volume-to-area ratio is": np.abs(excess(compactness, COMPACTNESS)),
        "its extents are": extents,
    }
    for i, name in enumerate(comparisons):
        what = max(scores, key=lambda what: scores[what][i])
        deviations = scores[what][i]
        is_explained = any(flag.kind in ("partial", "duplicate") for flag in flags[name])
        if deviations > WARNED and not is_explained:
            yield name, flag("kind", deviations > FLAGGED, what=what, deviations=deviations)


class Decision(NamedTuple):
    """Shapes with a kind of flag on which the user must decide, and the remedy."""

    kind: str
    names: list[str]
    remedy: str


def _by_kind(kinds):
    """Decisions, one per kind, sorted by number of shapes; `kinds` of a shape are words."""
    names: dict[str, list[str]] = {}
    for name, words in kinds.items():
        for kind in words.split():
            names.setdefault(kind, []).append(name)
    order = sorted(names, key=lambda kind: -len(names[kind]))
    otherwise = (False, "", "look at the page")
    return [Decision(kind, names[kind], KINDS.get(kind, otherwise)[2]) for kind in order]


def decisions(report: xr.Dataset, column: str = "flag_kinds") -> list[Decision]:
    """Decisions on the flagged shapes of a report, sorted by number of shapes."""
    if column not in report:
        return []
    names, words = report["shape"].values.tolist(), report[column].values.tolist()
    return _by_kind(dict(zip(names, words, strict=True)))


def notices(report: xr.Dataset) -> list[Decision]:
    """Warnings of a report that do not flag a shape."""
    return decisions(report, "warning_kinds")


def flagged_lines(kinds: dict[str, str]) -> list[str]:
    """Format a line per kind: number of shapes, names, remedy.

    Parameters
    ----------
    kinds : dict of str to str
        Name of a shape -> the kinds of its flags, separated by blanks.

    Examples
    --------
    >>> from s4a.input.plausibility import flagged_lines
    >>> flagged_lines({"a": "unit", "b": "unit"})
    ['2 unit: a, b (scale the files to the unit of the others)']
    """
    return [
        f"{len(decision.names)} {decision.kind}: {listed(decision.names, 50)} ({decision.remedy})"
        for decision in _by_kind(kinds)
    ]


def listed(names: Sequence[str], width: int, longest: int = 24) -> str:
    """List as many names as fit in `width` characters, at least one, and the number of others.

    Examples
    --------
    >>> from s4a.input.plausibility import listed
    >>> listed(["brain_01", "brain_02", "brain_03"], 26)
    'brain_01, brain_02, 1 more'
    """
    names = shortened(names, longest)
    text, shown = ", ".join(names), len(names)
    while len(text) > width and shown > 1:
        shown -= 1
        text = ", ".join([*names[:shown], f"{len(names) - shown} more"])
    return text


def shortened(texts: Iterable[str], longest: int) -> list[str]:
    """Shorten texts to at most `longest` characters by omitting the middle.

    Examples
    --------
    >>> from s4a.input.plausibility import shortened
    >>> shortened(["subject_0001_left_hippocampus", "b"], 15)
    ['subject…ocampus', 'b']
    """
    half = (longest - 1) // 2
    return [t if len(t) <= longest else f"{t[:half]}…{t[-half:]}" for t in texts]
