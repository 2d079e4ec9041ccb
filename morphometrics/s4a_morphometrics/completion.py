"""Partial shapes (6.1, outlook): a part matched where it is, and the whole that it may be of.

What the modes of a finished study say of the rest, see :mod:`s4a_morphometrics.partial` and
:mod:`s4a_morphometrics.posterior`; how the part is matched, see :mod:`s4a_morphometrics.part`;
how sure all of that is, see :mod:`s4a_morphometrics.calibration`.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy import stats

from s4a.analysis.export import write_dataset
from s4a.analysis.inputs import registration_of
from s4a.geometry.align import rigid_transform
from s4a.geometry.mesh import as_arrays, vertex_areas, vertex_normals
from s4a.input.files import write_mesh
from s4a.input.landmarks import with_landmarks
from s4a.input.raw import shown
from s4a.method.deform import displacement_in_template, normal_displacement
from s4a.method.pca import gram
from s4a.method.register import common_unit
from s4a.options import Options
from s4a.schema import check_count, dataset, in_unit
from s4a.seeds import RNG, seed_of
from s4a.study.insert import read_new
from s4a_morphometrics import posterior
from s4a_morphometrics.calibration import match_again
from s4a_morphometrics.part import (
    Fit,
    Part,
    Pose,
    Whole,
    best_fit,
    different,
    fit_modes,
    part_of,
    rough_starts,
    seen,
)
from s4a_morphometrics.partial import LEAST_SHARE, Model, match, model_of, tell, whole_of

log = logging.getLogger(__name__)

TESTED_SHARE = 0.45  # with less the intervals have not been tested
LEAST_INSIDE = 0.6  # share of the part that must lie on the whole
SURELY_INSIDE = 0.95  # with less every way is looked at once more
FOREIGN = 1.4  # times what the modes of the others leave of any shape of the study
N_AGAIN = 48  # starts of a part that the modes do not fit


def complete(
    study: xr.DataTree,
    part: Path | str | tuple[Any, Any] | xr.Dataset,
    *,
    landmarks: Path | str | None = None,
    components: str | int | None = None,
    n_samples: int = 10,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """A part of a shape matched to a finished study, and the whole that it may be of.

    What is missing is found.  Where the part is, the completed shape lies on it; elsewhere it is
    the mean of all shapes that agree with the part under the modes of the study and what these do
    not hold, a normal distribution (posterior shape model, Albrecht et al. 2013; the formula is in
    :mod:`s4a_morphometrics.posterior`).  Its standard deviations are such that nine tenths of what
    shapes of the study have there, each cut in the same way, matched and completed by all others,
    lie within intervals of 90 %, and wider by what two ways of matching the study's shapes differ,
    over the template and directly, as far as that is not in the former (see
    :mod:`s4a_morphometrics.calibration`).  The intervals are for shapes of the population of the
    study's; what surfaces mislead every match to is not in them.

    Parameters
    ----------
    study : DataTree
        Of :func:`s4a.analyse` or :func:`s4a.open_study`, with modes; it stays as it is.
    part : path, tuple (points, triangles) or Dataset
        A mesh, in any pose; whole shapes are parts without anything missing.
    landmarks : path, optional
        Its landmarks; three or more that the template has by name, too, say how it lies.
    components : "largest" or int, optional
        How many pieces of the part are taken, see :func:`s4a.clean`; as in the study by default.
    n_samples : int
        Shapes drawn from the distribution.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset
        A mesh with the template's triangles: ``position(vertex, xyz)`` where the part lies in its
        file, ``present(vertex)``, ``completion_sd(vertex, xyz)`` along the axes of the file and
        ``completion_normal_sd(vertex)``, ``sample_position(sample, vertex, xyz)``;
        ``score(component)``, ``score_covariance(component, component_2)``; and, as in
        ``/registration``, ``displacement``, ``rotation``, ``translation`` and ``scale``.
        Attributes: ``template``; ``missing``, share of the template's area; ``residual``, the
        distance that modes and transform leave on the part, ``usual_residual``, the largest that
        the modes of the others leave on the same part of a shape of the study, and ``inside``, the
        share of the part's points that lie on the whole; ``match_noise``, the deviation of a
        coordinate where the part is; where nothing is ``factor`` of what the modes leave, and
        ``added``, the deviation that comes to it of ``between_ways``, that between two ways of
        matching; and ``left_out_error``, the root mean square error of a coordinate with which the
        study's own shapes are reported by the others there; ``warning``.

    Raises
    ------
    ValueError
        When the study has no modes, the part cannot be read, it has less than 15 % of the template,
        or lies nowhere on its shapes.

    Examples
    --------
    With the ``study`` of six small brains; of one of these the upper half:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> mesh = study["original/brain_02"].to_dataset()
    >>> corners = mesh["position"].values[mesh["corner_vertex"].values]
    >>> upper = mesh["corner_vertex"].values[corners[:, :, 2].min(1) > 0]
    >>> found = s4a_morphometrics.complete(study, (mesh["position"].values, upper))
    >>> 0.4 < found.attrs["missing"] < 0.6
    True

    The shape of which the upper half was given, and how sure each place of it is:

    >>> shown = {"the shape": mesh, "completed, with its deviation": found}
    >>> sure = {"completed, with its deviation": found["completion_normal_sd"].values}
    >>> s4a.show.charts.surfaces(shown, sure, label="mm")
    <TiledFigure ...>
    """
    check_count("n_samples", n_samples)
    model = model_of(study)
    mesh = read_part(study, part, components, landmarks)
    pieces = part_of(*as_arrays(mesh))
    first = first_pose(study, model)
    fit, whole = place(pieces, model, first, mesh)
    check_place(fit, model)
    low, present, fit = match(pieces, model, whole, fit)
    share = float(model.area @ present)
    if share < LEAST_SHARE:
        raise ValueError(
            f"a part with at least {100 * LEAST_SHARE:.0f} % of the template's area is needed, "
            f"found {100 * share:.1f} %"
        )
    known = posterior.know(
        model.fields, model.template.low.Phi, model.X, model.area, present, scale=model.scale
    )
    generator = np.random.default_rng(seed_of(seed, rng))
    result = completed(model, pieces, fit, known, low, n_samples, generator)
    template = model.template.original
    result = in_unit(result, common_unit(template, mesh))
    result.attrs["template"] = study["registration"].attrs["template"]
    result.attrs["warning"] = "; ".join(warnings_of(result))
    if result.attrs["warning"]:
        log.warning("%s", result.attrs["warning"])
    return result


def read_part(
    study: xr.DataTree,
    part: Path | str | tuple[Any, Any] | xr.Dataset,
    components: str | int | None = None,
    landmarks: Path | str | None = None,
) -> xr.Dataset:
    """The clean mesh of a part: its holes stay open."""
    given = {"close_holes": False} | ({} if components is None else {"components": components})
    options = Options.from_report(study).changed(given)
    if isinstance(part, str | Path) and not Path(part).exists():
        raise ValueError(f"{shown(part)}: there is no such file")
    meshes, attrs = read_new(part if isinstance(part, str | Path) else {"part": part}, options)
    if len(meshes) != 1:
        reasons = [f"{name}: {one['reason']}" for name, one in attrs.items() if name not in meshes]
        raise ValueError(
            f"one part needed, found {len(meshes)}: {', '.join(meshes)}{'; '.join(reasons)}"
        )
    (mesh,) = meshes.values()
    return mesh if landmarks is None else with_landmarks(mesh, landmarks)


def first_pose(study: xr.DataTree, model: Model) -> Pose:
    """How the shapes of the study lie in their files, on average."""
    registration = registration_of(study)
    U, S, Vt = np.linalg.svd(registration["rotation"].values.mean(0))
    R = (U * [1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt if S[-1] > 0.5 else np.eye(3)
    s = float(np.exp(np.log(registration["scale"].values).mean()))
    center, size = model.template.frame
    t = registration["translation"].values.mean(0)
    return Pose(R, (t - center) / size, s / size)


def place(
    part: Part, model: Model, first: Pose, mesh: xr.Dataset | None = None
) -> tuple[Fit, Whole]:
    """Where a part lies on the shapes of a study, and these at low resolution."""
    whole = whole_of(model)
    pose = None if mesh is None else pose_of_landmarks(mesh, model, whole.X, first)
    if pose is not None:
        return fit_modes(part, whole, pose, free_size=model.scale), whole
    starts = different(rough_starts(part, whole, first), first, part)
    fit = best_fit(part, whole, starts, first, model.scale)
    if fit.residual > FOREIGN * left_by_others(model) or fit.inside < SURELY_INSIDE:
        # it lies another way, or is of another kind: every way is looked at once more
        ends = rough_starts(part, whole, first, turns="I")
        starts = [fit.pose, *different(ends, first, part, N_AGAIN)]
        fit = best_fit(part, whole, starts, first, model.scale)
    return fit, whole


def left_by_others(model: Model) -> float:
    """The root mean square along the normals that the modes of the others leave of a shape at most.

    Of a whole shape in its place, for unit area.
    """
    fields = model.fields - model.fields.mean(0)
    weights = posterior.residual_weights(gram(fields, model.area))
    left = np.einsum("st,tnx->snx", weights, fields, optimize=True)
    off = normal_displacement(left, vertex_normals(model.X, model.template.low.T))
    return float(np.sqrt((off**2 @ model.area).max()))


def pose_of_landmarks(mesh: xr.Dataset, model: Model, mean: np.ndarray, first: Pose) -> Pose | None:
    """The transform of three or more landmarks that part and template have by name, if they do."""
    names, weights = model.template.landmarks
    own = mesh["guide_name"].values.tolist() if "guide_name" in mesh else []
    common = [name for name in names if name in own]
    if len(common) < 3:
        if own:
            log.warning("part and template have %d landmarks in common: 3 needed", len(common))
        return None
    P = mesh["guide_position"].values[[own.index(name) for name in common]]
    rows = weights[[names.index(name) for name in common]]
    shift = model.template.U @ (mean - model.X)
    Q = rows @ (model.template.full.X + shift)
    R, _, _ = rigid_transform(P, Q)
    return Pose(R, Q.mean(0) - first.s * R @ P.mean(0), first.s)


def check_place(fit: Fit, model: Model) -> None:
    """ValueError where a part does not lie on the shapes of the study."""
    if fit.inside < LEAST_INSIDE:
        raise ValueError(
            f"the part does not fit the shapes of the study: only {100 * fit.inside:.0f} % of it "
            "lies on one that they may be; is it of another kind, or another unit? Three landmarks "
            "that the template has, too, say how it lies (landmarks=)"
        )


def completed(
    model: Model,
    part: Part,
    fit: Fit,
    known: posterior.Known,
    low: np.ndarray,
    n_samples: int,
    rng: np.random.Generator,
) -> xr.Dataset:
    """The distribution of the whole when its low resolution is known where it is present."""
    target, present = model.template, known.present
    density, left_out_error = 1.0, 0.0
    if not present.all():
        density, left_out_error = posterior.best_density(known, ~present)
    again = match_again(model, present, density)
    told = tell(model, known, low, density)
    placed = _most_likely(model, told)  # (n_full, 3)

    inflate = np.where(present, 1.0, again.factor)  # (n_low,)
    spread = told.spread * inflate[:, None]
    white = np.where(present, again.noise, again.added + again.factor**2 * known.rest)
    full = target.U @ _covariance(spread, white).reshape(-1, 9)

    pose, size = fit.pose, 1 / fit.pose.s
    there = seen(
        placed, vertex_normals(placed, target.full.T), part, pose(part.X), max(0.02, fit.residual)
    )
    position = size * (placed - pose.t) @ pose.R
    normals = vertex_normals(position, target.full.T)
    in_file = size**2 * np.einsum("xi,nxy,yj->nij", pose.R, full.reshape(-1, 3, 3), pose.R)
    low_samples = _low_samples(model, spread, white, n_samples, rng)
    drawn = [position + size * (target.U @ moved) @ pose.R for moved in low_samples]
    area = vertex_areas(*as_arrays(target.original))
    X = target.original["position"].values
    d, R, t, s = displacement_in_template(X, position, area, scale=model.scale)
    c = len(model.modes)
    return dataset(
        {
            "missing": float(1 - area @ there / area.sum()),
            "residual": size * fit.residual,
            "usual_residual": size * again.residual,
            "inside": fit.inside,
            "factor": again.factor,
            "match_noise": size * float(np.sqrt(again.noise)),
            "between_ways": size * float(np.sqrt(again.ways)),
            "added": size * float(np.sqrt(again.added)),
            "left_out_error": size * left_out_error,
        },
        position=position,
        corner_vertex=target.original["corner_vertex"].values,
        present=there,
        completion_sd=np.sqrt(np.einsum("nii->ni", in_file)).astype(np.float32),
        completion_normal_sd=np.sqrt(np.einsum("ni,nij,nj->n", normals, in_file, normals)).astype(
            np.float32
        ),
        sample_position=np.reshape(drawn, (n_samples, len(X), 3)).astype(np.float32),
        score=told.weights.mean[:c],
        score_covariance=told.weights.root[:c] @ told.weights.root[:c].T,
        displacement=d.astype(np.float32),
        rotation=R,
        translation=t,
        scale=np.array(s),
    )


def _most_likely(model, told):
    """The mean of the posterior ``(n_full, 3)``."""
    c = len(model.modes)
    b = told.weights.mean[:c]
    exact = model.mean_full + np.tensordot(b, model.modes_full, 1)
    # the modes have detail that U has not
    rest = told.image - model.X - model.fields.mean(0) - np.tensordot(b, told.columns[:c], 1)
    return model.template.full.X + exact + model.template.U @ rest


def _covariance(spread, white):
    """Of each vertex ``(n_low, 3, 3)``: of the fields and of what every vertex has alone."""
    covariance = np.einsum("rnx,rny->nxy", spread, spread, optimize=True)
    covariance[:, range(3), range(3)] += white[:, None]
    return covariance


def _low_samples(model, spread, white, n, rng):
    """Draws from the posterior about its mean, each ``(n_low, 3)``."""
    target = model.template
    rough = posterior.rough_fields(target.W, model.area, float(target.low.eigenvalue[-1]))
    for _ in range(n):
        moved = np.tensordot(rng.standard_normal(len(spread)), spread, 1)
        yield moved + np.sqrt(white)[:, None] * rough(rng)


def warnings_of(result: xr.Dataset) -> list[str]:
    """What looks wrong with a part."""
    said = []
    ratio = result.attrs["residual"] / result.attrs["usual_residual"]
    if ratio > FOREIGN:
        said.append(
            f"the modes leave {ratio:.1f} times as much of the part as of any shape of the study: "
            "it may be of another kind, or lie another way than was found, which landmarks say"
        )
    score = result["score"].values
    p = float(stats.chi2.sf(score @ score, len(score)))
    if p < 1e-4:
        said.append(
            f"the scores of the part lie {np.sqrt(score @ score):.1f} from the mean, where "
            f"{np.sqrt(len(score)):.1f} is usual: it may be of another kind"
        )
    if result.attrs["between_ways"] == 0:
        said.append(
            "how far matches of whole shapes are off could not be measured, which takes two shapes "
            "in the network beside the template: the intervals are too narrow by it"
        )
    if result.attrs["missing"] > 1 - TESTED_SHARE:
        missing = 100 * result.attrs["missing"]
        said.append(f"{missing:.0f} % are missing: the intervals are tested up to half")
    return said


def write_completed(found: xr.Dataset, folder: Path | str) -> list[Path]:
    """Write what :func:`s4a_morphometrics.complete` found.

    Parameters
    ----------
    found : Dataset
    folder : path
        Made where it is missing.

    Returns
    -------
    list of Path
        ``completed.nc`` with everything, ``completed.ply`` with ``present`` and ``deviation``, the
        root of the summed variances, at every vertex, and ``sample_<i>.ply``.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_dataset(found, folder / "completed.nc")
    triangles = found["corner_vertex"].values
    deviation = np.sqrt((found["completion_sd"].values ** 2).sum(1))
    write_mesh(
        folder / "completed.ply",
        found["position"].values,
        triangles,
        present=found["present"].values.astype(float),
        deviation=deviation,
    )
    paths = [folder / "completed.nc", folder / "completed.ply"]
    for i, position in enumerate(found["sample_position"].values):
        paths.append(folder / f"sample_{i:02d}.ply")
        write_mesh(paths[-1], position, triangles)
    return paths
