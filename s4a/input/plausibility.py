"""What looks wrong with a shape beside the others of its collection.

Named, never changed (4.1, the input).
"""

import itertools
from collections import Counter

import numpy as np

from s4a.geometry.align import cloud, icp, principal_axes
from s4a.geometry.mesh import as_arrays, vertex_areas

N_POINTS, N_PAIRED = 3000, 300  # vertices of each shape that are looked at, and that ICP pairs
CLEARLY = 0.8  # a residual below this share of another is clearly better
UNITS = {10.0**e: f"10^{e}" for e in (-9, -6, -4, -3, -2, -1, 1, 2, 3, 4, 6, 9)} | {
    25.4: "25.4",
    1 / 25.4: "1/25.4",
}
AREA_DROPPED = 0.1


def pose(shape, reference):
    """How a shape lies beside a reference, and its mirror image: ICP from eight turns of each.

    Parameters
    ----------
    shape, reference : tuple (X, area)
        Vertices (n, 3) and their areas.

    Returns
    -------
    R : float ndarray (3, 3)
        Rotation onto the reference; of the pose as it is, unless a turn is clearly better, and no
        mirror image is.
    residual, mirrored : float
        Least residual of ICP of the shape and of its mirror image, as shares of sqrt(area).
    """
    (P, p), (Q, q) = _unit(*shape), _unit(*reference)
    options, cloud_q = {"tolerance": 1e-4, "rounds": 30}, cloud(Q, q, N_PAIRED)
    halves = [
        np.diag(d).astype(float) for d in itertools.product((1, -1), repeat=3) if np.prod(d) == 1
    ]

    def ends(X):
        A, B = principal_axes(X, p)[1], principal_axes(Q, q)[1]
        starts = halves + [B @ half @ A.T for half in halves]
        cloud_x = cloud(X, p, N_PAIRED)
        return [icp(cloud_x, cloud_q, R, np.zeros(3), **options) for R in starts]

    found, mirrored = ends(P), ends(P * [-1, 1, 1])
    as_it_is, best, reflected = (
        found[0],
        min(found, key=lambda f: f[2]),
        min(f[2] for f in mirrored),
    )
    turned = best[2] < CLEARLY * as_it_is[2] and reflected >= CLEARLY * best[2]
    return (best if turned else as_it_is)[0], best[2], reflected


def sample(mesh):
    """Some vertices of a mesh and their areas, in the order of the file."""
    X, T = as_arrays(mesh)
    some = np.linspace(0, len(X) - 1, min(len(X), N_POINTS)).astype(int)
    return X[some], vertex_areas(X, T)[some]


def _unit(X, area):
    X = X - area @ X / area.sum()
    size = np.sqrt(area @ (X**2).sum(1) / area.sum())
    return X / size, area / area.sum()


def count_intersections(mesh):
    """Triangles of a mesh that pass through others; -1 where PyMeshLab lacks its filter."""
    import pymeshlab

    X, T = as_arrays(mesh)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(_unit_box(X), T))
    try:
        meshes.compute_selection_by_self_intersections_per_face()
    except (AttributeError, pymeshlab.PyMeshLabException):
        return -1
    return int(meshes.current_mesh().selected_face_number())


def _unit_box(X):
    return (X - X.min(0)) / max(np.ptp(X), 1e-300)  # its arithmetic is in single precision


def look(mesh, reference, intersections=True):
    """What :func:`warnings` needs of a shape.

    Rotation onto the reference (a :func:`sample`) and counts, as a dict.
    """
    R, residual, mirrored = pose(sample(mesh), reference)
    found = count_intersections(mesh) if intersections else -1
    return {"rotation": R, "residual": residual, "mirrored": mirrored, "self_intersections": found}


def median_size(areas):
    """Name of the shape whose area is the median one: the reference.

    The first in the order of names among equals.

    Examples
    --------
    >>> from s4a.input.plausibility import median_size
    >>> median_size({"a": 1.0, "b": 5.0, "c": 2.0})
    'c'
    """
    return sorted(areas, key=lambda name: (areas[name], name))[(len(areas) - 1) // 2]


def warnings(attrs, looks):
    """What looks wrong, in words: with each shape, and with the collection.

    Parameters
    ----------
    attrs : dict
        Name of every shape that is used -> attributes, as of :func:`s4a.clean`.
    looks : dict
        Name -> :func:`look`; may be empty.

    Returns
    -------
    of_shape : dict of str to str
    of_all : list of str
    """
    found = {name: [] for name in attrs}
    for name, given in attrs.items():
        if given.get("area_dropped", 0) > AREA_DROPPED:
            found[name].append(
                f"{100 * given['area_dropped']:.0f} % of the area was in dropped components; "
                f'components=N or "all" keeps more'
            )
        number = looks.get(name, {}).get("self_intersections", -1)
        if number > 0:
            found[name].append(
                f"{number} triangles pass through others; wrap=True makes a surface that does not"
            )
    of_all = []
    for check in (_sizes, _units, _genus):
        check(attrs, found, of_all)
    if looks:
        _hands(looks, found, of_all)
        _turns(looks, found)
    return {name: "; ".join(parts) for name, parts in found.items()}, of_all


def _sizes(attrs, found, of_all):
    size = {
        name: np.log10(given["area"]) / 2
        for name, given in attrs.items()
        if given.get("area", 0) > 0
    }
    for name in size if len(size) > 1 else ():
        ratio = 10 ** (size[name] - np.median([size[other] for other in size if other != name]))
        if 1 / 3 < ratio < 3:
            continue
        unit = next((text for factor, text in UNITS.items() if 0.7 < ratio / factor < 1.4), None)
        found[name].append(
            f"{ratio:.3g} times the size of the others"
            + (f", near {unit}: another unit, such as mm for m?" if unit else ";")
            + " its size was kept; scale the file if that is wrong"
        )


def _units(attrs, found, of_all):
    for what in ("unit", "coordinate_system"):
        given = {name: a[what] for name, a in attrs.items() if a.get(what)}
        if len(set(given.values())) > 1:
            table = "; ".join(
                f"{v}: {_some([n for n in given if given[n] == v])}"
                for v in sorted(set(given.values()))
            )
            of_all.append(
                f"the files name different {what.replace('_', ' ')}s, and none was converted ({table})"
            )


def _genus(attrs, found, of_all):
    genus = {name: given["genus"] for name, given in attrs.items() if "genus" in given}
    count = Counter(genus.values())
    if len(count) < 2:
        return
    table = "; ".join(
        f"genus {g}: {_some([n for n in genus if genus[n] == g])}" for g in sorted(count)
    )
    of_all.append(f"the shapes differ in genus ({table})")
    usual, number = count.most_common(1)[0]
    for name, g in genus.items():
        if g != usual and number > len(genus) / 2:
            found[name].append(
                f"genus {g}, but {usual} in {number} of {len(genus)} shapes; wrap=True closes tunnels"
            )


def _hands(looks, found, of_all):
    """The minority of those that fit their reference clearly better, or worse.

    When they are reflected.
    """
    straight = [n for n, one in looks.items() if one["residual"] < CLEARLY * one["mirrored"]]
    reflected = [n for n, one in looks.items() if one["mirrored"] < CLEARLY * one["residual"]]
    sides = sorted(filter(None, (straight, reflected)), key=len)
    if len(sides) < 2:
        return
    if len(sides[0]) == len(sides[1]):
        of_all.append(
            f"mirror images of each other, by ICP: {_some(sides[0])} and {_some(sides[1])}; kept as they are"
        )
        return
    for name in sides[0]:
        found[name].append(
            f"fits as a mirror image (ICP residual {looks[name]['residual']:.3f} as it is, "
            f"{looks[name]['mirrored']:.3f} reflected): left for right? It was kept; mirror the file if that is wrong"
        )


def _turns(looks, found):
    """Those turned by about 180 degrees, where most of the shapes lie alike."""
    names = list(looks)
    R = np.stack([looks[name]["rotation"] for name in names])
    angle = np.degrees(np.arccos(np.clip((np.einsum("aij,bij->ab", R, R) - 1) / 2, -1, 1)))
    middle = np.argmin(np.median(angle, axis=1))
    if (angle[middle] < 45).mean() <= 0.5:
        return
    for name, a in zip(names, angle[middle], strict=True):
        if a > 135:
            found[name].append(
                f"turned by {a:.0f} degrees against most others: upside down or back to front? "
                "The alignment tries several turns; turn the file if modes or pictures look wrong"
            )


def _some(names, most=6):
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
