"""Shape model of a study at low resolution, matched to a partial shape (6.1).

:mod:`s4a_morphometrics.completion` finds the pose of the partial shape,
:mod:`s4a_morphometrics.calibration` calibrates the uncertainty of its completion.
"""

from typing import NamedTuple

import numpy as np
import xarray as xr

from s4a.analysis.inputs import registration_of
from s4a.method.pca import low_vertices
from s4a.method.shape import Shape
from s4a.options import Options
from s4a_morphometrics import posterior
from s4a_morphometrics.part import Fit, Part, Whole, on_boundary, present_vertices, refine

LEAST_SHARE = 0.15  # smallest share of the template in a partial shape
N_ITERATIONS = 2  # of detecting present vertices and matching them


class Model(NamedTuple):
    """Shape model of a study at the low resolution of its template, of unit area."""

    study: xr.DataTree
    template: Shape
    at: np.ndarray  # (n_low,), original vertices of the coarse ones
    X: np.ndarray  # (n_low, 3), of the template
    fields: np.ndarray  # (s, n_low, 3), displacements
    modes: np.ndarray  # (c, s), weights of the fields in each mode
    area: np.ndarray  # (n_low,), sums to 1
    scale: bool
    mean_full: np.ndarray  # (n, 3), mean displacement at full resolution
    modes_full: np.ndarray  # (c, n, 3)


def model_of(study: xr.DataTree) -> Model:
    """Return the shape model of a study; raise ValueError if the study lacks a part of it."""
    needed = "original", "coarse", "latent", "registration", "pca"
    missing = [name for name in needed if name not in study.children]
    if missing:
        raise ValueError(f"a finished study is needed; this one lacks {', '.join(missing)}")
    options = Options.from_report(study)
    if options.method == "scalable":
        raise ValueError("partial shapes need a coarse mesh; method='scalable' has none")
    registration = registration_of(study)
    if registration.sizes["shape"] < 4:
        raise ValueError(
            f"partial shapes need a study of at least 4 shapes; found {registration.sizes['shape']}"
        )
    name = registration.attrs["template"]
    template = Shape(
        study["original"][name].to_dataset().load(),
        study["coarse"][name].to_dataset().load(),
        **options.of("projection"),
    )
    _, size = template.frame
    at = low_vertices(template.coarse)
    fields = registration["displacement"][:, at].values.astype(float) / size
    modes = study["pca"].to_dataset()
    score = modes["score"].sel(shape=registration["shape"].values).values  # (s, c)
    return Model(
        study,
        template,
        at,
        template.full.X[at],
        fields,
        score.T / (len(score) - 1),
        template.low.area,
        options.remove_size,
        modes["mean_displacement"].values / size,
        modes["deformation"].values / size,
    )


def whole_of(model: Model) -> Whole:
    """Return the mean shape and the modes of a study at low resolution."""
    mean = model.fields.mean(0)
    modes = np.einsum("cs,snx->cnx", model.modes, model.fields - mean)
    T = model.template.low.T
    return Whole(model.X + mean, T, modes, on_boundary(T, len(model.X)))


def match(part: Part, model: Model, whole: Whole, fit: Fit) -> tuple[np.ndarray, np.ndarray, Fit]:
    """Match the coarse template to a partial shape, and find the vertices that are present.

    Returns
    -------
    low : float ndarray (n_low, 3)
        In the frame of the template, after the pose of the fit.
    present : bool ndarray (n_low,)
    fit : Fit
    """
    low = whole.X + np.tensordot(fit.b, whole.modes, 1)
    placed = fit.pose(part.X)
    limit = max(0.02, 3 * fit.residual)
    for _ in range(N_ITERATIONS):
        normals = model.template.low_on_surface.normals_at(low)
        present = present_vertices(low, normals, part, placed, limit)
        if model.area @ present < LEAST_SHARE:
            return low, present, fit
        low = refine(part, placed, model.template, low, present)
    normals = model.template.low_on_surface.normals_at(low)
    return low, present & present_vertices(low, normals, part, placed, limit), fit


class Completion(NamedTuple):
    """Posterior distribution of a shape at low resolution, in the frame of the template.

    ``weights`` of the ``columns (p, n_low, 3)``; ``deviation (r, n_low, 3)``, independent fields of
    one standard deviation each; and the mean ``image (n_low, 3)``, which interpolates the matches.
    """

    weights: posterior.Posterior
    columns: np.ndarray
    deviation: np.ndarray
    image: np.ndarray


def complete_low(
    model: Model, known: posterior.Known, low: np.ndarray, density: float
) -> Completion:
    """Return the posterior of a shape, given its present vertices in `low` ``(n_low, 3)``."""
    target, present = model.template, known.present
    mean = model.X + model.fields.mean(0)
    weights = posterior.weights_of(known, model.modes)
    y = (low - mean)[present]
    inner = np.einsum("qnx,nx,n->q", known.columns[:, present], y, model.area[present])
    posterior_weights = posterior.condition(known, weights, inner, density)
    columns = np.einsum("qp,qnx->pnx", weights, known.columns, optimize=True)
    deviation = np.einsum("pr,pnx->rnx", posterior_weights.root, columns, optimize=True)
    expected = mean + np.tensordot(posterior_weights.mean, columns, 1)
    kappa2 = float(target.low.eigenvalue[-1])
    residual = posterior.extend(low - expected, present, target.W, model.area, kappa2)
    return Completion(posterior_weights, columns, deviation, expected + residual)
