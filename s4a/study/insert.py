"""New shapes in a finished study (4.2, 6.1): latent basis, registration and scores.

All others stay as they are.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from joblib import Parallel, delayed
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from s4a.geometry.align import align, farthest_points, realign
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.input.collection import read_shapes, shape_report
from s4a.input.plausibility import look, sample, warnings
from s4a.method.first_map import first_map_of
from s4a.method.fmap import fmap_from_match, nearest_rows
from s4a.method.joint import Surface
from s4a.method.median import area_differences, conformal_differences, distance_to_identity
from s4a.method.network import spectral_distance
from s4a.method.register import Scan, registration
from s4a.method.remesh import coarsen
from s4a.method.spectral import spectrum, unit_area
from s4a.schema import dataset, in_unit, require, unit_of
from s4a.study import store

NEIGHBOURS, FINAL = (
    6,
    3,
)  # shapes of the study in the rounds on samples, and in the last round on all vertices
SAMPLES = 1000


def frozen_basis(C_out, C_in, Y):
    """Latent basis of one shape from its maps to and from others whose bases stay (eq. 3.

    One block of its unknowns).

    Minimises sum_j |C_out_j Y_new - Y_j|^2 + |C_in_j Y_j - Y_new|^2.

    Parameters
    ----------
    C_out, C_in : float ndarray (p, k, k)
        Functional maps from the new shape to the others, and from them to it.
    Y : float ndarray (p, k, m)
        The others' bases.

    Returns
    -------
    float ndarray (k, m)

    Examples
    --------
    >>> Y = np.array([[[1.0], [2.0]]])
    >>> frozen_basis(np.eye(2)[None], np.eye(2)[None], Y).tolist()
    [[1.0], [2.0]]
    """
    k = C_out.shape[1]
    left = len(Y) * np.eye(k) + np.einsum("pab,pac->bc", C_out, C_out)
    right = np.einsum("pab,pac->bc", C_out, Y) + np.einsum("pab,pbc->ac", C_in, Y)
    return np.linalg.solve(left, right)


@dataclass(frozen=True)
class Neighbour:
    """A shape of the study: its :class:`s4a.method.joint.Surface` at low resolution.

    Latent basis ``Y (k, m)`` and samples.
    """

    low: Surface
    Y: np.ndarray
    sample: np.ndarray

    @cached_property
    def F(self):
        """The latent functions Phi Y (n, m)."""
        return self.low.Phi[:, : len(self.Y)] @ self.Y


def neighbour(coarse, Y):
    """A :class:`Neighbour` from the low-resolution mesh and the latent basis of a shape."""
    (X, T), area = as_arrays(coarse), unit_area(coarse)
    X = (X - area @ X) / np.sqrt(coarse["vertex_area"].values.sum())
    low = Surface(
        X, T, area, coarse["eigenfunction"].values, eigenvalue=coarse["eigenvalue"].values
    )
    return Neighbour(low, Y, farthest_points(X, SAMPLES))


def latent_of(new, others, motions, *, k_init=20, step=5, init="dense", rounds=2):
    """Latent basis of a new shape, those of all others frozen.

    Consistent ZoomOut of one shape (4.2, eq. 3).

    It starts from the first maps of the others; in every round the rows of the first latent
    functions are matched with those of each of the others, on samples, and more of the functions
    carried over; the last rounds use all vertices.

    Parameters
    ----------
    new : Neighbour
        Its ``Y`` is not looked at.
    others : list of Neighbour
    motions : list of (R, t)
        Of each of the others onto the new shape.
    k_init, step, init : see :func:`s4a.analyse`
    rounds : int
        Of :func:`frozen_basis`.

    Returns
    -------
    float ndarray (k, m)
    """
    k, m = others[0].Y.shape
    first = [
        first_map_of(o.low, new.low, motion, k_init=k_init, init=init)[1]
        for o, motion in zip(others, motions, strict=True)
    ]
    Y = np.mean(
        [C @ o.Y[:k_init, : min(k_init, m)] for C, o in zip(first, others, strict=True)], axis=0
    )
    root = np.sqrt(new.low.area[new.sample])
    while len(Y) < k:
        size = min(len(Y) + step, k)
        points = new.low.Phi[new.sample, : len(Y)] @ Y
        solve = np.linalg.pinv(new.low.Phi[new.sample, :size] * root[:, None]) * root
        carried = 0
        for o in others:
            F = o.F[o.sample]
            carried = carried + F[nearest_rows(points, F[:, : points.shape[1]]), : min(size, m)]
        Y = solve @ carried / len(others)
    Phi = new.low.Phi[:, :k]
    for _ in range(rounds):
        points, out, into = Phi @ Y, [], []
        for o in others[:FINAL]:
            out.append(
                fmap_from_match(Phi, o.low.Phi[:, :k], o.low.area, nearest_rows(o.F, points))
            )
            into.append(
                fmap_from_match(o.low.Phi[:, :k], Phi, new.low.area, nearest_rows(points, o.F))
            )
        Y = frozen_basis(np.stack(out), np.stack(into), np.stack([o.Y for o in others[:FINAL]]))
    return Y


def project_scores(d, mean, deformation, standard_deviation, area):
    """Scores of displacements on given modes, and what the modes leave.

    Parameters
    ----------
    d : float ndarray (s, n, 3)
    mean : (n, 3), deformation : (c, n, 3), standard_deviation : (c,)
        As of :func:`s4a.method.pca.gram_pca`.
    area : float ndarray (n,)

    Returns
    -------
    score : (s, c), in standard deviations
    residual : (s,), root mean square over the area of what is left
    """
    w = area / area.sum()
    scores, lefts = [], []
    for field in d:  # one by one, so that the last digit does not depend on the others
        x = np.asarray(field, float) - mean
        score = (
            np.einsum("cnx,nx->c", deformation, x * w[:, None], optimize=True)
            / standard_deviation**2
        )
        left = (
            np.einsum("nx,nx,n->", x, x, w, optimize=True)
            - ((score * standard_deviation) ** 2).sum()
        )
        scores.append(score)
        lefts.append(np.sqrt(max(left, 0.0)))
    return np.array(scores), np.array(lefts)


def options_of(study):
    """What of the options of the study a new shape needs."""
    given = study["report"].attrs if "report" in study else {}
    numbers = {
        n: int(given.get(n, d))
        for n, d in (("n_coarse", 6000), ("k_init", 20), ("step", 5), ("seed", 0))
    }
    flags = {
        n: given.get(n, "False") == "True" for n in ("wrap", "scale", "strict", "intersections")
    }
    words = {
        n: given.get(n, d)
        for n, d in (("init", "dense"), ("refine", "joint"), ("norm", "h2"), ("how", "ours"))
    }
    components = given.get("components", "largest")
    return (
        numbers
        | flags
        | words
        | {"components": int(components) if components.isdigit() else components}
    )


def _insert_one(mesh, template, others, turns, o, compare):
    """``/coarse``, latent basis, registration and :func:`look` of one new shape.

    Or why there are none.
    """
    k = len(others[0].Y)
    try:
        with threadpool_limits(1):
            low = spectrum(
                coarsen(mesh, n_coarse=o["n_coarse"], wrap=o["wrap"], seed=o["seed"]), k=k
            )
            if low.sizes["mode"] < k:
                raise ValueError(
                    f"the study needs {k} eigenfunctions, this shape has only {low.sizes['mode']}"
                )
            shape, new = Scan(mesh, low), neighbour(low, None)
            few = min(o["k_init"], k)
            distance = spectral_distance([n.low.eigenvalue[:few] for n in (new, *others)])[0, 2:]
            chosen = [0, *(1 + np.argsort(distance, kind="stable")[: NEIGHBOURS - 1])]
            R, t, _ = align(shape.low.X, shape.low.area, template.low.X, template.low.area)
            motions = []
            for j in chosen:
                S, u = realign(
                    new.low.X,
                    new.low.area,
                    others[j].low.X,
                    others[j].low.area,
                    (turns[j].T @ R, np.zeros(3)),
                )
                motions.append((S.T, -S.T @ u))
            options = {"k_init": few, "step": o["step"], "init": o["init"]}
            Y = latent_of(new, [others[j] for j in chosen], motions, **options)
            F_source, F_target = shape.low.Phi[:, :k] @ Y, others[0].F
            match = nearest_rows(F_target, F_source)
            if o["how"] == "standard":
                C = fmap_from_match(
                    shape.low.Phi[:, :k], template.low.Phi[:, :k], template.low.area, match
                )
                F_source, F_target = shape.low.Phi[:, :k] @ C.T, template.low.Phi[:, :k]
                match = nearest_rows(F_target, F_source)
            starts = {
                "intrinsic": match,
                "icp": cKDTree(shape.low.X @ R.T + t).query(template.low.X)[1],
            }
            options = {"k": k, "refine": o["refine"], "scale": o["scale"]}
            seen = look(mesh, sample(template.original), o["intersections"]) if compare else {}
            return (
                low,
                Y,
                registration(shape, template, starts, (F_source, F_target), **options),
                seen,
            )
    except ValueError as error:
        return str(error)


def insert(study, shapes, *, compare=True, n_jobs=None):
    """New shapes placed into a finished study, which stays as it is.

    Each new shape is remeshed, aligned and mapped to the template and the five shapes of the study
    with the most alike spectra; its latent basis solves eq. 3 with theirs frozen; it is registered
    to the frozen template, and its displacement measured along the frozen modes.  What comes out
    for one shape does not depend on the others given.

    Parameters
    ----------
    study : DataTree
        Of :func:`s4a.analyse` or :func:`s4a.open_study`.
    shapes : path, list of paths, dict or Dataset
        See :func:`s4a.read_shapes`; a single mesh Dataset is named ``new``.
    compare : bool
        Whether each new shape is compared with those of the study: unit, handedness, pose, genus,
        as :func:`s4a.read_shapes` does it; what looks wrong is named in ``/report`` and left as it
        is.
    n_jobs : int, optional
        As in joblib; the result does not depend on it.

    Returns
    -------
    DataTree
        As a study of the new shapes alone: ``/original``, ``/coarse``, ``/registration`` to the
        frozen template with ``confidence(shape, vertex)``; in ``/latent`` ``latent_basis(shape,
        mode, latent)``, shape differences and ``distance_to_median(shape)``; in ``/pca``
        ``score(shape, component)`` on the frozen modes, these, and ``reconstruction_error(shape)``;
        ``/report``.  ``/original`` has the template's mesh too, so that labels can be transferred.

    Raises
    ------
    ValueError
        When the study is not finished, no shape can be used, or one has the name of the template.

    Examples
    --------
    >>> from s4a import analyse
    >>> from s4a import synthetic
    >>> brains = synthetic.brains(4, 1500)["original"]
    >>> brains = {name: mesh.to_dataset() for name, mesh in brains.children.items()}
    >>> last = brains.pop("brain_04")
    >>> study = analyse(brains, n_coarse=300, k_init=8, k=12)
    >>> insert(study, {"brain_04": last})["pca"]["score"].sizes["component"]
    2
    """
    missing = [
        n for n in ("original", "coarse", "latent", "registration") if n not in study.children
    ]
    if missing:
        raise ValueError(f"a finished study is needed; this one lacks {', '.join(missing)}")
    o = options_of(study)
    template = study["registration"].attrs["template"]
    meshes, attrs = _read({"new": shapes} if isinstance(shapes, xr.Dataset) else shapes, o)
    if template in meshes:
        raise ValueError(f"new shapes need other names than the template, {template!r}; rename it")
    lat = study["latent"].to_dataset()
    require(lat, "latent_basis", "latent_eigenvalue", what="latent dataset")
    names = lat["shape"].values.tolist()
    kept = set(study["registration"]["shape"].values.tolist())
    order = [
        names.index(template),
        *(i for i, n in enumerate(names) if n != template and n in kept),
    ]
    coarse = [study["coarse"][names[i]].to_dataset() for i in order]
    template_scan = Scan(study["original"][template].to_dataset().load(), coarse[0].load())
    bases, latent_eigenvalue = lat["latent_basis"].values, lat["latent_eigenvalue"].values
    others = [neighbour(c, bases[i]) for c, i in zip(coarse, order, strict=True)]
    turns = [study["registration"]["rotation"].sel(shape=names[i]).values for i in order]
    found = Parallel(n_jobs=n_jobs)(
        delayed(_insert_one)(mesh, template_scan, others, turns, o, compare)
        for mesh in meshes.values()
    )
    done = {}
    for name, files in zip(meshes, found, strict=True):
        if isinstance(files, str):
            attrs[name] = attrs[name] | {"status": "excluded", "reason": files}
        else:
            done[name] = files
    if not done:
        reasons = "; ".join(f"{name}: {given['reason']}" for name, given in attrs.items())
        raise ValueError(f"no shape can be inserted ({reasons})")
    nodes = {f"original/{name}": meshes[name] for name in done} | {
        f"original/{template}": template_scan.original
    }
    nodes |= {f"coarse/{name}": low for name, (low, *_) in done.items()}
    bases = np.stack([basis for _, basis, *_ in done.values()])
    spectra = np.stack([low["eigenvalue"].values for low, *_ in done.values()])
    nodes["latent"] = _latent(bases, spectra, latent_eigenvalue, o["norm"]).assign_coords(
        shape=list(done)
    )
    X, T = as_arrays(template_scan.original)
    mesh = as_dataset(X, T, {"template": template}, vertex_area=vertex_areas(X, T))
    mesh = in_unit(mesh, unit_of(template_scan.original["position"]))
    nodes |= store.stack_registration(mesh, {n: files[2] for n, files in done.items()}, list(done))
    if "pca" in study:
        nodes["pca"] = _scores(study["pca"].to_dataset(), nodes["registration"])
    looks = {name: files[3] for name, files in done.items()}
    return xr.DataTree.from_dict(
        nodes | {"report": _compared(study, attrs, looks) if compare else shape_report(attrs)}
    )


def _read(shapes, o):
    """The meshes that can be used, clean, and the attributes of all for the report."""
    ready = {}
    if isinstance(shapes, dict):
        ready = {
            n: m for n, m in shapes.items() if isinstance(m, xr.Dataset) and "file_vertex" in m
        }
        shapes = {n: m for n, m in shapes.items() if n not in ready}
    attrs = {n: {"status": "ok", "reason": ""} | m.attrs for n, m in ready.items()}
    if not isinstance(shapes, dict) or shapes:
        given = read_shapes(shapes, components=o["components"], strict=o["strict"], compare=False)
        report = given["report"].to_dataset()
        new = {name: node.to_dataset() for name, node in given["original"].children.items()}
        for name in report["shape"].values.tolist():
            one = {v: report[v].sel(shape=name).item() for v in ("status", "reason", "path")}
            attrs[name] = new[name].attrs if name in new else one
        ready |= new
    return ready, attrs


def _compared(study, attrs, looks):
    """The report on the new shapes, each beside those of the study.

    These are taken as they lie after registration.
    """
    turns = study["registration"]["rotation"]
    known = {n: study["original"][n].attrs for n in turns["shape"].values.tolist()}
    seen = {
        "residual": 0.0,
        "mirrored": 1.0,
        "self_intersections": -1,
    }  # the hand of the study is the right one
    known_looks = {n: seen | {"rotation": turns.sel(shape=n).values} for n in known}
    before = warnings(known, known_looks)[1]
    reports, remarks = [], {}
    for name, given in attrs.items():
        one = {name: looks[name]} if name in looks else {}
        found = shape_report(known | {name: given}, known_looks | one)
        reports.append(found.sel(shape=[name]))
        remarks |= dict.fromkeys(
            line for line in found.attrs["remarks"].splitlines() if line not in before
        )
    return xr.concat(reports, dim="shape").assign_attrs(remarks="\n".join(remarks))


def _latent(Y, eigenvalues, latent_eigenvalue, norm):
    D = area_differences(Y)
    return dataset(
        latent_basis=Y,
        latent_eigenvalue=latent_eigenvalue,
        area_difference=D,
        conformal_difference=conformal_differences(Y, eigenvalues, latent_eigenvalue),
        distance_to_median=distance_to_identity(D, latent_eigenvalue, norm),
    )


def _scores(modes, registered):
    """The frozen modes, with the scores of the new shapes in place of those that made them."""
    frozen = modes.drop_vars(["score", "shape"])
    names = ("mean_displacement", "deformation", "standard_deviation")
    score, left = project_scores(
        registered["displacement"].values,
        *(modes[n].values for n in names),
        vertex_areas(*as_arrays(registered)),
    )
    found = in_unit(dataset(score=score, reconstruction_error=left), unit_of(modes["deformation"]))
    return frozen.merge(found).assign_coords(shape=registered["shape"])
