"""Completion of partial shapes (6.1, outlook) by the shape model of a study.

:mod:`s4a_morphometrics.part` matches the partial shape, :mod:`s4a_morphometrics.posterior` and
:mod:`s4a_morphometrics.partial` compute the distribution of the missing region, and
:mod:`s4a_morphometrics.calibration` calibrates its uncertainty.
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
from s4a.input.coordinates import CoordinateSystem, in_one_system
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
from s4a_morphometrics.calibration import calibrate_part
from s4a_morphometrics.part import (
    Fit,
    Part,
    Pose,
    Whole,
    best_fit,
    distinct,
    fit_modes,
    part_of,
    present_vertices,
    rough_poses,
)
from s4a_morphometrics.partial import LEAST_SHARE, Model, complete_low, match, model_of, whole_of

log = logging.getLogger(__name__)

TESTED_SHARE = 0.45  # smallest present share for which the intervals were validated
LEAST_INSIDE = 0.6  # smallest share of the partial shape on the complete one
LARGEST_AREA = 4.0  # of a partial shape, relative to the template
SURELY_INSIDE = 0.95  # below this share, more rotations are tried
FOREIGN = 1.4  # residual, relative to the largest of a shape of the study
N_AGAIN = 48  # initialisations if the modes do not fit


def complete(
    study: xr.DataTree,
    part: Path | str | tuple[Any, Any] | xr.Dataset,
    *,
    landmarks: Path | str | None = None,
    components: str | int | None = None,
    coordinate_system: str | None = None,
    unit: str | None = None,
    n_samples: int = 10,
    seed: int = 0,
    rng: RNG | None = None,
) -> xr.Dataset:
    """Match a partial shape to a finished study, and complete it by the shape model.

    The missing region is detected.  In the present region the completed shape follows the partial
    shape; elsewhere it is the posterior mean given the partial shape (posterior shape model, see
    :mod:`s4a_morphometrics.posterior`).  The standard deviations are calibrated by leave-one-out:
    shapes of the study are cut in the same way, matched and completed by the others, and 90 % of
    their coordinates lie within intervals of 90 %.  The uncertainty of the study's own
    correspondences is added, estimated from direct matches between shapes and matches through the
    template (see :mod:`s4a_morphometrics.calibration`).  The intervals hold for shapes of the same
    population.  They do not include errors that all matches have in common.

    Parameters
    ----------
    study : DataTree
        From :func:`s4a.analyse` or :func:`s4a.open_study`, with modes; not changed.
    part : path, tuple (points, triangles) or Dataset
        A mesh in any pose; a complete shape is a partial shape with no missing region.
    landmarks : path, optional
        Landmarks of the mesh.  Three or more with names of the template's landmarks fix the pose.
    components : "largest" or int, optional
        Connected components to keep, see :func:`s4a.clean`; by default as in the study.
    coordinate_system, unit : str, optional
        Of a part or landmarks that state none, see :mod:`s4a.input.coordinates`.
    n_samples : int
        Number of random shapes from the distribution.
    seed, rng : see :mod:`s4a.seeds`

    Returns
    -------
    Dataset
        A mesh with the template's triangles: ``position(vertex, xyz)`` in the pose of the file,
        in the axes and unit of the study; ``present(vertex)``, ``completion_sd(vertex, xyz)`` and
        ``completion_normal_sd(vertex)``, ``sample_position(sample, vertex, xyz)``;
        ``score(component)``, ``score_covariance(component, component_2)``; and, as in
        ``/registration``, ``displacement``, ``rotation``, ``translation`` and ``scale``.
        Attributes: ``template``; ``missing``, share of the template's area; ``residual``, distance
        between the fitted modes and the partial shape; ``usual_residual``, its largest value for
        shapes of the study in leave-one-out; ``inside``, share of the points on the complete shape;
        ``match_noise``, standard deviation of a coordinate in the present region; for the missing
        region the ``factor`` of the posterior deviations, ``added``, the standard deviation added
        from ``between_paths``, that between the two paths of matching; ``left_out_error``, root
        mean square error of a coordinate in leave-one-out; ``warning``.

    Raises
    ------
    ValueError
        If the study has no modes, or the mesh cannot be read, is in an unknown coordinate system
        although that of the study is known, has less than 15 % of the template or
        does not fit the shapes.

    See Also
    --------
    s4a.insert : adds complete shapes to a study.

    References
    ----------
    T. Albrecht, M. Luethi, T. Gerig and T. Vetter (2013), Posterior shape models, Medical Image
    Analysis 17(8).

    Examples
    --------
    The upper half of a brain of a small study:

    >>> import s4a
    >>> import s4a_morphometrics
    >>> study = s4a.synthetic.example_study()
    >>> mesh = study["original/brain_02"].to_dataset()
    >>> corners = mesh["position"].values[mesh["corner_vertex"].values]
    >>> upper = mesh["corner_vertex"].values[corners[:, :, 2].min(1) > 0]
    >>> found = s4a_morphometrics.complete(study, (mesh["position"].values, upper))
    >>> 0.4 < found.attrs["missing"] < 0.6
    True

    The complete brain, and the completed one with its standard deviation:

    >>> shown = {"the shape": mesh, "completed, with its deviation": found}
    >>> deviation = {"completed, with its deviation": found["completion_normal_sd"].values}
    >>> s4a.show.charts.surfaces(shown, deviation, label="mm")
    <TiledFigure ...>
    """
    check_count("n_samples", n_samples)
    model = model_of(study)
    system = {"coordinate_system": coordinate_system, "unit": unit}
    mesh = read_part(study, part, landmarks, components=components, **system)
    partial = part_of(*as_arrays(mesh))
    usual = usual_pose(study, model)
    fit, whole = fit_part(partial, model, usual, mesh)
    check_fit(fit, partial)
    low, present, fit = match(partial, model, whole, fit)
    share = float(model.area @ present)
    if share < LEAST_SHARE:
        raise ValueError(
            f"a partial shape needs at least {100 * LEAST_SHARE:.0f} % of the template's area; "
            f"found {100 * share:.1f} %"
        )
    known = posterior.know(
        model.fields, model.template.low.Phi, model.X, model.area, present, scale=model.scale
    )
    generator = np.random.default_rng(seed_of(seed, rng))
    result = completed(model, partial, fit, known, low, n_samples, generator)
    template = model.template.original
    result = in_unit(result, common_unit(template, mesh))
    result.attrs |= CoordinateSystem.of(mesh.attrs).attrs
    result.attrs["template"] = study["registration"].attrs["template"]
    result.attrs["warning"] = "; ".join(warnings_of(result))
    if result.attrs["warning"]:
        log.warning("%s", result.attrs["warning"])
    return result


def read_part(
    study: xr.DataTree,
    part: Path | str | tuple[Any, Any] | xr.Dataset,
    landmarks: Path | str | None = None,
    **given: Any,
) -> xr.Dataset:
    """Read and clean a partial shape, in the axes and unit of the study; its holes stay open."""
    given = {name: value for name, value in given.items() if value is not None}
    options = Options.from_report(study).changed({"close_holes": False} | given)
    if isinstance(part, str | Path) and not Path(part).exists():
        raise ValueError(f"{shown(part)}: no such file")
    meshes, attrs = read_new(part if isinstance(part, str | Path) else {"part": part}, options)
    if len(meshes) != 1:
        reasons = [f"{name}: {a['reason']}" for name, a in attrs.items() if name not in meshes]
        raise ValueError(
            f"one partial shape is needed; found {len(meshes)}: "
            f"{', '.join(meshes)}{'; '.join(reasons)}"
        )
    (mesh,) = meshes.values()
    if landmarks is not None:
        given.pop("components", None)
        mesh = with_landmarks(mesh, landmarks, **given)
    template = study["original"][study["registration"].attrs["template"]].to_dataset()
    return in_one_system({"template": template, "part": mesh})["part"]


def usual_pose(study: xr.DataTree, model: Model) -> Pose:
    """Return the mean pose of the shapes of a study in their files."""
    registration = registration_of(study)
    U, S, Vt = np.linalg.svd(registration["rotation"].values.mean(0))
    R = (U * [1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt if S[-1] > 0.5 else np.eye(3)
    s = float(np.exp(np.log(registration["scale"].values).mean()))
    center, size = model.template.frame
    t = registration["translation"].values.mean(0)
    return Pose(R, (t - center) / size, s / size)


def fit_part(
    part: Part, model: Model, usual: Pose, mesh: xr.Dataset | None = None
) -> tuple[Fit, Whole]:
    """Fit a partial shape to the shape model of a study at low resolution."""
    whole = whole_of(model)
    pose = None if mesh is None else pose_of_landmarks(mesh, model, whole.X, usual)
    if pose is not None:
        return fit_modes(part, whole, pose, free_size=model.scale), whole
    poses = distinct(rough_poses(part, whole, usual), usual, part)
    fit = best_fit(part, whole, poses, usual, model.scale)
    if fit.residual > FOREIGN * largest_residual(model) or fit.inside < SURELY_INSIDE:
        # an unusual pose, or another kind of shape: try more rotations
        results = rough_poses(part, whole, usual, rotations="I")
        poses = [fit.pose, *distinct(results, usual, part, N_AGAIN)]
        fit = best_fit(part, whole, poses, usual, model.scale)
    return fit, whole


def largest_residual(model: Model) -> float:
    """Return the largest leave-one-out residual of a shape along the normals, for unit area."""
    fields = model.fields - model.fields.mean(0)
    weights = posterior.residual_weights(gram(fields, model.area))
    residual = np.einsum("st,tnx->snx", weights, fields, optimize=True)
    off = normal_displacement(residual, vertex_normals(model.X, model.template.low.T))
    return float(np.sqrt((off**2 @ model.area).max()))


def pose_of_landmarks(mesh: xr.Dataset, model: Model, mean: np.ndarray, usual: Pose) -> Pose | None:
    """Return the pose from three or more common landmarks, or None if there are fewer."""
    names, weights = model.template.landmarks
    given = mesh["guide_name"].values.tolist() if "guide_name" in mesh else []
    common = [name for name in names if name in given]
    if len(common) < 3:
        if given:
            log.warning("3 landmarks in common with the template are needed; found %d", len(common))
        return None
    P = mesh["guide_position"].values[[given.index(name) for name in common]]
    rows = weights[[names.index(name) for name in common]]
    shift = model.template.U @ (mean - model.X)
    Q = rows @ (model.template.full.X + shift)
    R, _, _ = rigid_transform(P, Q)
    return Pose(R, Q.mean(0) - usual.s * R @ P.mean(0), usual.s)


def check_fit(fit: Fit, part: Part) -> None:
    """Raise ValueError if a partial shape does not fit the shapes of the study."""
    area = fit.pose.s**2 * part.area.sum()  # relative to that of the template
    if fit.inside < LEAST_INSIDE or area > LARGEST_AREA:
        raise ValueError(
            f"the partial shape does not fit the study: {100 * fit.inside:.0f} % of it lies on "
            f"the best fit, and its area is {area:.2g} times that of the template. Is it another "
            "kind of shape, or in another unit? Three landmarks in common with the template fix "
            "its pose (landmarks=)"
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
    """Return the completed shape with its distribution, given the known coarse vertices."""
    target, present = model.template, known.present
    density, left_out_error = 1.0, 0.0
    if not present.all():
        density, left_out_error = posterior.best_density(known, ~present)
    calibration = calibrate_part(model, present, density)
    completion = complete_low(model, known, low, density)
    placed = _posterior_mean(model, completion)  # (n_full, 3)

    inflate = np.where(present, 1.0, calibration.factor)  # (n_low,)
    deviation = completion.deviation * inflate[:, None]
    missing_noise = calibration.added + calibration.factor**2 * known.rest
    white = np.where(present, calibration.noise, missing_noise)
    full = target.U @ _covariance(deviation, white).reshape(-1, 9)

    pose, size = fit.pose, 1 / fit.pose.s
    there = present_vertices(
        placed, vertex_normals(placed, target.full.T), part, pose(part.X), max(0.02, fit.residual)
    )
    position = size * (placed - pose.t) @ pose.R
    normals = vertex_normals(position, target.full.T)
    in_file = size**2 * np.einsum("xi,nxy,yj->nij", pose.R, full.reshape(-1, 3, 3), pose.R)
    low_samples = _low_samples(model, deviation, white, n_samples, rng)
    drawn = [position + size * (target.U @ moved) @ pose.R for moved in low_samples]
    area = vertex_areas(*as_arrays(target.original))
    X = target.original["position"].values
    d, R, t, s = displacement_in_template(X, position, area, scale=model.scale)
    c = len(model.modes)
    return dataset(
        {
            "missing": float(1 - area @ there / area.sum()),
            "residual": size * fit.residual,
            "usual_residual": size * calibration.residual,
            "inside": fit.inside,
            "factor": calibration.factor,
            "match_noise": size * float(np.sqrt(calibration.noise)),
            "between_paths": size * float(np.sqrt(calibration.paths)),
            "added": size * float(np.sqrt(calibration.added)),
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
        score=completion.weights.mean[:c],
        score_covariance=completion.weights.root[:c] @ completion.weights.root[:c].T,
        displacement=d.astype(np.float32),
        rotation=R,
        translation=t,
        scale=np.array(s),
    )


def _posterior_mean(model, completion):
    """Return the posterior mean ``(n_full, 3)``."""
    c = len(model.modes)
    b = completion.weights.mean[:c]
    exact = model.mean_full + np.tensordot(b, model.modes_full, 1)
    # the modes have detail at full resolution that U lacks
    coarse = np.tensordot(b, completion.columns[:c], 1)
    rest = completion.image - model.X - model.fields.mean(0) - coarse
    return model.template.full.X + exact + model.template.U @ rest


def _covariance(deviation, white):
    """Covariance of each vertex ``(n_low, 3, 3)``: of the fields, plus independent noise."""
    covariance = np.einsum("rnx,rny->nxy", deviation, deviation, optimize=True)
    covariance[:, range(3), range(3)] += white[:, None]
    return covariance


def _low_samples(model, deviation, white, n, rng):
    """Draw n samples ``(n_low, 3)`` from the posterior, relative to its mean."""
    target = model.template
    rough = posterior.rough_fields(target.W, model.area, float(target.low.eigenvalue[-1]))
    for _ in range(n):
        moved = np.tensordot(rng.standard_normal(len(deviation)), deviation, 1)
        yield moved + np.sqrt(white)[:, None] * rough(rng)


def warnings_of(result: xr.Dataset) -> list[str]:
    """Return warnings on a completed shape."""
    warnings = []
    ratio = result.attrs["residual"] / result.attrs["usual_residual"]
    if ratio > FOREIGN:
        warnings.append(
            f"the residual is {ratio:.1f} times the largest of a shape of the study: the partial "
            "shape may be another kind of shape, or its pose may be wrong; landmarks fix the pose"
        )
    score = result["score"].values
    p = float(stats.chi2.sf(score @ score, len(score)))
    if p < 1e-4:
        warnings.append(
            f"the Mahalanobis distance of the scores is {np.sqrt(score @ score):.1f}, where "
            f"{np.sqrt(len(score)):.1f} is usual: it may be another kind of shape"
        )
    if result.attrs["between_paths"] == 0:
        warnings.append(
            "the errors of the study's correspondences could not be estimated, which needs two "
            "shapes in the network besides the template: the intervals are too narrow"
        )
    if result.attrs["missing"] > 1 - TESTED_SHARE:
        missing = 100 * result.attrs["missing"]
        warnings.append(f"{missing:.0f} % are missing; the intervals were validated up to half")
    return warnings


def write_completed(found: xr.Dataset, folder: Path | str) -> list[Path]:
    """Write the result of :func:`s4a_morphometrics.complete`.

    Parameters
    ----------
    found : Dataset
    folder : path
        Created if missing.

    Returns
    -------
    list of Path
        ``completed.nc`` with everything, ``completed.ply`` with ``present`` and ``deviation``, the
        root of the summed variances, at every vertex, and ``sample_<i>.ply``.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_dataset(found, folder / "completed.nc")
    triangles, system = found["corner_vertex"].values, CoordinateSystem.of(found.attrs).attrs
    deviation = np.sqrt((found["completion_sd"].values ** 2).sum(1))
    write_mesh(
        folder / "completed.ply",
        found["position"].values,
        triangles,
        **system,
        present=found["present"].values.astype(float),
        deviation=deviation,
    )
    paths = [folder / "completed.nc", folder / "completed.ply"]
    for i, position in enumerate(found["sample_position"].values):
        paths.append(folder / f"sample_{i:02d}.ply")
        write_mesh(paths[-1], position, triangles, **system)
    return paths
