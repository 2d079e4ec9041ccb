"""What a study says of a part (6.1): its model at low resolution, the part's match, and the rest.

How the part is found stands in :mod:`s4a_morphometrics.completion`, how sure the rest is in
:mod:`s4a_morphometrics.calibration`.
"""

from typing import NamedTuple

import numpy as np
import xarray as xr

from s4a.analysis.inputs import registration_of
from s4a.method.pca import low_vertices
from s4a.method.shape import Shape
from s4a.options import Options
from s4a_morphometrics import posterior
from s4a_morphometrics.part import Fit, Part, Whole, on_boundary, refine, seen

LEAST_SHARE = 0.15  # of the template that a part must have
N_ITERATIONS = 2  # of finding what is there, and of matching it


class Model(NamedTuple):
    """A study at the low resolution of its template, lengths for unit area."""

    study: xr.DataTree
    template: Shape
    at: np.ndarray  # (n_low,), original vertices
    X: np.ndarray  # (n_low, 3), of the template
    fields: np.ndarray  # (s, n_low, 3), displacements
    modes: np.ndarray  # (c, s), each as weights of the fields
    area: np.ndarray  # (n_low,), of sum 1
    scale: bool
    mean_full: np.ndarray  # (n, 3), mean displacement at full resolution
    modes_full: np.ndarray  # (c, n, 3)


def model_of(study: xr.DataTree) -> Model:
    """What completion needs of a study; ValueError where it has it not."""
    needed = "original", "coarse", "latent", "registration", "pca"
    missing = [name for name in needed if name not in study.children]
    if missing:
        raise ValueError(f"a finished study is needed; this one lacks {', '.join(missing)}")
    options = Options.from_report(study)
    if options.method == "scalable":
        raise ValueError("parts need a study with a coarse mesh; method='scalable' has none")
    registration = registration_of(study)
    if registration.sizes["shape"] < 4:
        raise ValueError(
            f"parts need a study of at least 4 shapes, found {registration.sizes['shape']}"
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
    """The mean shape and the modes of a study at low resolution."""
    mean = model.fields.mean(0)
    modes = np.einsum("cs,snx->cnx", model.modes, model.fields - mean)
    T = model.template.low.T
    return Whole(model.X + mean, T, modes, on_boundary(T, len(model.X)))


def match(part: Part, model: Model, whole: Whole, fit: Fit) -> tuple[np.ndarray, np.ndarray, Fit]:
    """The template's low resolution on the part, and which of its vertices are there.

    Returns
    -------
    low : float ndarray (n_low, 3)
        In the frame of the template, as the part is placed by the fit.
    present : bool ndarray (n_low,)
    fit : Fit
    """
    low = whole.X + np.tensordot(fit.b, whole.modes, 1)
    placed = fit.pose(part.X)
    limit = max(0.02, 3 * fit.residual)
    for _ in range(N_ITERATIONS):
        normals = model.template.low_on_surface.normals_at(low)
        present = seen(low, normals, part, placed, limit)
        if model.area @ present < LEAST_SHARE:
            return low, present, fit
        low = refine(part, placed, model.template, low, present)
    normals = model.template.low_on_surface.normals_at(low)
    return low, present & seen(low, normals, part, placed, limit), fit


class Told(NamedTuple):
    """What is reported of a shape at low resolution, in the frame of the template.

    ``weights`` of the ``columns (p, n_low, 3)``, ``spread (r, n_low, 3)``, the fields that they may
    differ by, independent and of one standard deviation each, and ``image (n_low, 3)``, which goes
    through the matches where there are any.
    """

    weights: posterior.Posterior
    columns: np.ndarray
    spread: np.ndarray
    image: np.ndarray


def tell(model: Model, known: posterior.Known, low: np.ndarray, density: float) -> Told:
    """The distribution of a shape whose vertices `low` ``(n_low, 3)`` are known where present."""
    target, present = model.template, known.present
    mean = model.X + model.fields.mean(0)
    weights = posterior.weights_of(known, model.modes)
    y = (low - mean)[present]
    inner = np.einsum("qnx,nx,n->q", known.columns[:, present], y, model.area[present])
    found = posterior.condition(known, weights, inner, density)
    columns = np.einsum("qp,qnx->pnx", weights, known.columns, optimize=True)
    spread = np.einsum("pr,pnx->rnx", found.root, columns, optimize=True)
    told = mean + np.tensordot(found.mean, columns, 1)
    kappa2 = float(target.low.eigenvalue[-1])
    left = posterior.extend(low - told, present, target.W, model.area, kappa2)
    return Told(found, columns, spread, told + left)
