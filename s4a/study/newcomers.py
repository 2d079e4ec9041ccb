"""New shapes of one structure beside a finished study of it (4.2, 6.1): read, placed, registered.

See :func:`s4a.insert`, which also takes them into a study of several structures.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from joblib import delayed
from threadpoolctl import threadpool_limits

from s4a.geometry.crossing import can_count
from s4a.geometry.mesh import as_arrays, vertex_areas
from s4a.input import plausibility
from s4a.input.annotations import files_beside, with_features
from s4a.input.collection import read_shapes, shape_report
from s4a.input.files import SUFFIXES as MESHES
from s4a.input.files import files_named, suffix_of
from s4a.input.hands import AUTO, is_of_other_hand, mirror_image
from s4a.input.landmarks import SUFFIXES, with_landmarks
from s4a.input.plausibility import find_warnings
from s4a.input.subjects import listed
from s4a.method.first_map import motion_onto
from s4a.method.lift import low_resolution
from s4a.method.pca import project_scores
from s4a.method.place import latent_of_new, nearest_spectra, place
from s4a.method.register import from_latent
from s4a.method.shape import Shape
from s4a.options import Options, with_options
from s4a.schema import dataset, in_unit, require, unit_of, variable
from s4a.study.processes import workers
from s4a.study.tasks import guided
from s4a.study.tree import left_out, stack_registration, template_mesh

log = logging.getLogger(__name__)


class Frozen(NamedTuple):
    """The study that new shapes come into: the template, and its network, the template first.

    Of a study in files, meshes and latent bases are read where a new shape needs them.
    """

    template: Shape
    coarse: list[xr.Dataset]
    spectra: list[np.ndarray]  # their eigenvalues
    Y: xr.DataArray  # (n, k, m), latent bases
    turn: list[np.ndarray]  # rotations onto the template


class Inserted(NamedTuple):
    """What is made of one new shape."""

    coarse: xr.Dataset
    Y: np.ndarray  # (k, m), latent basis
    registration: xr.Dataset
    look: xr.Dataset | None  # None where it was not compared


class New(NamedTuple):
    """New shapes that were read, and those of the study that they are held against."""

    meshes: dict[str, xr.Dataset]  # clean, those that can be used
    attrs: dict[str, dict[str, Any]]  # of all, for the report
    options: Options  # of the study
    portraits: dict[str, xr.Dataset]  # of some shapes of the study, where they are needed


def insert_shapes(
    study: xr.DataTree,
    shapes: Path | str | list[Any] | dict[str, Any] | xr.Dataset,
    landmarks: Path | str | None,
    reflect: str | list[str] | None,
    compare: bool,
    n_jobs: int | None,
) -> xr.DataTree:
    """New shapes of one structure, see :func:`s4a.insert`."""
    shapes = {"new": shapes} if isinstance(shapes, xr.Dataset) else shapes
    new = read_beside(study, shapes, landmarks, seen=compare or reflect == AUTO)
    mirrored, told = reflected_of_new(reflect, new)
    chosen = None if reflect is None else mirrored
    return insert_meshes(study, new, chosen, told, compare, n_jobs)


def read_beside(
    study: xr.DataTree,
    shapes: Path | str | list[Any] | dict[str, Any],
    landmarks: Path | str | Mapping[str, Path] | None,
    *,
    seen: bool,
) -> New:
    """New shapes for a finished study, read and cleaned as it has been.

    Parameters
    ----------
    study : DataTree
    shapes, landmarks : see :func:`read_new`
    seen : bool
        Whether they are to be held against shapes of the study.
    """
    needed = ("original", "coarse", "latent", "registration")
    missing = [name for name in needed if name not in study.children]
    if missing:
        raise ValueError(f"a finished study is needed; this one lacks {', '.join(missing)}")
    options = Options.from_report(study)
    template = study["registration"].attrs["template"]
    meshes, attrs = read_new(shapes, options, landmarks)
    if template in meshes:
        raise ValueError(f"new shapes need other names than the template, {template!r}; rename it")
    return New(meshes, attrs, options, portraits_of(study) if seen else {})


def insert_meshes(
    study: xr.DataTree,
    new: New,
    mirrored: list[str] | None,
    told: list[str],
    compare: bool,
    n_jobs: int | None,
) -> xr.DataTree:
    """New shapes that were read, in the study of their structure.

    Parameters
    ----------
    study : DataTree
    new : New
    mirrored : list of str, optional
        Those whose mirror images are taken; None where nobody asked for any.
    told : list of str
        Of that choice, for the report.
    compare, n_jobs : see :func:`s4a.insert`
    """
    options, meshes, attrs = new.options, dict(new.meshes), dict(new.attrs)
    template = study["registration"].attrs["template"]
    frozen = freeze(study, options)
    references = new.portraits if compare else None
    taken = [name for name in mirrored or () if name in meshes]
    for name in taken:
        meshes[name] = mirror_image(meshes[name])
        attrs[name] = attrs[name] | meshes[name].attrs
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
    nodes["latent"] = latent_of_new(
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
    report.update(with_options(report, {"keep_doubtful": True}))
    if mirrored is not None:
        nodes["report"]["reflected"] = variable("reflected", [name in taken for name in attrs])
    return xr.DataTree.from_dict(nodes)


def reflected_of_new(reflect: str | list[str] | None, new: New) -> tuple[list[str], list[str]]:
    """The new shapes whose mirror images are taken, and what is told of the choice."""
    if reflect is None:
        return [], []
    if reflect == AUTO:
        known, looks = hands_beside(new)
        said = {name: is_of_other_hand(name, look, known) for name, look in looks.items()}
        told = [line for _, line in said.values() if line]
        for line in told:
            log.warning("%s", line)
        return [name for name, (is_other, _) in said.items() if is_other], told
    names = named(reflect)
    unknown = [repr(name) for name in names if name not in new.attrs]
    if unknown:
        raise ValueError(
            f"reflect names {listed(unknown)}, none of the new shapes ({listed(list(new.attrs))}); "
            "'auto' mirrors those of the other hand than the study's"
        )
    return [name for name in names if name in new.meshes], []


def named(reflect: str | list[str]) -> list[str]:
    """The names that ``reflect=`` lists."""
    names = reflect.split(",") if isinstance(reflect, str) else list(reflect)
    return [str(name).strip() for name in names]


def hands_beside(new: New) -> tuple[dict[str, xr.Dataset], dict[str, xr.Dataset]]:
    """:func:`s4a.input.plausibility.compare` of shapes of the study, and new ones beside them."""
    references = new.portraits
    known = {
        name: plausibility.compare(name, seen, references) for name, seen in references.items()
    }
    looks = {
        name: plausibility.compare("", plausibility.portray(mesh, intersections=False), references)
        for name, mesh in new.meshes.items()
    }
    return known, looks


def read_new(
    shapes: Path | str | list[Any] | dict[str, Any],
    options: Options,
    landmarks: Path | str | Mapping[str, Path] | None = None,
) -> tuple[dict[str, xr.Dataset], dict[str, dict[str, Any]]]:
    """The new meshes that can be used, with what guides them, and attributes for the report.

    Parameters
    ----------
    shapes : see :func:`s4a.insert`
    options : Options
        Of the study.
    landmarks : path or dict of str to path, optional
        A folder, or the files of shapes by name.
    """
    meshes, attrs = clean_new(shapes, options)
    files: Mapping[str, Path] = {}
    if isinstance(landmarks, Mapping):
        files = landmarks
    elif landmarks is not None:
        files = files_named(landmarks, meshes, "landmarks", SUFFIXES)
    for name, mesh in list(meshes.items()):
        try:
            source = shapes[name] if isinstance(shapes, dict) else None
            if isinstance(source, xr.Dataset) and "file_vertex" not in source:
                mesh = guided(mesh, source)
            if name in files:
                mesh = with_landmarks(mesh, files[name])
            path = mesh.attrs.get("path", "")
            fields = files_beside(path, options.feature_names) if path else {}
            meshes[name] = with_features(mesh, fields) if fields else mesh
        except ValueError as error:
            attrs[name] = attrs[name] | {"status": "excluded", "reason": str(error)}
            del meshes[name]
    return meshes, attrs


def clean_new(
    shapes: Path | str | list[Any] | dict[str, Any],
    options: Options,
) -> tuple[dict[str, xr.Dataset], dict[str, dict[str, Any]]]:
    """The new meshes that can be used, clean, and the attributes of all for the report."""
    meshes = {}
    if isinstance(shapes, dict):
        for name, mesh in shapes.items():
            if isinstance(mesh, xr.Dataset) and "file_vertex" in mesh:  # clean as it is
                meshes[name] = mesh
        shapes = {name: mesh for name, mesh in shapes.items() if name not in meshes}
    attrs = {name: {"status": "ok", "reason": ""} | mesh.attrs for name, mesh in meshes.items()}
    if isinstance(shapes, dict) and not shapes:
        return meshes, attrs
    cleaning = options.of("cleaning")
    if not isinstance(shapes, dict) and are_meshes(shapes):  # in a study of label volumes
        cleaning = cleaning | {"label": None}
    tree = read_shapes(shapes, compare=False, **cleaning)
    report = tree["report"].to_dataset()
    for name in report["shape"].values.tolist():
        if name in tree["original"].children:
            meshes[name] = tree[f"original/{name}"].to_dataset()
            attrs[name] = meshes[name].attrs
        else:
            row = report.sel(shape=name)
            attrs[name] = {column: row[column].item() for column in ("status", "reason", "path")}
    return meshes, attrs


def are_meshes(paths: Path | str | list[Any]) -> bool:
    """Whether all of these are files that are named as meshes."""
    files = [paths] if isinstance(paths, str | Path) else paths
    return all(Path(file).is_file() and suffix_of(file) in MESHES for file in files)


def freeze(study: xr.DataTree, options: Options) -> Frozen:
    """What new shapes need of a study, the template first.

    Shapes that failed, and those that the study leaves out as doubtful, are not among them.
    """
    latent = study["latent"].to_dataset()
    require(latent, "latent_basis", "latent_eigenvalue", what="latent dataset")
    rotation = study["registration"].dataset["rotation"]
    template = study["registration"].attrs["template"]
    registered = set(rotation["shape"].values.tolist()) - set(left_out(study))
    others = [n for n in latent["shape"].values.tolist() if n in registered and n != template]
    names = [template, *others]
    coarse = [study["coarse"][name].to_dataset() for name in names]
    return Frozen(
        Shape(
            study["original"][template].to_dataset().load(),
            coarse[0].load(),
            **options.of("projection"),
        ),
        coarse,
        [mesh["eigenvalue"].values for mesh in coarse],
        latent["latent_basis"].sel(shape=names),
        list(rotation.sel(shape=names).values),
    )


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
    _, k, _ = frozen.Y.shape
    coarse = low_resolution(mesh, **options.of("low resolution") | {"k": k})
    if coarse.sizes["mode"] < k:
        raise ValueError(
            f"the study needs {k} eigenfunctions, this shape has only {coarse.sizes['mode']}"
        )
    shape = Shape(mesh, coarse, **options.of("projection"))
    new = Shape(coarse=coarse).low
    template = frozen.template.low
    k_init = min(options.k_init, k)
    chosen = nearest_spectra(new.eigenvalue, frozen.spectra, k_init)
    R, t = motion_onto(shape.low, template)
    others = [Shape(coarse=frozen.coarse[j]).low for j in chosen]
    of_template, *of_others = frozen.Y[[0, *chosen]].values
    starts = [(frozen.turn[j].T @ R, np.zeros(3)) for j in chosen]
    Y = place(
        new,
        others,
        np.stack(of_others),
        starts,
        k_init=k_init,
        step=options.step,
        **options.of("first maps"),
    )
    registration = from_latent(
        shape,
        frozen.template,
        (Y, of_template),
        (R, t),
        how=options.how,
        **options.of("registration"),
    )
    seen = None
    if references is not None:
        portrait = plausibility.portray(mesh, intersections=can_count(options.intersections))
        seen = plausibility.compare("", portrait, references)
    return Inserted(coarse, Y, registration, seen)


def known_to(study: xr.DataTree) -> dict[str, dict[Any, Any]]:
    """Attributes of the registered shapes of a study that are in its modes."""
    doubted = left_out(study)
    names = study["registration"].dataset["shape"].values.tolist()
    return {name: study["original"][name].attrs for name in names if name not in doubted}


def portraits_of(study: xr.DataTree) -> dict[str, xr.Dataset]:
    """Portraits of the shapes of a study beside which new ones are seen."""
    portraits = {}
    known = known_to(study)
    by_size = sorted(known, key=lambda name: known[name]["area"])
    for name in plausibility.spread(by_size, 2 * plausibility.N_REFERENCES):
        mesh = study["original"][name].to_dataset()
        seen = plausibility.portray(mesh, intersections=False)
        if "report" in study:  # where they were counted
            number = int(study["report"]["self_intersections"].sel(shape=name))
            share = number / mesh.sizes["triangle"] if number >= 0 else -1.0
            seen = seen.assign_attrs(self_intersections=number, intersecting=share)
        portraits[name] = seen
    return {name: portraits[name] for name in plausibility.pick_references(portraits)}


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
    told_before = find_warnings(known, known_looks)[1]
    reports, remarks = [], {}
    for name, said in attrs.items():
        if name not in looks:  # it could not be used
            reports.append(shape_report({name: said}))
            continue
        doubts, told = find_warnings(known | {name: said}, known_looks | {name: looks[name]})
        reports.append(shape_report({name: said}, doubts, evidence={name: looks[name]}))
        remarks |= dict.fromkeys(line for line in told if line not in told_before)
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
    frozen = modes.drop_vars(["score", "shape", "score_apart", "shape_apart"], errors="ignore")
    return frozen.merge(new).assign_coords(shape=registration["shape"])
