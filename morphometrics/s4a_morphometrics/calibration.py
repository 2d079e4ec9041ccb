"""Calibration of the uncertainty of completed shapes (6.1), by leave-one-out.

Two errors are estimated, and their variances added:

1. The error of the completion relative to the match of the complete shape: shapes of the study are
   cut to the same part, matched and completed by all others (:func:`leave_out_parts`).
2. The error of that match relative to the ground truth.  All shapes of a study are matched to one
   template.  Some are also registered to each other, and the path through the template is compared
   with the direct one (:func:`between_paths`).

The first error includes a part of the second, the errors of a match that no other shape predicts.
With p the completion minus the match and e the match minus the ground truth, the variance of p + e
is

    var(p) + var(e) + 2 cov(p, e),

where the last term is negative if p contains -e.  The direct path takes the place of the ground
truth here, too.
"""

from collections.abc import Sequence
from typing import NamedTuple

import joblib
import numpy as np
import xarray as xr

from s4a.analysis.inputs import registration_of
from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays
from s4a.input.plausibility import evenly_chosen
from s4a.method.alignment import transform_onto
from s4a.method.pca import gram
from s4a.method.register import from_latent
from s4a.method.shape import Shape
from s4a.options import Options, kept_options
from s4a_morphometrics import posterior
from s4a_morphometrics.part import Pose, cut, fit_modes, part_of
from s4a_morphometrics.partial import LEAST_SHARE, Model, complete_low, match, whole_of

N_LEFT_OUT = 12  # shapes of the study whose part is matched again
N_DIRECT = 6  # shapes that are registered to another one
N_CACHED = 8  # studies whose path differences are cached

Differences = dict[str, np.ndarray]  # shape -> (n_low, 3)

_cache: dict[str, Differences] = {}  # by a key of all inputs, the latest last


class Calibration(NamedTuple):
    """Calibrated uncertainty, see :func:`calibrate`."""

    noise: float
    factor: float
    added: float
    paths: float
    residual: float


class Errors(NamedTuple):
    """Errors ``error (m, 3)`` at the vertices ``at (m,)``, relative to the complete match.

    ``deviation (m, 3)`` is the posterior standard deviation, or 1.
    """

    at: np.ndarray
    error: np.ndarray
    deviation: np.ndarray | float = 1.0


class LeftOut(NamedTuple):
    """Errors of a left-out shape in the present and missing regions; residual of its fit."""

    present: Errors
    missing: Errors
    residual: float


def calibrate_part(model: Model, present: np.ndarray, density: float) -> Calibration:
    """Calibrate the completion of a part; see :func:`leave_out_parts` and :func:`calibrate`."""
    return calibrate(leave_out_parts(model, present, density), path_differences(model))


def leave_out_parts(model: Model, present: np.ndarray, density: float) -> dict[str, LeftOut]:
    """Complete the same part of up to :data:`N_LEFT_OUT` shapes by the model of the others.

    The part is cut out of each shape, matched, completed, and compared with the match of the
    complete shape.  Shapes with too few vertices in the part are left out.
    """
    registration = registration_of(model.study)
    names = registration["shape"].values.tolist()
    errors = {}
    for name in _left_out_names(registration):
        i = names.index(name)
        left_out = _leave_out(model, registration.isel(shape=i), i, present, density)
        if left_out is not None:
            errors[name] = left_out
    return errors


def calibrate(left_out: dict[str, LeftOut], differences: Differences) -> Calibration:
    """Return the uncertainty of a completed shape from the errors of left-out shapes.

    The intervals of 90 % contain 90 % of all coordinates: with one variance in the present region,
    and with ``factor`` times the posterior deviations in the missing region.  The variance
    ``paths`` of the study's own matches, see :func:`between_paths`, is added as far as these errors
    lack it, see :func:`share_to_add`.  The results are ``noise``, the variance of a coordinate in
    the present region, and ``added``, the variance to add in the missing region.  ``residual`` is
    the largest of the fits.
    """
    paths = between_paths(differences) ** 2
    if not left_out:
        return Calibration(paths, 1.0, paths, paths, np.inf)
    present = {name: errors.present for name, errors in left_out.items()}
    missing = {name: errors.missing for name, errors in left_out.items()}
    noise, added = _deviation_and_share(present, differences)
    factor, added_missing = _deviation_and_share(missing, differences)
    residual = max(errors.residual for errors in left_out.values())
    return Calibration(noise**2 + added * paths, factor, added_missing * paths, paths, residual)


def _deviation_and_share(errors, differences):
    """Standardised deviation of errors, and the share of the path variance to add."""
    ratios = [np.abs(e.error / e.deviation).ravel() for e in errors.values()]
    known = [name for name in errors if name in differences]
    pairs = [(errors[name].error, differences[name][errors[name].at]) for name in known]
    return deviation_of(ratios), share_to_add(pairs)


def share_to_add(errors: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return the share of the variance between two paths that completion errors lack.

    With p the completion errors and g the match minus the direct path, the variance of p + g is
    that of p plus 1 + 2 (p g) / (g g) times that of g.  The result is the median over the shapes,
    as in :func:`between_paths`, and at least 0.

    Parameters
    ----------
    errors : sequence of tuple of float ndarray (m, 3)
        p and g of each shape.

    Examples
    --------
    A completion error that is the error of the match, and one that is independent of it:

    >>> import numpy as np
    >>> from s4a_morphometrics.calibration import share_to_add
    >>> wrong = np.array([[0.1, -0.2, 0.0]])
    >>> share_to_add([(-wrong, wrong)]), share_to_add([(np.array([[0.0, 0.0, 0.1]]), wrong)])
    (0.0, 1.0)
    """
    shares = [1 + 2 * regression_slope(p, g) for p, g in errors if (g**2).sum() > 0]
    return max(0.0, float(np.median(shares))) if shares else 1.0


def regression_slope(p: np.ndarray, e: np.ndarray) -> float:
    """Return cov(p, e) / var(e), the slope of completion errors p on match errors e.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.calibration import regression_slope
    >>> regression_slope(np.array([-0.5, 0.0, 0.1]), np.array([1.0, 0.0, 0.0]))
    -0.5
    """
    return float((p * e).sum() / (e**2).sum())


def between_paths(differences: Differences) -> float:
    """Return the standard deviation of a coordinate between two paths of matching, for unit area.

    Three registrations contribute.  With independent errors, one would have a third of the
    variance.  Errors are not independent, however: those that all registrations share close every
    cycle and are not detected.  So all of the variance is attributed to one registration.  The
    median over the shapes is robust against a shape with a wrong match.

    Parameters
    ----------
    differences : dict
        From :func:`path_differences`.  If it is empty the result is 0, and the caller must warn.
    """
    if not differences:
        return 0.0
    return float(np.median([deviation_of([np.abs(d).ravel()]) for d in differences.values()]))


def path_differences(model: Model) -> Differences:
    """Return positions of the template's vertices by its match, minus those by the direct path.

    Up to :data:`N_DIRECT` shapes are registered to another shape of the study, with the latent
    bases of its network; the other shape has its own match to the template.  The differences do not
    depend on the part: a process computes them once for a study, and caches the last
    :data:`N_CACHED`.

    Parameters
    ----------
    model : Model
        From :func:`s4a_morphometrics.partial.model_of`.

    Returns
    -------
    dict
        Shape name -> float ndarray (n_low, 3), in the frame of the template.
    """
    registration = registration_of(model.study)
    pairs = _direct_pairs(model.study)
    key = _cache_key(model, pairs)
    differences = _cache.pop(key, None)
    if differences is None:
        differences = {name: _difference(model, registration, name, to) for name, to in pairs}
        for old in list(_cache)[: -N_CACHED + 1]:
            _cache.pop(old, None)
    _cache[key] = differences
    return differences


def _left_out_names(registration):
    """Shapes of the study that are left out in turn."""
    return evenly_chosen(_others(registration), N_LEFT_OUT)


def _others(registration):
    names = registration["shape"].values.tolist()
    return [name for name in names if name != registration.attrs["template"]]


def _direct_pairs(study):
    """Pairs of shapes in the network, without the template; empty if fewer than two remain."""
    registration, network = registration_of(study), study["latent"]["shape"].values.tolist()
    others = [name for name in _others(registration) if name in network]
    left_out = [name for name in _left_out_names(registration) if name in network]
    chosen = evenly_chosen(left_out, N_DIRECT)
    if len(others) < 2:
        return []
    half = len(others) // 2
    return [(name, others[(others.index(name) + half) % len(others)]) for name in chosen]


def _cache_key(model, pairs):
    """Hash of everything that the path differences depend on."""
    study = model.study
    names = sorted({name for pair in pairs for name in pair})
    registered = ["displacement", "rotation", "translation", "scale"]
    contents = [
        model.template.original,
        model.template.coarse,
        study["latent"].to_dataset()[["latent_basis"]].sel(shape=names),
        registration_of(study)[registered].sel(shape=names),
        *(study[node][n].to_dataset() for node in ("original", "coarse") for n in names),
    ]
    arrays = [{str(name): values.values for name, values in data.items()} for data in contents]
    return joblib.hash([pairs, kept_options(study), arrays])


def _difference(model, registration, name, to):
    """Vertices ``(n_low, 3)`` on one shape by the template, minus those by the direct path."""
    shape, other = (registration.sel(shape=n) for n in (name, to))
    X, T = as_arrays(model.study["original"][to].to_dataset())
    triangle, share = closest_point(image_of(other)[model.at], X, T)
    direct = interpolate(_direct_match(model.study, name, to), T, triangle, share)
    off = image_of(shape)[model.at] - direct
    return pose_of(model, shape).s * off @ shape["rotation"].values.T


def _direct_match(study, name, to):
    """Register a shape to another one; return the positions of the other's vertices on it."""
    options = Options.from_report(study)
    source, target = (
        Shape(
            study["original"][n].to_dataset().load(),
            study["coarse"][n].to_dataset(),
            **options.of("projection"),
        )
        for n in (name, to)
    )
    Y = study["latent"].to_dataset()["latent_basis"]
    bases = Y.sel(shape=name).values, Y.sel(shape=to).values
    transform = transform_onto(source.low, target.low)
    direct = from_latent(
        source,
        target,
        bases,
        transform,
        dense_match=options.dense_match,
        **options.of("registration"),
    )
    return image_of(direct.assign(position=target.original["position"]))


def pose_of(model: Model, registered: xr.Dataset) -> Pose:
    """Return the transform of a registered shape from its file to the frame of the template."""
    center, size = model.template.frame
    t = (registered["translation"].values - center) / size
    return Pose(registered["rotation"].values, t, registered["scale"].item() / size)


def image_of(registered: xr.Dataset) -> np.ndarray:
    """Return the template's vertices ``(n, 3)`` on a registered shape, in the pose of its file.

    Parameters
    ----------
    registered : Dataset
        ``position(vertex, xyz)`` of the template, and displacement, rotation, translation and scale
        of one shape.
    """
    X = registered["position"].values + registered["displacement"].values
    moved = (X - registered["translation"].values) @ registered["rotation"].values
    return moved / registered["scale"].item()


def deviation_of(errors: Sequence[np.ndarray]) -> float:
    """Return the standard deviation whose interval of 90 % contains 90 % of the errors.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.calibration import deviation_of
    >>> round(deviation_of([np.full(9, 1.6449), np.array([8.0])]), 2)
    1.39
    """
    values = np.concatenate(errors)
    return float(np.quantile(values, 0.9)) / posterior.WITHIN_90 if len(values) else 0.0


def _leave_out(model, registered, i, present, density):
    """Complete shape i from its part by the others; None if too few vertices remain."""
    study, name = model.study, registered["shape"].item()
    mesh = study["original"][name].to_dataset().load()
    X, T = as_arrays(mesh)
    there = model.template.U @ present.astype(float) > 0.5
    back = study["registration"][name]["template_triangle"].values
    keep = there[model.template.full.T[back]].sum(1) >= 2  # (n_original,)
    pose = pose_of(model, registered)
    part = part_of(*cut(X, T, keep))
    if len(part.X) < 100:
        return None
    used = np.delete(np.arange(len(model.fields)), i)
    fields = model.fields[used]
    rest = model._replace(
        fields=fields,
        modes=posterior.modes_of(gram(fields, model.area), np.arange(len(used))),
    )
    whole = whole_of(rest)
    fit = fit_modes(part, whole, pose, free_size=model.scale)
    low, again, fit = match(part, rest, whole, fit)

    def error(image):
        in_file = (image - fit.pose.t) @ fit.pose.R / fit.pose.s
        return pose(in_file) - model.X - model.fields[i]

    def errors(image, at, deviation=1.0):
        return Errors(at, error(image)[at], deviation)

    at_present = errors(low, np.flatnonzero(again & present))
    missing = np.flatnonzero(~again & ~present)
    if not len(missing) or model.area @ again < LEAST_SHARE:
        return LeftOut(at_present, errors(low, missing[:0]), fit.residual)
    known = posterior.know(
        fields, model.template.low.Phi, model.X, model.area, again, scale=model.scale
    )
    completion = complete_low(rest, known, low, density)
    deviation = np.sqrt((completion.deviation[:, missing] ** 2).sum(0) + known.rest)
    return LeftOut(at_present, errors(completion.image, missing, deviation), fit.residual)
