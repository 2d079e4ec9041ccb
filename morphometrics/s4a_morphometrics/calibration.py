"""Calibration (6.1): how sure what is reported of a part is, by the same part of other shapes.

Two things are measured, and their variances added:

1. How far what is reported lies from the match of the whole: the part is cut out of shapes of the
   study, matched and completed by all others (:func:`found_again`).
2. How far that match lies from the truth.  All shapes of a study are matched to one template.
   They are registered onto each other, too, and the way over the template is compared with the
   direct one (:func:`between_ways`).

The first holds some of the second: what the match of a left-out shape gets wrong on its own no
other shape tells.  With p what is reported less the match and e the match less the truth, the
variance of p + e is

    var(p) + var(e) + 2 cov(p, e),

and the last term is negative where p holds -e.  The direct way stands for the truth here, too.
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
from s4a.method.initial_map import transform_onto
from s4a.method.pca import gram
from s4a.method.register import from_latent
from s4a.method.shape import Shape
from s4a.options import Options, kept_options
from s4a_morphometrics import posterior
from s4a_morphometrics.part import Pose, cut, fit_modes, part_of
from s4a_morphometrics.partial import LEAST_SHARE, Model, match, tell, whole_of

N_REMATCHED = 12  # shapes of the study whose part is matched again
N_WAYS = 6  # of them, those that are registered onto another
N_KEPT = 8  # studies whose ways are remembered

Gaps = dict[str, np.ndarray]  # shape -> (n_low, 3)

_kept: dict[str, Gaps] = {}  # by the key of all that they depend on, the latest last


class Again(NamedTuple):
    """What the same part of shapes of the study says, see :func:`again_of`."""

    noise: float
    factor: float
    added: float
    ways: float
    residual: float


class Errors(NamedTuple):
    """Differences ``error (m, 3)`` from the match of a whole shape, and ``at (m,)`` which vertices.

    ``deviation (m, 3)``, what the distribution of what is reported says of them, or 1.
    """

    at: np.ndarray
    error: np.ndarray
    deviation: np.ndarray | float = 1.0


class Found(NamedTuple):
    """A shape told from its part by the others: where that is, elsewhere; residual of its fit."""

    there: Errors
    missing: Errors
    residual: float


def match_again(model: Model, present: np.ndarray, density: float) -> Again:
    """How well the same part of shapes of the study is found and completed by the others.

    See :func:`found_again` and :func:`again_of`.
    """
    return again_of(found_again(model, present, density), gaps_between_ways(model))


def found_again(model: Model, present: np.ndarray, density: float) -> dict[str, Found]:
    """The same part of up to :data:`N_REMATCHED` shapes of the study, each told by the others.

    It is cut out of them, matched by the model of the others, completed, and compared with the
    match of the whole shape.  Shapes of which hardly anything is left are not among them.
    """
    registration = registration_of(model.study)
    names = registration["shape"].values.tolist()
    found = {}
    for name in _rematched(registration):
        i = names.index(name)
        one = _found_again(model, registration.isel(shape=i), i, present, density)
        if one is not None:
            found[name] = one
    return found


def again_of(found: dict[str, Found], gaps: Gaps) -> Again:
    """What shapes that were told by the others say of one that is reported by all.

    Nine tenths of all coordinates lie within the intervals of 90 %, of one variance where the part
    is, and where nothing is of the deviations of the distribution times ``factor``, which errors of
    the pose and of the match widen.  Of the variance ``ways`` that the matches of whole shapes
    have, see :func:`between_ways`, the share is added that these errors lack, see
    :func:`share_to_add`: that gives ``noise``, the variance of a coordinate where the part is, and
    ``added``, what comes to that of the distribution where nothing is.  ``residual`` is the largest
    of their fits.
    """
    ways = between_ways(gaps) ** 2
    if not found:
        return Again(ways, 1.0, ways, ways, np.inf)
    noise, added = _calibrated({name: one.there for name, one in found.items()}, gaps)
    factor, added_missing = _calibrated({name: one.missing for name, one in found.items()}, gaps)
    residual = max(one.residual for one in found.values())
    return Again(noise**2 + added * ways, factor, added_missing * ways, ways, residual)


def _calibrated(found, gaps):
    """The deviation of errors beside their own, and the share of the ways' variance to add."""
    ratios = [np.abs(one.error / one.deviation).ravel() for one in found.values()]
    both = [(one.error, gaps[name][one.at]) for name, one in found.items() if name in gaps]
    return deviation_of(ratios), share_to_add(both)


def share_to_add(told: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Which share of the variance between two ways is not in the errors of what is reported.

    With p the errors from the match and g the match less the direct way, the variance of p + g is
    that of p and 1 + 2 (p g) / (g g) times that of g; the median over the shapes, as in
    :func:`between_ways`, and none where it is negative.

    Parameters
    ----------
    told : sequence of tuple of float ndarray (m, 3)
        p and g of each shape.

    Examples
    --------
    What is reported lies off the match by what that has wrong, and by something else:

    >>> import numpy as np
    >>> from s4a_morphometrics.calibration import share_to_add
    >>> wrong = np.array([[0.1, -0.2, 0.0]])
    >>> share_to_add([(-wrong, wrong)]), share_to_add([(np.array([[0.0, 0.0, 0.1]]), wrong)])
    (0.0, 1.0)
    """
    shares = [1 + 2 * held(p, g) for p, g in told if (g**2).sum() > 0]
    return max(0.0, float(np.median(shares))) if shares else 1.0


def held(p: np.ndarray, e: np.ndarray) -> float:
    """How many times the errors e of a match are in the errors p from it: cov(p, e) / var(e).

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.calibration import held
    >>> held(np.array([-0.5, 0.0, 0.1]), np.array([1.0, 0.0, 0.0]))
    -0.5
    """
    return float((p * e).sum() / (e**2).sum())


def between_ways(gaps: Gaps) -> float:
    """The deviation of a coordinate between two ways of matching, for unit area.

    Three registrations have their part in it, and were their errors independent, a third of its
    variance would be that of one.  They are not: what surfaces mislead all registrations to closes
    every cycle, and is not seen, nor is what all matches to the template have in common, but that
    every direct way has another template.  That is why all of it is taken for the error of one.
    The median over the shapes: one that is matched wrong does not speak for the others.

    Parameters
    ----------
    gaps : dict
        Of :func:`gaps_between_ways`; 0 where it is empty, of which a caller has to warn.
    """
    if not gaps:
        return 0.0
    return float(np.median([deviation_of([np.abs(gap).ravel()]) for gap in gaps.values()]))


def gaps_between_ways(model: Model) -> Gaps:
    """Where the template's vertices lie on shapes of the study, less where the direct way has them.

    Up to :data:`N_WAYS` shapes are each registered onto another one of the study, by the latent
    bases of its network; the other has each vertex of the template where its own match has it.
    They are the same for every part: a process finds them once for the content of a study,
    whichever tree that comes in, and remembers those of the last :data:`N_KEPT`.

    Parameters
    ----------
    model : Model
        See :func:`s4a_morphometrics.partial.model_of`.

    Returns
    -------
    dict
        Of shapes: float ndarray (n_low, 3), in the frame of the template.
    """
    registration = registration_of(model.study)
    pairs = _pairs_of(model.study)
    key = _key_of(model, pairs)
    gaps = _kept.pop(key, None)
    if gaps is None:
        gaps = {name: _gap(model, registration, name, onto) for name, onto in pairs}
        for old in list(_kept)[: -N_KEPT + 1]:
            _kept.pop(old, None)
    _kept[key] = gaps
    return gaps


def _rematched(registration):
    """Shapes of the study whose part is matched again."""
    return evenly_chosen(_others(registration), N_REMATCHED)


def _others(registration):
    names = registration["shape"].values.tolist()
    return [name for name in names if name != registration.attrs["template"]]


def _pairs_of(study):
    """Some of them, each with the shape that it is registered onto; none that is excluded.

    None at all where fewer than two stand in the network beside the template.
    """
    registration, network = registration_of(study), study["latent"]["shape"].values.tolist()
    others = [name for name in _others(registration) if name in network]
    chosen = evenly_chosen([name for name in _rematched(registration) if name in network], N_WAYS)
    if len(others) < 2:
        return []
    half = len(others) // 2
    return [(name, others[(others.index(name) + half) % len(others)]) for name in chosen]


def _key_of(model, pairs):
    """The key of all that the ways between these shapes depend on."""
    study = model.study
    names = sorted({name for pair in pairs for name in pair})
    placed = ["displacement", "rotation", "translation", "scale"]
    contents = [
        model.template.original,
        model.template.coarse,
        study["latent"].to_dataset()[["latent_basis"]].sel(shape=names),
        registration_of(study)[placed].sel(shape=names),
        *(study[node][n].to_dataset() for node in ("original", "coarse") for n in names),
    ]
    arrays = [{str(name): values.values for name, values in one.items()} for one in contents]
    return joblib.hash([pairs, kept_options(study), arrays])


def _gap(model, registration, name, onto):
    """Where one shape has the vertices ``(n_low, 3)`` less where the direct way has them."""
    one, other = (registration.sel(shape=n) for n in (name, onto))
    X, T = as_arrays(model.study["original"][onto].to_dataset())
    triangle, share = closest_point(image_of(other)[model.at], X, T)
    direct = interpolate(_direct_way(model.study, name, onto), T, triangle, share)
    off = image_of(one)[model.at] - direct
    return pose_of(model, one).s * off @ one["rotation"].values.T


def _direct_way(study, name, onto):
    """Where the vertices of one shape lie on another in its file, as that is registered onto it."""
    options = Options.from_report(study)
    source, target = (
        Shape(
            study["original"][n].to_dataset().load(),
            study["coarse"][n].to_dataset(),
            **options.of("projection"),
        )
        for n in (name, onto)
    )
    Y = study["latent"].to_dataset()["latent_basis"]
    bases = Y.sel(shape=name).values, Y.sel(shape=onto).values
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
    """The transform of a registered shape from its file into the frame of the template."""
    center, size = model.template.frame
    t = (registered["translation"].values - center) / size
    return Pose(registered["rotation"].values, t, registered["scale"].item() / size)


def image_of(registered: xr.Dataset) -> np.ndarray:
    """Where the template's vertices ``(n, 3)`` lie on a registered shape in its file.

    Parameters
    ----------
    registered : Dataset
        ``position(vertex, xyz)`` of the template, and the displacement, rotation, translation and
        scale of one shape.
    """
    X = registered["position"].values + registered["displacement"].values
    moved = (X - registered["translation"].values) @ registered["rotation"].values
    return moved / registered["scale"].item()


def deviation_of(errors: Sequence[np.ndarray]) -> float:
    """The standard deviation with whose interval of 90 % nine tenths of all errors agree.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a_morphometrics.calibration import deviation_of
    >>> round(deviation_of([np.full(9, 1.6449), np.array([8.0])]), 2)
    1.39
    """
    every = np.concatenate(errors)
    return float(np.quantile(every, 0.9)) / posterior.WITHIN_90 if len(every) else 0.0


def _found_again(model, registered, i, present, density):
    """Shape i told from its part by the others; None where hardly anything is left."""
    study, name = model.study, registered["shape"].item()
    mesh = study["original"][name].to_dataset().load()
    X, T = as_arrays(mesh)
    there = model.template.U @ present.astype(float) > 0.5
    back = study["registration"][name]["template_triangle"].values
    kept = there[model.template.full.T[back]].sum(1) >= 2  # (n_original,)
    pose = pose_of(model, registered)
    part = part_of(*cut(X, T, kept))
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

    there = errors(low, np.flatnonzero(again & present))
    missing = np.flatnonzero(~again & ~present)
    if not len(missing) or model.area @ again < LEAST_SHARE:
        return Found(there, errors(low, missing[:0]), fit.residual)
    known = posterior.know(
        fields, model.template.low.Phi, model.X, model.area, again, scale=model.scale
    )
    told = tell(rest, known, low, density)
    deviation = np.sqrt((told.spread[:, missing] ** 2).sum(0) + known.rest)
    return Found(there, errors(told.image, missing, deviation), fit.residual)
