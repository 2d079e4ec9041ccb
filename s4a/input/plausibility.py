"""Plausibility (5.1, the data): what looks wrong with a shape beside the others of its collection.

It is named and never changed.
"""

import itertools
from collections import Counter

import numpy as np
import xarray as xr

from s4a.geometry.align import cloud, icp, principal_axes
from s4a.geometry.mesh import as_arrays, vertex_areas

N_POINTS = 3000  # vertices of each shape that are looked at
N_PAIRED = 300  # of them, those that ICP pairs
CLEARLY = 0.8  # a residual below this share of another is clearly better
AREA_DROPPED = 0.1
UNITS = {10.0**e: f"10^{e}" for e in (-9, -6, -4, -3, -2, -1, 1, 2, 3, 4, 6, 9)}
UNITS |= {25.4: "25.4", 1 / 25.4: "1/25.4"}  # inches


def best_pose(
    shape: tuple[np.ndarray, np.ndarray], reference: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, float, float]:
    """How a shape lies beside a reference, and its mirror image: ICP from eight turns of each.

    Parameters
    ----------
    shape, reference : tuple (X, area)
        Vertices (n, 3) and their areas, as :func:`sample_vertices` gives them.

    Returns
    -------
    R : float ndarray (3, 3)
        Rotation onto the reference; of the pose as it is, unless a turn is clearly better, and no
        mirror image is.
    residual, mirrored : float
        Least residual of ICP of the shape and of its mirror image, as shares of sqrt(area).
    """
    X, area = _normalized(*shape)
    Y, reference_area = _normalized(*reference)
    Y_axes, Y_cloud = principal_axes(Y, reference_area)[1], cloud(Y, reference_area, N_PAIRED)
    signs = [d for d in itertools.product((1, -1), repeat=3) if np.prod(d) == 1]
    half_turns = [np.diag(d).astype(float) for d in signs]  # as it is, and about each axis

    def fits(X):
        """(R, t, residual) from each start, the first from the pose as it is."""
        axes, X_cloud = principal_axes(X, area)[1], cloud(X, area, N_PAIRED)
        starts = half_turns + [Y_axes @ half_turn @ axes.T for half_turn in half_turns]
        return [icp(X_cloud, Y_cloud, R, np.zeros(3), tolerance=1e-4, rounds=30) for R in starts]

    straight = fits(X)
    as_it_is, best = straight[0], min(straight, key=lambda fit: fit[2])
    mirrored = min(residual for _, _, residual in fits(X * [-1, 1, 1]))
    turned = best[2] < CLEARLY * as_it_is[2] and mirrored >= CLEARLY * best[2]
    return (best if turned else as_it_is)[0], best[2], mirrored


def sample_vertices(mesh: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Vertices ``(3000, 3)`` of a mesh and their areas, evenly from the order of the file."""
    X, T = as_arrays(mesh)
    vertex = np.linspace(0, len(X) - 1, min(len(X), N_POINTS)).astype(int)
    return X[vertex], vertex_areas(X, T)[vertex]


def _normalized(X, area):
    X = X - area @ X / area.sum()
    size = np.sqrt(area @ (X**2).sum(1) / area.sum())
    return X / size, area / area.sum()


def count_intersections(mesh: xr.Dataset) -> int:
    """Triangles of a mesh that pass through others; -1 where PyMeshLab lacks its filter."""
    import pymeshlab

    X, T = as_arrays(mesh)
    unit_box = (X - X.min(0)) / max(np.ptp(X), 1e-300)  # its arithmetic is in single precision
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(unit_box, T))
    try:
        meshes.compute_selection_by_self_intersections_per_face()
    except (AttributeError, pymeshlab.PyMeshLabException):
        return -1
    return int(meshes.current_mesh().selected_face_number())


def examine(
    mesh: xr.Dataset, reference: tuple[np.ndarray, np.ndarray], intersections: bool = True
) -> dict:
    """What :func:`find_warnings` needs of a shape: its pose beside the reference, and counts.

    Parameters
    ----------
    mesh : Dataset
    reference : tuple (X, area)
        Of :func:`sample_vertices`.
    intersections : bool
        Whether triangles that pass through others are counted.

    Returns
    -------
    dict
        ``rotation``, ``residual`` and ``mirrored`` of :func:`best_pose`, and
        ``self_intersections``, -1 where they were not counted.
    """
    R, residual, mirrored = best_pose(sample_vertices(mesh), reference)
    number = count_intersections(mesh) if intersections else -1
    return {
        "rotation": R,
        "residual": residual,
        "mirrored": mirrored,
        "self_intersections": number,
    }


def median_size(areas: dict[str, float]) -> str:
    """Name of the shape of median area, the reference; the first name among equals.

    Examples
    --------
    >>> from s4a.input.plausibility import median_size
    >>> median_size({"a": 1.0, "b": 5.0, "c": 2.0})
    'c'
    """
    return sorted(areas, key=lambda name: (areas[name], name))[(len(areas) - 1) // 2]


def find_warnings(
    attrs: dict[str, dict], evidence: dict[str, dict]
) -> tuple[dict[str, str], list[str]]:
    """What looks wrong, in words: with each shape, and with the collection.

    Parameters
    ----------
    attrs : dict
        Name of every shape that is used -> attributes, as of :func:`s4a.clean`.
    evidence : dict
        Name -> :func:`examine`; may be empty.

    Returns
    -------
    of_shape : dict of str to str
    of_all : list of str
    """
    told, of_all = {name: [] for name in attrs}, []
    for name, said in attrs.items():
        if said.get("area_dropped", 0) > AREA_DROPPED:
            told[name].append(
                f"{100 * said['area_dropped']:.0f} % of the area was in dropped components; "
                'components=N or "all" keeps more'
            )
        number = evidence.get(name, {}).get("self_intersections", -1)
        if number > 0:
            told[name].append(
                f"{number} triangles pass through others; wrap=True makes a surface that does not"
            )
    _compare_sizes(attrs, told)
    _compare_units(attrs, of_all)
    _compare_genus(attrs, told, of_all)
    if evidence:
        _compare_handedness(evidence, told, of_all)
        _compare_rotations(evidence, told)
    return {name: "; ".join(parts) for name, parts in told.items()}, of_all


def _compare_sizes(attrs, told):
    size = {n: np.log10(said["area"]) / 2 for n, said in attrs.items() if said.get("area", 0) > 0}
    for name in size if len(size) > 1 else ():
        ratio = 10 ** (size[name] - np.median([size[other] for other in size if other != name]))
        if 1 / 3 < ratio < 3:
            continue
        unit = next((text for factor, text in UNITS.items() if 0.7 < ratio / factor < 1.4), None)
        guess = f", near {unit}: another unit, such as mm for m?" if unit else ";"
        told[name].append(
            f"{ratio:.3g} times the size of the others{guess}"
            " its size was kept; scale the file if that is wrong"
        )


def _compare_units(attrs, of_all):
    for key in ("unit", "coordinate_system"):
        values = {name: said[key] for name, said in attrs.items() if said.get(key)}
        if len(set(values.values())) > 1:
            of_all.append(
                f"the files name different {key.replace('_', ' ')}s, and none was converted "
                f"({_names_by(values)})"
            )


def _compare_genus(attrs, told, of_all):
    genus = {name: said["genus"] for name, said in attrs.items() if "genus" in said}
    count = Counter(genus.values())
    if len(count) < 2:
        return
    of_all.append(f"the shapes differ in genus ({_names_by(genus, 'genus ')})")
    usual, number = count.most_common(1)[0]
    for name, g in genus.items():
        if g != usual and number > len(genus) / 2:
            told[name].append(
                f"genus {g}, but {usual} in {number} of {len(genus)} shapes; "
                "wrap=True closes tunnels"
            )


def _compare_handedness(evidence, told, of_all):
    """The minority of those that fit their reference clearly better, or worse, when reflected."""
    straight, reflected = [], []
    for name, seen in evidence.items():
        if seen["residual"] < CLEARLY * seen["mirrored"]:
            straight.append(name)
        if seen["mirrored"] < CLEARLY * seen["residual"]:
            reflected.append(name)
    if not straight or not reflected:
        return
    if len(straight) == len(reflected):
        of_all.append(
            f"mirror images of each other, by ICP: {_listed(straight)} and {_listed(reflected)}; "
            "kept as they are"
        )
        return
    for name in min(straight, reflected, key=len):
        seen = evidence[name]
        told[name].append(
            f"fits as a mirror image (ICP residual {seen['residual']:.3f} as it is, "
            f"{seen['mirrored']:.3f} reflected): left for right? "
            "It was kept; mirror the file if that is wrong"
        )


def _compare_rotations(evidence, told):
    """Those turned by about 180 degrees, where most of the shapes lie alike."""
    R = np.stack([seen["rotation"] for seen in evidence.values()])  # (n, 3, 3)
    cos = (np.einsum("aij,bij->ab", R, R) - 1) / 2  # of the angle between each two, by the trace
    angle = np.degrees(np.arccos(np.clip(cos, -1, 1)))
    from_middle = angle[np.argmin(np.median(angle, axis=1))]
    if (from_middle < 45).mean() <= 0.5:
        return
    for name, a in zip(evidence, from_middle, strict=True):
        if a > 135:
            told[name].append(
                f"turned by {a:.0f} degrees against most others: upside down or back to front? "
                "The alignment tries several turns; turn the file if modes or pictures look wrong"
            )


def _names_by(values, prefix=""):
    """The shapes of each value: ``m: a; mm: b, c``."""
    groups = {v: [name for name in values if values[name] == v] for v in set(values.values())}
    return "; ".join(f"{prefix}{v}: {_listed(groups[v])}" for v in sorted(groups))


def _listed(names, most=6):
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
