"""New shapes in a finished study, which stays as it is (4.2, 6.1): read, placed, registered."""

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
from s4a.input.collection import shape_report
from s4a.input.files import SUFFIXES as MESHES
from s4a.input.files import files_named, suffix_of
from s4a.input.landmarks import SUFFIXES
from s4a.input.plausibility import find_warnings
from s4a.input.subjects import listed
from s4a.method.initial_map import transform_onto
from s4a.method.latent import out_of_sample_latent
from s4a.method.pca import project_scores
from s4a.method.refined_eigenfunctions import low_resolution
from s4a.method.register import from_latent
from s4a.method.shape import Shape
from s4a.method.steps import Study, latent_bases, out_of_sample_basis_in
from s4a.options import Options, with_options
from s4a.schema import check_type, dataset, in_unit, require, unit_of, variable
from s4a.study.processes import workers
from s4a.study.sources import find_sources, guides_of_shape
from s4a.study.tasks import clean_shape
from s4a.study.tree import left_out, stack_registration, template_mesh

log = logging.getLogger(__name__)


class Frozen(NamedTuple):
    """What new shapes need of a study: the template, and its network, the template first.

    Of a study in files, meshes and latent bases are read where a new shape needs them.
    """

    template: Shape
    nodes: Study  # coarse meshes, latent bases, and rotations onto the template
    names: list[str]


class Inserted(NamedTuple):
    """What is made of one new shape."""

    coarse: xr.Dataset
    Y: np.ndarray  # (k, m), latent basis
    registration: xr.Dataset
    look: xr.Dataset | None  # None where it was not compared


def insert(
    study: xr.DataTree,
    shapes: Path | str | list[Any] | dict[str, Any] | xr.Dataset,
    *,
    landmarks: Path | str | None = None,
    reflect: str | list[str] | None = None,
    compare: bool = True,
    n_jobs: int | None = None,
) -> xr.DataTree:
    """New shapes placed into a finished study, which stays as it is, with its options.

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
    landmarks : path, optional
        Folder with a file of landmarks for some or all of them, see :func:`s4a.analyse`.
    reflect : str or list of str, optional
        New shapes to mirror, as ``reflect=`` of :func:`s4a.analyse` did it: their names, with
        commas between them, or ``"auto"``, those of the other hand than the shapes of the study as
        they are in it.  Without it none is mirrored, and `compare` tells those of the other hand.
    compare : bool
        Whether each new shape is compared with those of the study: unit, mean_chirality, pose,
        genus, as :func:`s4a.read_shapes` does it; what looks wrong is named in ``/report`` and left
        as it is.
    n_jobs : int, optional
        As in joblib; the result does not depend on it.

    Returns
    -------
    DataTree
        As a study of the new shapes alone: ``/original``, ``/coarse``, ``/registration`` to the
        frozen template with ``confidence(shape, vertex)``; in ``/latent`` ``latent_basis(shape,
        mode, latent)``, shape differences and ``distance_to_limit(shape)``; in ``/pca``
        ``score(shape, component)`` on the frozen modes, these, and ``reconstruction_error(shape)``;
        ``/report``.  ``/original`` has the template's mesh too, so that labels can be transferred.

    Raises
    ------
    ValueError
        When the study is not finished, no shape can be used, one has the name of the template, or
        `reflect` names none of them.

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
    options = Options.from_report(study)
    template = study["registration"].attrs["template"]
    meshes, attrs = read_new(shapes, options, landmarks)
    if template in meshes:
        raise ValueError(f"new shapes need other names than the template, {template!r}; rename it")
    descriptors = descriptors_of(study) if compare or reflect == AUTO else {}
    mirrored, told = reflected_of_new(reflect, meshes, list(attrs), descriptors)
    for name in mirrored:
        meshes[name] = mirror_image(meshes[name])
        attrs[name] = attrs[name] | meshes[name].attrs
    frozen = freeze(study, options)
    references = descriptors if compare else None
    # in a tuple: a Dataset of its own is kept by one worker of dask, and is lost with that
    results = workers(n_jobs)(
        delayed(insert_one)((mesh,), frozen, options, references) for mesh in meshes.values()
    )
    inserted = {}
    for name, result in zip(meshes, results, strict=True):
        if isinstance(result, ValueError):
            attrs[name] = attrs[name] | {"status": "excluded", "reason": str(result)}
        else:
            inserted[name] = result
    if not inserted:
        reasons = "; ".join(f"{name}: {said['reason']}" for name, said in attrs.items())
        raise ValueError(f"no shape can be inserted ({reasons})")

    nodes = {f"original/{name}": meshes[name] for name in inserted}
    nodes[f"original/{template}"] = frozen.template.original
    nodes |= {f"coarse/{name}": one.coarse for name, one in inserted.items()}
    nodes["latent"] = out_of_sample_latent(
        np.stack([one.Y for one in inserted.values()]),
        np.stack([one.coarse["eigenvalue"].values for one in inserted.values()]),
        study["latent"].dataset["latent_eigenvalue"].values,
        options.norm,
    ).assign_coords(shape=list(inserted))
    nodes |= stack_registration(
        template_mesh(frozen.template.original, template),
        {name: one.registration for name, one in inserted.items()},
        list(inserted),
    )
    if "pca" in study:
        area = vertex_areas(*as_arrays(nodes["registration"]))
        nodes["pca"] = scores_of_new(study["pca"].to_dataset(), nodes["registration"], area)
    if references is None:
        nodes["report"] = shape_report(attrs)
    else:
        looks = {name: one.look for name, one in inserted.items() if one.look is not None}
        nodes["report"] = report_beside(study, attrs, looks, references)
    report = nodes["report"].attrs
    report["remarks"] = "\n".join(filter(None, [*told, report["remarks"]]))
    # all that were given are in the result
    report.update(with_options(report, {"include_flagged": True}))
    if reflect is not None:
        nodes["report"]["reflected"] = variable("reflected", [name in mirrored for name in attrs])
    return xr.DataTree.from_dict(nodes)


def reflected_of_new(
    reflect: str | list[str] | None,
    meshes: dict[str, xr.Dataset],
    given: list[str],
    descriptors: dict[str, xr.Dataset],
) -> tuple[list[str], list[str]]:
    """The new shapes whose mirror images are taken, and what is told of the choice.

    Parameters
    ----------
    reflect : see :func:`insert`
    meshes : dict of str to Dataset
        The new ones that can be used.
    given : list of str
        Names of all.
    descriptors : dict of str to Dataset
        Of shapes of the study, see :func:`descriptors_of`.
    """
    if reflect is None:
        return [], []
    if reflect == AUTO:
        known, looks = compare_chirality(meshes, descriptors)
        said = {name: is_mirrored(name, look, known) for name, look in looks.items()}
        told = [line for _, line in said.values() if line]
        for line in told:
            log.warning("%s", line)
        return [name for name, (is_other, _) in said.items() if is_other], told
    names = reflect.split(",") if isinstance(reflect, str) else reflect
    names = [str(name).strip() for name in names]
    unknown = [repr(name) for name in names if name not in given]
    if unknown:
        raise ValueError(
            f"reflect names {listed(unknown)}, none of the new shapes ({listed(given)}); "
            "'auto' mirrors those of the other hand than the study's"
        )
    return [name for name in names if name in meshes], []


def compare_chirality(
    meshes: dict[str, xr.Dataset], descriptors: dict[str, xr.Dataset]
) -> tuple[dict[str, xr.Dataset], dict[str, xr.Dataset]]:
    """:func:`s4a.input.plausibility.compare` of shapes of the study, and of new ones."""
    known = {
        name: plausibility.compare(name, seen, descriptors) for name, seen in descriptors.items()
    }
    looks = {
        name: plausibility.compare(
            "", plausibility.describe(mesh, intersections=False), descriptors
        )
        for name, mesh in meshes.items()
    }
    return known, looks


def read_new(
    shapes: Path | str | list[Any] | dict[str, Any],
    options: Options,
    landmarks: Path | str | None = None,
) -> tuple[dict[str, xr.Dataset], dict[str, dict[str, Any]]]:
    """The new meshes that can be used, with what guides them, and attributes for the report."""
    volumes = options.label is not None and (isinstance(shapes, dict) or not are_meshes(shapes))
    sources = find_sources(shapes, volumes=volumes)
    cleaning = options.of("cleaning")
    if options.label is not None and not volumes:  # meshes beside a study of label volumes
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


def are_meshes(paths: Path | str | list[Any]) -> bool:
    """Whether all of these are files that are named as meshes."""
    files = [paths] if isinstance(paths, str | Path) else paths
    return all(Path(file).is_file() and suffix_of(file) in MESHES for file in files)


def freeze(study: xr.DataTree, options: Options) -> Frozen:
    """What new shapes need of a study, the template first.

    Shapes that failed, and those that the study leaves out as flagged, are not among them.
    """
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


def insert_one(
    meshes: tuple[xr.Dataset],
    frozen: Frozen,
    options: Options,
    references: dict[str, xr.Dataset] | None,
) -> Inserted | ValueError:
    """One new shape: coarse mesh, latent basis, registration, plausibility; or why there is none.

    An error is given back and not raised, as it costs this shape alone.
    """
    try:
        with threadpool_limits(1):
            return _insert_one(*meshes, frozen, options, references)
    except ValueError as error:
        return error


def _insert_one(mesh, frozen, options, references):
    template, study, names = frozen
    (of_template,) = latent_bases(study, names[0])
    k = len(of_template)
    coarse = low_resolution(mesh, **options.of("low resolution") | {"k": k})
    if coarse.sizes["eigenpair"] < k:
        raise ValueError(
            f"the study needs {k} eigenfunctions, this shape has only {coarse.sizes['eigenpair']}"
        )
    shape = Shape(mesh, coarse, **options.of("projection"))
    R, t = transform_onto(shape.low, template.low)
    turn = study["registration"]["rotation"]  # onto the template
    Y = out_of_sample_basis_in(
        study,
        names,
        Shape(coarse=coarse).low,
        lambda name: (turn.sel(shape=name).values.T @ R, np.zeros(3)),
        k_init=min(options.k_init, k),
        step=options.step,
        **options.of("initial maps"),
    )
    settings = {"dense_match": options.dense_match, **options.of("registration")}
    registration = from_latent(shape, template, (Y, of_template), (R, t), **settings)
    seen = None
    if references is not None:
        descriptor = plausibility.describe(mesh, intersections=can_count(options.intersections))
        seen = plausibility.compare("", descriptor, references)
    return Inserted(coarse, Y, registration, seen)


def known_to(study: xr.DataTree) -> dict[str, dict[Any, Any]]:
    """Attributes of the registered shapes of a study that are in its modes."""
    doubted = left_out(study)
    names = study["registration"].dataset["shape"].values.tolist()
    return {name: study["original"][name].attrs for name in names if name not in doubted}


def descriptors_of(study: xr.DataTree) -> dict[str, xr.Dataset]:
    """Portraits of the shapes of a study beside which new ones are seen."""
    descriptors = {}
    known = known_to(study)
    by_size = sorted(known, key=lambda name: known[name]["area"])
    for name in plausibility.evenly_chosen(by_size, 2 * plausibility.N_REFERENCES):
        mesh = study["original"][name].to_dataset()
        seen = plausibility.describe(mesh, intersections=False)
        if "report" in study:  # where they were counted
            number = int(study["report"]["self_intersections"].sel(shape=name))
            share = number / mesh.sizes["triangle"] if number >= 0 else -1.0
            seen = seen.assign_attrs(self_intersections=number, intersecting=share)
        descriptors[name] = seen
    return {name: descriptors[name] for name in plausibility.pick_references(descriptors)}


def report_beside(
    study: xr.DataTree,
    attrs: dict[str, Any],
    looks: dict[str, xr.Dataset],
    references: dict[str, xr.Dataset],
) -> xr.Dataset:
    """The report on the new shapes, each beside those of the study."""
    known = known_to(study)
    known_looks = {
        name: plausibility.compare(name, seen, references) for name, seen in references.items()
    }
    reported_before = find_warnings(known, known_looks)[1]
    reports, remarks = [], {}
    for name, said in attrs.items():
        if name not in looks:  # it could not be used
            reports.append(shape_report({name: said}))
            continue
        flags, told = find_warnings(known | {name: said}, known_looks | {name: looks[name]})
        reports.append(shape_report({name: said}, flags, comparisons={name: looks[name]}))
        remarks |= dict.fromkeys(line for line in told if line not in reported_before)
    return xr.concat(reports, dim="shape").assign_attrs(remarks="\n".join(remarks))


def scores_of_new(modes: xr.Dataset, registration: xr.Dataset, area: np.ndarray) -> xr.Dataset:
    """The frozen modes, with the scores of the new shapes in place of those that made them."""
    score, left = project_scores(
        registration["displacement"].values,
        modes["mean_displacement"].values,
        modes["deformation"].values,
        modes["standard_deviation"].values,
        area,
    )
    new = in_unit(dataset(score=score, reconstruction_error=left), unit_of(modes["deformation"]))
    frozen = modes.drop_vars(
        ["score", "shape", "score_excluded", "shape_excluded"], errors="ignore"
    )
    return frozen.merge(new).assign_coords(shape=registration["shape"])
