"""Calibration (6.1): how sure what is told of a part is, by the same part of other shapes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from s4a.analysis.inputs import registration_of
from s4a.analysis.partial import LEAST_SHARE, Model, match, tell, whole_of
from s4a.geometry.mesh import as_arrays
from s4a.method import posterior
from s4a.method.part import Pose, cut, fit_modes, part_of
from s4a.method.pca import gram

N_REMATCHED = 12  # shapes of the study whose part is matched again


class Again(NamedTuple):
    """What the same part of shapes of the study says, see :func:`match_again`."""

    noise: float
    factor: float
    residual: float


def match_again(model: Model, present: np.ndarray, density: float) -> Again:
    """How well the same part of shapes of the study is found and completed by the others.

    The part is cut out of up to :data:`N_REMATCHED` of them, matched by the model of the others,
    completed, and compared with the match of the whole shape.  Nine tenths of all coordinates lie
    within the intervals of 90 %: where the part is of the variance ``noise``, where nothing is of
    the deviations of the distribution times ``factor``, which errors of the pose and of the match
    widen.  And ``residual``, the largest of their fits.
    """
    registration = registration_of(model.study)
    names = registration["shape"].values.tolist()
    others = [i for i, name in enumerate(names) if name != registration.attrs["template"]]
    chosen = others[:: max(1, -(-len(others) // N_REMATCHED))]
    found = [_found_again(model, registration.isel(shape=i), i, present, density) for i in chosen]
    found = [one for one in found if one is not None]
    if not found:
        return Again(0.0, 1.0, np.inf)
    gaps, ratios, residuals = zip(*found, strict=True)
    return Again(deviation_of(gaps) ** 2, deviation_of(ratios), max(residuals))


def deviation_of(errors: Sequence[np.ndarray]) -> float:
    """The standard deviation with whose interval of 90 % nine tenths of all errors agree.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.analysis.calibration import deviation_of
    >>> round(deviation_of([np.full(9, 1.6449), np.array([8.0])]), 2)
    1.39
    """
    every = np.concatenate(errors)
    return float(np.quantile(every, 0.9)) / posterior.WITHIN_90 if len(every) else 0.0


def _found_again(model, registered, i, present, density):
    """Of shape i completed from its part by the others.

    Differences ``(d,)`` from the match of the whole where the part is, those beside their
    deviations ``(e,)`` where nothing is, and the residual; None where hardly anything is left.
    """
    study, name = model.study, registered["shape"].item()
    mesh = study["original"][name].to_dataset().load()
    X, T = as_arrays(mesh)
    there = model.template.U @ present.astype(float) > 0.5
    back = study["registration"][name]["template_triangle"].values
    kept = there[model.template.full.T[back]].sum(1) >= 2  # (n_original,)
    center, size = model.template.frame
    s = registered["scale"].item() / size
    pose = Pose(registered["rotation"].values, registered["translation"].values / size, s)
    pose = pose._replace(t=pose.t - center / size)
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
        return np.abs(pose(in_file) - model.X - model.fields[i])

    gap = error(low)[again & present].ravel()
    missing = ~again & ~present
    if not missing.any() or model.area @ again < LEAST_SHARE:
        return gap, np.zeros(0), fit.residual
    known = posterior.know(
        fields, model.template.low.Phi, model.X, model.area, again, scale=model.scale
    )
    told = tell(rest, known, low, density)
    deviation = np.sqrt((told.spread[:, missing] ** 2).sum(0) + known.rest)
    return gap, (error(told.image)[missing] / deviation).ravel(), fit.residual
