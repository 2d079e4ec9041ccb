"""Out-of-sample shapes (4.2, 6.1): insert new shapes into a finished study."""

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from joblib import delayed
from threadpoolctl import threadpool_limits

from s4a.geometry.crossing import can_count
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input import plausibility
from s4a.input.chirality import AUTO, is_mirrored, mirror_image
from s4a.input.collection import remarks_on_files, shape_report
from s4a.input.coordinates import CoordinateSystem, in_axes, with_system
from s4a.input.files import SUFFIXES as MESHES
from s4a.input.files import files_named, suffix_of
from s4a.input.landmarks import SUFFIXES, unpaired
from s4a.input.plausibility import Flag, find_warnings
from s4a.input.subjects import listed
from s4a.method.alignment import N_VOTERS, align_onto, less_confident
from s4a.method.latent import out_of_sample_latent
from s4a.method.pca import project_scores
from s4a.method.refined_eigenfunctions import low_resolution
from s4a.method.register import from_latent
from s4a.method.shape import Shape
from s4a.method.steps import Study, basis_in, latent_bases, out_of_sample_basis_in
from s4a.options import Options, with_options
from s4a.schema import POSE, check_type, dataset, in_unit, require, unit_of, variable
from s4a.study.processes import workers
from s4a.study.sources import find_sources, guides_of_shape
from s4a.study.tasks import clean_shape
from s4a.study.tree import left_out, stack_registration, template_mesh

log = logging.getLogger(__name__)


class Frozen(NamedTuple):
    """Template and network of a study; meshes and latent bases are read when they are used."""

    template: Shape
    nodes: Study  # coarse meshes, latent bases, and rotations onto the template
    names: list[str]  # the template first


class Inserted(NamedTuple):
    """Results for one new shape."""

    coarse: xr.Dataset
    Y: np.ndarray  # (k, m), latent basis
    registration: xr.Dataset
    comparison: xr.Dataset | None  # None if not compared
    ambiguity: str  # message on equally good poses


def insert(
    study: xr.DataTree,
    shapes: Path | str | list[Any] | dict[str, Any] | xr.Dataset,
    *,
    landmarks: Path | str | None = None,
    reflect: str | list[str] | None = None,
    coordinate_system: str | None = None,
    unit: str | None = None,
    compare: bool = True,
    n_jobs: int | None = None,
) -> xr.DataTree:
    """Insert new shapes into a finished study, which is not changed.

    Each new shape is remeshed, aligned, and mapped to the template and to the five shapes of the
    study with the most similar spectra.  The latent basis of the new shape solves eq. 3 with
    their bases fixed.  The shape is then registered to the template, and the displacement is
    projected onto the modes of variation of the study.  The result for a shape does not depend on
    the other new shapes.

    Parameters
    ----------
    study : DataTree
        A finished study, from :func:`s4a.analyse` or :func:`s4a.open_study`.
    shapes : path, list of paths, dict or Dataset
        The new shapes, in any form that :func:`s4a.read_shapes` accepts.  A single mesh Dataset is
        named ``new``.
    landmarks : path, optional
        Folder with landmark files, named as the shapes.  By default no landmarks are used.
    reflect : str or list of str, optional
        Names of new shapes to mirror, separated by commas.  ``"auto"`` mirrors the shapes whose
        chirality is opposite to that of the study.  By default no shape is mirrored.
    coordinate_system, unit : str, optional
        For files that state none; by default as in the options of the study.  New shapes are
        converted to the system of the study.
    compare : bool
        Compare each new shape with the study in unit, chirality, form and genus, and warn about
        suspect ones in ``/report``.
    n_jobs : int, optional
        Number of parallel processes, as in joblib: -1 for all cores, None for one.  The result does
        not depend on it.

    Returns
    -------
    DataTree
        A study of the new shapes, with the nodes

        - ``/original``: clean meshes of the new shapes and of the template;
        - ``/coarse``: their low-resolution meshes;
        - ``/registration``: registrations to the template, with ``confidence(shape, vertex)``;
        - ``/latent``: ``latent_basis(shape, eigenpair, latent)``, the shape differences and
          ``distance_to_limit(shape)``;
        - ``/pca``: the modes of the study, with ``score(shape, component)`` and
          ``reconstruction_error(shape)`` of the new shapes;
        - ``/report``: status and warnings of each new shape.

    Raises
    ------
    ValueError
        If the study is not finished, no shape can be used, one has the name of the template,
        `reflect` names a shape that is not given, or axes or unit are known of some shapes only.

    See Also
    --------
    analyse : Analyse a collection.
    register_pairs : Register a template to each shape without a network.

    Examples
    --------
    >>> import numpy as np
    >>> import s4a
    >>> brains = s4a.synthetic.brains(4, 1500)["original"]
    >>> brains = {name: mesh.to_dataset() for name, mesh in brains.children.items()}
    >>> last = brains.pop("brain_04")
    >>> study = s4a.analyse(brains, n_coarse=300, k_init=8, k=12)
    >>> s4a.insert(study, {"brain_04": last})["pca"]["score"].sizes["component"]
    2
    >>> both = [study["pca"], s4a.insert(study, {"brain_04": last})["pca"]]
    >>> names = [str(name) for pca in both for name in pca["shape"].values]
    >>> score = np.concatenate([pca["score"].values for pca in both])
    >>> s4a.show.charts.scores(score, names, highlight=names.index("brain_04"))
    <Figure ...>
    """
    check_type(study, xr.DataTree)
    shapes = {"new": shapes} if isinstance(shapes, xr.Dataset) else shapes
    needed = ("original", "coarse", "latent", "registration")
    missing = [name for name in needed if name not in study.children]
    if missing:
        raise ValueError(f"a finished study is needed; this one lacks {', '.join(missing)}")
    named = {"coordinate_system": coordinate_system, "unit": unit}
    options = Options.from_report(study).changed({k: v for k, v in named.items() if v is not None})
    template = study["registration"].attrs["template"]
    meshes, attrs = read_new(shapes, options, landmarks)
    system = with_system(
        study["original"][template].to_dataset(), options.coordinate_system, options.unit
    )
    for name, mesh in meshes.items():
        meshes[name] = in_axes(mesh, CoordinateSystem.of(system.attrs), name)
        attrs[name] |= meshes[name].attrs
    if template in meshes:
        raise ValueError(f"new shapes need other names than the template, {template!r}; rename it")
    descriptors = descriptors_of(study) if compare or reflect == AUTO else {}
    mirrored, remarks = _reflected_of_new(reflect, meshes, list(attrs), descriptors)
    of_template = study["original"][template].dataset.get("guide_name", xr.DataArray([]))
    remarks = unpaired(meshes, of_template.values.tolist()) + remarks
    for name in mirrored:
        meshes[name] = mirror_image(meshes[name])
        attrs[name] = attrs[name] | meshes[name].attrs
    frozen = _freeze(study, options)
    references = descriptors if compare else None
    # in a tuple: dask keeps a bare Dataset on one worker, and loses it with that worker
    results = workers(n_jobs)(
        delayed(_insert_one)((mesh,), frozen, options, references) for mesh in meshes.values()
    )
    inserted = {}
    for name, result in zip(meshes, results, strict=True):
        if isinstance(result, ValueError):
            attrs[name] = attrs[name] | {"status": "excluded", "reason": str(result)}
        else:
            inserted[name] = result
    if not inserted:
        reasons = "; ".join(f"{name}: {values['reason']}" for name, values in attrs.items())
        raise ValueError(f"no shape can be inserted ({reasons})")

    nodes = {f"original/{name}": meshes[name] for name in inserted}
    nodes[f"original/{template}"] = frozen.template.original
    nodes |= {f"coarse/{name}": result.coarse for name, result in inserted.items()}
    nodes["latent"] = out_of_sample_latent(
        np.stack([result.Y for result in inserted.values()]),
        np.stack([result.coarse["eigenvalue"].values for result in inserted.values()]),
        study["latent"].dataset["latent_eigenvalue"].values,
        options.norm,
    ).assign_coords(shape=list(inserted))
    nodes |= stack_registration(
        template_mesh(frozen.template.original, template),
        {name: result.registration for name, result in inserted.items()},
        list(inserted),
    )
    if "pca" in study:
        area = vertex_areas(*as_arrays(nodes["registration"]))
        nodes["pca"] = scores_of_new(study["pca"].to_dataset(), nodes["registration"], area)
    flags = {n: [Flag(POSE, r.ambiguity, True)] for n, r in inserted.items() if r.ambiguity}
    if references is None:
        nodes["report"] = shape_report(attrs, flags)
    else:
        compared = {name: r.comparison for name, r in inserted.items() if r.comparison is not None}
        nodes["report"] = _report_on_new(study, attrs, compared, references, flags)
    report = nodes["report"].attrs
    report["remarks"] = "\n".join(filter(None, [*remarks, report["remarks"]]))
    # flagged shapes are in the result too
    report.update(with_options(report, {"include_flagged": True}))
    if reflect is not None:
        nodes["report"]["reflected"] = variable("reflected", [name in mirrored for name in attrs])
    return xr.DataTree.from_dict(nodes)


def _reflected_of_new(reflect, meshes, given, descriptors):
    """Choose the new shapes to mirror; return their names, and remarks.

    Parameters
    ----------
    reflect : see :func:`insert`
    meshes : dict of str to Dataset
        The usable new shapes.
    given : list of str
        Names of all new shapes.
    descriptors : dict of str to Dataset
        See :func:`descriptors_of`.
    """
    if reflect is None:
        return [], []
    if reflect == AUTO:
        in_study, new = compare_chirality(meshes, descriptors)
        decided = {name: is_mirrored(name, data, in_study) for name, data in new.items()}
        remarks = [remark for _, remark in decided.values() if remark]
        for remark in remarks:
            log.warning("%s", remark)
        return [name for name, (is_other, _) in decided.items() if is_other], remarks
    names = reflect.split(",") if isinstance(reflect, str) else reflect
    names = [str(name).strip() for name in names]
    unknown = [repr(name) for name in names if name not in given]
    if unknown:
        raise ValueError(
            f"reflect={reflect!r}: {listed(unknown)} is not a new shape ({listed(given)}); "
            "'auto' mirrors new shapes with the opposite chirality"
        )
    return [name for name in names if name in meshes], []


def compare_chirality(
    meshes: dict[str, xr.Dataset], descriptors: dict[str, xr.Dataset]
) -> tuple[dict[str, xr.Dataset], dict[str, xr.Dataset]]:
    """Compare shapes of the study, and new ones, with the `descriptors` of the study."""
    in_study = {
        name: plausibility.compare(name, data, descriptors) for name, data in descriptors.items()
    }
    new = {
        name: plausibility.compare(
            "", plausibility.describe(mesh, intersections=False), descriptors
        )
        for name, mesh in meshes.items()
    }
    return in_study, new


def read_new(
    shapes: Path | str | list[Any] | dict[str, Any],
    options: Options,
    landmarks: Path | str | None = None,
) -> tuple[dict[str, xr.Dataset], dict[str, dict[str, Any]]]:
    """Read the usable new meshes, with landmarks and fields, and attributes for the report."""
    volumes = options.label is not None and (isinstance(shapes, dict) or not _are_meshes(shapes))
    sources = find_sources(shapes, volumes=volumes)
    for remark in remarks_on_files(shapes, volumes=volumes):
        log.warning("%s", remark)
    cleaning = options.of("cleaning")
    if options.label is not None and not volumes:  # meshes for a study of label volumes
        cleaning = cleaning | {"label": None}
    files = {} if landmarks is None else files_named(landmarks, sources, "landmarks", SUFFIXES)
    meshes: dict[str, xr.Dataset] = {}
    attrs: dict[str, dict[str, Any]] = {}
    for name, (source, content) in sources.items():
        path = source if isinstance(source, str) else source.attrs.get("path", "")
        try:
            guides = guides_of_shape(path, files.get(name), options.feature_names)
            mesh = clean_shape(source, content, cleaning, {"guides": guides})
            meshes[name], attrs[name] = mesh, {"path": path} | mesh.attrs
        except ValueError as error:
            attrs[name] = {"status": "excluded", "reason": str(error), "path": path}
    return meshes, attrs


def _are_meshes(paths):
    """Return whether all paths are files with the suffix of a mesh format."""
    files = [paths] if isinstance(paths, str | Path) else paths
    return all(Path(file).is_file() and suffix_of(file) in MESHES for file in files)


def _freeze(study, options):
    """Collect template and network of a study, without failed and excluded shapes."""
    latent = study["latent"].to_dataset()
    require(latent, "latent_basis", "latent_eigenvalue", what="latent dataset")
    rotation = study["registration"].dataset["rotation"]
    template = study["registration"].attrs["template"]
    registered = set(rotation["shape"].values.tolist()) - set(left_out(study))
    others = [n for n in latent["shape"].values.tolist() if n in registered and n != template]
    names = [template, *others]
    nodes = {f"coarse/{name}": study["coarse"][name].to_dataset() for name in names}
    nodes[f"coarse/{template}"].load()
    nodes["latent"] = latent[["latent_basis"]].sel(shape=names)
    nodes["registration"] = rotation.sel(shape=names).to_dataset().load()
    original = study["original"][template].to_dataset().load()
    shape = Shape(original, nodes[f"coarse/{template}"], **options.of("projection"))
    return Frozen(shape, Study(xr.DataTree.from_dict(nodes)), names)


def _insert_one(meshes, frozen, options, references):
    """Insert one new shape; a ValueError is returned, as it concerns this shape only."""
    try:
        with threadpool_limits(1):
            return _inserted(meshes[0], frozen, options, references)
    except ValueError as error:
        return error


def _inserted(mesh, frozen, options, references):
    template, study, names = frozen
    (of_template,) = latent_bases(study, names[0])
    k = len(of_template)
    coarse = low_resolution(mesh, **options.of("low resolution") | {"k": k})
    if coarse.sizes["eigenpair"] < k:
        raise ValueError(
            f"{k} eigenfunctions needed, as in the study; this shape has only "
            f"{coarse.sizes['eigenpair']}: give a finer mesh"
        )
    shape = Shape(mesh, coarse, **options.of("projection"))
    rotation = study["registration"]["rotation"]  # onto the template
    voters = {
        name: (basis_in(study, name), (rotation.sel(shape=name).values, np.zeros(3)))
        for name in names[1 : N_VOTERS + 1]
    }
    aligned = align_onto(shape.low, template.low, options.alignment, voters)
    R, t = aligned.transform
    Y = out_of_sample_basis_in(
        study,
        names,
        Shape(coarse=coarse).low,
        lambda name: (rotation.sel(shape=name).values.T @ R, np.zeros(3)),
        k_init=min(options.k_init, k),
        step=options.step,
        **options.of("initial maps"),
    )
    settings = {"dense_match": options.dense_match, **options.of("registration")}
    registration = from_latent(shape, template, (Y, of_template), (R, t), **settings)
    registration = less_confident(registration, len(aligned.fits))
    comparison = None
    if references is not None:
        descriptor = plausibility.describe(mesh, intersections=can_count(options.intersections))
        comparison = plausibility.compare("", descriptor, references)
    return Inserted(coarse, Y, registration, comparison, aligned.ambiguity)


def _attributes_of(study):
    """Return the attributes of the shapes of a study that are not excluded."""
    excluded = left_out(study)
    names = study["registration"].dataset["shape"].values.tolist()
    return {name: study["original"][name].attrs for name in names if name not in excluded}


def descriptors_of(study: xr.DataTree) -> dict[str, xr.Dataset]:
    """Return the descriptors of the references of a study."""
    descriptors = {}
    attrs = _attributes_of(study)
    by_size = sorted(attrs, key=lambda name: attrs[name]["area"])
    for name in plausibility.evenly_chosen(by_size, 2 * plausibility.N_REFERENCES):
        mesh = study["original"][name].to_dataset()
        descriptor = plausibility.describe(mesh, intersections=False)
        if "report" in study:  # they were counted before
            number = int(study["report"]["self_intersections"].sel(shape=name))
            share = number / mesh.sizes["triangle"] if number >= 0 else -1.0
            descriptor = descriptor.assign_attrs(self_intersections=number, intersecting=share)
        descriptors[name] = descriptor
    return {name: descriptors[name] for name in plausibility.pick_references(descriptors)}


def _report_on_new(study, attrs, comparisons, references, on_poses):
    """Make the report on the new shapes, each compared with those of the study."""
    in_study = _attributes_of(study)
    compared = {name: plausibility.compare(name, d, references) for name, d in references.items()}
    reported_before = find_warnings(in_study, compared)[1]
    reports, remarks = [], {}
    for name, values in attrs.items():
        if name not in comparisons:  # the shape is excluded
            reports.append(shape_report({name: values}))
            continue
        new = {name: comparisons[name]}
        flags, lines = find_warnings(in_study | {name: values}, compared | new)
        flags[name] += on_poses.get(name, [])
        reports.append(shape_report({name: values}, flags, comparisons=new))
        remarks |= dict.fromkeys(line for line in lines if line not in reported_before)
    return xr.concat(reports, dim="shape").assign_attrs(remarks="\n".join(remarks))


def scores_of_new(modes: xr.Dataset, registration: xr.Dataset, area: np.ndarray) -> xr.Dataset:
    """Replace the scores of ``/pca`` by those of new shapes, on the same modes."""
    score, error = project_scores(
        registration["displacement"].values,
        modes["mean_displacement"].values,
        modes["deformation"].values,
        modes["standard_deviation"].values,
        area,
    )
    new = in_unit(dataset(score=score, reconstruction_error=error), unit_of(modes["deformation"]))
    rest = modes.drop_vars(["score", "shape", "score_excluded", "shape_excluded"], errors="ignore")
    return rest.merge(new).assign_coords(shape=registration["shape"])
