"""Calibration (6.1): how sure what is told of a part is, by the same part of other shapes.

Two things are measured, and their variances added:

1. How far what is told lies from the match of the whole: the part is cut out of shapes of the
   study, matched and completed by all others (:func:`match_again`).
2. How far that match lies from the truth.  All shapes of a study are matched to one template, and
   what these matches have in common no other shape of the study contradicts.  Another template
   does: the shapes are registered onto each other, too, and the way over the template is compared
   with the direct one (:func:`between_ways`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from s4a.analysis.inputs import registration_of
from s4a.analysis.partial import LEAST_SHARE, Model, match, tell, whole_of
from s4a.geometry.closest import interpolate
from s4a.geometry.mesh import as_arrays
from s4a.input.evidence import spread
from s4a.method import posterior
from s4a.method.first_map import motion_onto
from s4a.method.part import Pose, cut, fit_modes, part_of
from s4a.method.pca import gram
from s4a.method.register import from_latent
from s4a.study.options import Options

N_REMATCHED = 12  # shapes of the study whose part is matched again
N_WAYS = 6  # shapes of the study that are registered onto another


class Again(NamedTuple):
    """What the same part of shapes of the study says, see :func:`match_again`."""

    noise: float
    factor: float
    residual: float
    ways: float


def match_again(model: Model, present: np.ndarray, density: float) -> Again:
    """How well the same part of shapes of the study is found and completed by the others.

    The part is cut out of up to :data:`N_REMATCHED` of them, matched by the model of the others,
    completed, and compared with the match of the whole shape.  Nine tenths of all coordinates lie
    within the intervals of 90 %: where the part is of the variance ``noise``, where nothing is of
    the deviations of the distribution times ``factor``, which errors of the pose and of the match
    widen.  ``residual`` is the largest of their fits, and ``ways`` the variance of a coordinate
    that is to be added everywhere for what the matches of whole shapes get wrong, see
    :func:`between_ways`.
    """
    registration = registration_of(model.study)
    names = registration["shape"].values.tolist()
    others = [name for name in names if name != registration.attrs["template"]]
    chosen = [names.index(name) for name in spread(others, N_REMATCHED)]
    ways = between_ways(model) ** 2
    found = [_found_again(model, registration.isel(shape=i), i, present, density) for i in chosen]
    found = [one for one in found if one is not None]
    if not found:
        return Again(0.0, 1.0, np.inf, ways)
    gaps, ratios, residuals = zip(*found, strict=True)
    return Again(deviation_of(gaps) ** 2, deviation_of(ratios), max(residuals), ways)


def between_ways(model: Model) -> float:
    """The deviation of a coordinate between two ways of matching, for unit area.

    Up to :data:`N_WAYS` shapes are each registered onto another one of the study, by the latent
    bases of its network; the places at which the vertices of the other come to lie are compared
    with those to which the template takes them.  Three registrations have their part in it, and
    were their errors independent, a third of its variance would be that of one.  They are not:
    what surfaces mislead all registrations to closes every cycle, and is not seen.  That is why
    all of it is taken for the error of one.  The median over the shapes: one that is matched wrong
    does not speak for the others.

    Parameters
    ----------
    model : Model
        See :func:`s4a.analysis.partial.model_of`.
    """
    study = model.study
    registration = registration_of(study)
    names = registration["shape"].values.tolist()
    others = [name for name in names if name != registration.attrs["template"]]
    gaps = []
    for name in spread(others, N_WAYS):
        onto = others[(others.index(name) + len(others) // 2) % len(others)]
        gap = _way_over_template(model, name, onto) - _direct_way(study, name, onto)
        size = registration["scale"].sel(shape=name).item() / model.template.frame[1]
        gaps.append(deviation_of([size * np.abs(gap).ravel()]))
    return float(np.median(gaps))


def _way_over_template(model, name, onto):
    """Where the vertices of one shape lie on another in its file, both as the template has them."""
    image = image_of(registration_of(model.study).sel(shape=name))
    back = model.study["registration"][onto]
    triangle, share = back["template_triangle"].values, back["template_barycentric"].values
    return interpolate(image, model.template.full.T, triangle, share)


def _direct_way(study, name, onto):
    """The same when the one is the template of the other."""
    options = Options.from_report(study)
    source, target = (
        options.shape(study["original"][n].to_dataset().load(), study["coarse"][n].to_dataset())
        for n in (name, onto)
    )
    Y = study["latent"].to_dataset()["latent_basis"]
    bases = Y.sel(shape=name).values, Y.sel(shape=onto).values
    motion = motion_onto(source.low, target.low)
    direct = from_latent(source, target, bases, motion, how=options.how, **options.of_registration)
    return image_of(direct.assign(position=target.original["position"]))


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
