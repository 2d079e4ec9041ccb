"""Functions of the tasks of a run (4): each computes one file of a study.

A task gets paths and names, reads the files of earlier tasks, and returns a Dataset.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from s4a.geometry.align import relative_transform
from s4a.geometry.mesh import as_arrays, triangle_areas
from s4a.input import plausibility
from s4a.input.annotations import labels_of_mesh, read_scalars, with_features
from s4a.input.chirality import mirror_image
from s4a.input.clean import check_range, clean
from s4a.input.collection import read_shape
from s4a.input.coordinates import CoordinateSystem, in_axes, with_system
from s4a.input.landmarks import guides_of, with_landmarks
from s4a.method import steps
from s4a.method.alignment import Voters, align_voted, alignment_residual, less_confident, voters_of
from s4a.method.latent import out_of_sample_latent
from s4a.method.network import spectral_distance
from s4a.method.refined_eigenfunctions import low_resolution
from s4a.method.shape import Basis, Shape, features_of
from s4a.options import Options
from s4a.schema import dataset, in_unit, unit_of
from s4a.study.netcdf import open_file, read
from s4a.study.runner import Run
from s4a.study.sources import Guides, content_of_file

NO_GUIDES = Guides(None, {})
OF_FILES = ("label", "coordinate_system", "unit")  # options of reading; others are of `clean`
last_template: dict[tuple[Any, ...], Shape] = {}  # at most one


def clean_shape(
    source: str | xr.Dataset, content: str, cleaning: dict[str, Any], also: dict[str, Any]
) -> xr.Dataset:
    """Read and clean a file, or clean a mesh in memory if necessary.

    `also` may have ``guides``, files of landmarks and fields with the keys of their contents,
    ``system``, attributes of the coordinate system to convert to, and ``reflected`` to mirror the
    shape.  Raises OSError if a file has changed since its key was computed.
    """
    mesh = cleaned(source, content, cleaning)
    system = {name: cleaning[name] for name in ("coordinate_system", "unit")}
    guides = also.get("guides", NO_GUIDES)
    if guides.landmarks is not None:
        file, key = guides.landmarks
        with unchanged(file, key):
            mesh = with_landmarks(mesh, file, **system)
    fields = {}
    for name, (file, key) in guides.features.items():
        with unchanged(file, key):
            fields[name] = read_scalars(file, name)
    if fields:
        mesh = with_features(mesh, fields)
    if "system" in also:
        mesh = in_axes(mesh, CoordinateSystem.of(also["system"]))
    return mirror_image(mesh) if "reflected" in also else mesh


@contextmanager
def unchanged(path: str, content: str) -> Iterator[None]:
    """Raise OSError at the end if a file no longer has the content of its key."""
    try:
        yield
    finally:
        if content_of_file(path) != content:
            raise OSError(f"{path} changed or disappeared since the run began: start it again")


def cleaned(source: str | xr.Dataset, content: str, cleaning: dict[str, Any]) -> xr.Dataset:
    """Read and clean a shape, without landmark files; a mesh in memory keeps its landmarks."""
    if isinstance(source, str):
        with unchanged(source, content):
            return read_shape(source, **cleaning)
    source = with_system(source, cleaning["coordinate_system"], cleaning["unit"])
    if "file_vertex" in source:
        check_range(*as_arrays(source))
        area = float(triangle_areas(*as_arrays(source)).sum())
        mesh = source.assign_attrs({"status": "ok", "reason": "", "area": area} | source.attrs)
    else:
        repair = {name: value for name, value in cleaning.items() if name not in OF_FILES}
        mesh = guided(clean(source, **repair), source)
    return in_unit(mesh, source.attrs.get("unit"))


def guided(mesh: xr.Dataset, source: xr.Dataset) -> xr.Dataset:
    """Transfer landmarks, fields and labels of a mesh in memory to the cleaned mesh."""
    if "guide_position" in source:  # triangles have changed
        mesh = with_landmarks(mesh, guides_of(source))
    if features_of(source):
        weight = source["feature_weight"].values[0]
        mesh = with_features(mesh, features_of(source), weight=weight)
    if "label" in source:
        label = labels_of_mesh(source["label"].values, mesh)
        mesh = mesh.assign(label=("vertex", label, source["label"].attrs))
    return mesh


def describe_shape(folder: Path, name: str, intersections: bool) -> xr.Dataset:
    """Compute the descriptor of a shape."""
    return plausibility.describe(read(folder / f"original/{name}.nc"), intersections=intersections)


def compare_shape(folder: Path, name: str, references: list[str]) -> xr.Dataset:
    """Compare a shape with the references."""
    descriptors = {n: read(folder / f"network/descriptor_{n}.nc") for n in {*references, name}}
    return plausibility.compare(name, descriptors[name], {n: descriptors[n] for n in references})


def remesh_shape(folder: Path, name: str, options: Options) -> xr.Dataset:
    """Compute the low-resolution mesh of a shape, U (4.1) and spectrum (3.3)."""
    mesh = read(folder / "original" / f"{name}.nc")
    low = low_resolution(mesh, **options.of("low resolution"))
    return in_unit(low, unit_of(mesh["position"]))


class Folder(steps.Study):
    """Nodes of a study in a folder; arrays are read when they are used."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __contains__(self, node: str) -> bool:
        return (self.folder / f"{node}.nc").is_file()

    def __getitem__(self, node: str) -> xr.Dataset:
        return open_file(self.folder / f"{node}.nc")


def template_of(folder: Path, name: str, options: Options) -> Shape:
    """Read the template at both resolutions; a process caches the last one."""
    shape = steps.shape_in(Folder(folder), name, **options.of("projection"))
    written = (mesh.attrs["task_key"] for mesh in (shape.original, shape.coarse))
    key = (folder, name, shape.n_projected, shape.area_weighted, *written)
    if key not in last_template:
        last_template.clear()
    return last_template.setdefault(key, shape)


def align_voters(folder: Path, names: list[str], reference: str, alignment: str) -> xr.Dataset:
    """Compute the rigid transforms of the shapes that vote on the poses of all (4.1, step 2)."""
    bases = {name: steps.basis_in(Folder(folder), name) for name in names}
    voters = voters_of(bases, reference, alignment)
    R, t = (
        np.array([pose[i] for _, pose in voters.values()]).reshape(-1, *shape)
        for i, shape in enumerate([(3, 3), (3,)])
    )
    return dataset(None, rotation=R, translation=t).assign_coords(shape=list(voters))


@lru_cache(maxsize=1)
def voters_in(folder: Path, reference: str, key: str) -> tuple[Basis, Voters]:
    """Read the reference and the voters of the file with this key, as all shapes need them."""
    study = Folder(folder)
    poses = study["network/voters"]
    rows = zip(*(poses[key].values for key in ("shape", "rotation", "translation")), strict=True)
    voters = {str(n): (steps.basis_in(study, n), (R, t)) for n, R, t in rows}
    return steps.basis_in(study, reference), voters


def align_shape(folder: Path, name: str, reference: str, alignment: str) -> xr.Dataset:
    """Compute the rigid transform of a shape onto the reference, of unit area (4.1, step 2)."""
    study = Folder(folder)
    target, voters = voters_in(folder, reference, study["network/voters"].attrs["task_key"])
    basis = target if name == reference else steps.basis_in(study, name)
    found = align_voted(name, basis, target, reference, alignment, voters)
    residual = alignment_residual(basis, target, found.transform)
    attrs: dict[str, Any] = {"reference": reference, "residual": residual}
    attrs |= {"n_poses": len(found.fits), "ambiguity": found.ambiguity}
    return dataset(attrs, rotation=found.R, translation=found.t)


def map_pairs(
    folder: Path, pairs: list[Any], k_init: int, options: dict[str, Any], keep: bool
) -> xr.Dataset:
    """Compute initial maps of some pairs, in both directions (4.1, steps 3 and 4)."""
    study, names = Folder(folder), sorted({name for pair in pairs for name in pair})
    bases = {name: steps.basis_in(study, name) for name in names}
    transforms = {name: steps.transform_in(study, name) for name in names}
    return steps.map_pairs(
        bases, transforms, pairs, k_init=k_init, keep_descriptors=keep, **options
    )


def consistent_maps(
    run: Run, names: list[str], initial: xr.Dataset, options: Options, n_jobs: int
) -> xr.DataTree:
    """Refine the network by Consistent ZoomOut (4.2): ``/network`` and ``/latent``."""
    study = Folder(run.folder)
    transforms = {name: steps.transform_in(study, name) for name in names}
    alignments = [study[f"network/alignment_{name}"].attrs for name in names]
    reference, residuals = alignments[0]["reference"], [a["residual"] for a in alignments]
    coarse = {name: study[f"coarse/{name}"] for name in names}
    k_init = initial.sizes["eigenpair_source_initial"]
    distance = spectral_distance([c["eigenvalue"].values[:k_init] for c in coarse.values()])
    initial = steps.with_transforms(initial, transforms, reference, residuals, distance)
    k = min(options.k, *(mesh.sizes["eigenpair"] for mesh in coarse.values()))
    bar = run.show("consistent ZoomOut", k - k_init)
    return steps.refine_network(
        coarse,
        initial,
        k=options.k,
        n_samples=options.n_samples,
        **options.of("Consistent ZoomOut"),
        n_jobs=n_jobs,
        progress=lambda size: bar.update(size - k_init - bar.n),
    )


def insert_shape(folder: Path, name: str, options: Options) -> xr.Dataset:
    """Compute the latent basis of a shape that is excluded from the network, which is fixed."""
    study = Folder(folder)
    latent, basis = read(folder / "latent.nc"), steps.basis_in(study, name)
    median, transform = latent.attrs["median"], steps.transform_in(study, name)
    names = [median, *(n for n in latent["shape"].values.tolist() if n != median)]
    Y = steps.out_of_sample_basis_in(
        study,
        names,
        basis,
        lambda other: relative_transform(transform, steps.transform_in(study, other)),
        k_init=min(options.k_init, latent.sizes["eigenpair"]),
        step=options.step,
        **options.of("initial maps"),
    )
    eigenvalues = study[f"coarse/{name}"]["eigenvalue"].values[None]
    latent_eigenvalue = latent["latent_eigenvalue"].values
    found = out_of_sample_latent(Y[None], eigenvalues, latent_eigenvalue, options.norm)
    return found.drop_vars("latent_eigenvalue").isel(shape=0)


def register_shape(folder: Path, name: str, template: str, options: Options) -> xr.Dataset:
    """Register a shape to the template: eq. 6 at low resolution, then eq. 7 or eq. 3 and 4."""
    target = template_of(folder, template, options)
    settings = {"dense_match": options.dense_match, **options.of("registration")}
    settings["alignment"] = options.alignment
    study = Folder(folder)
    n_poses = study[f"network/alignment_{name}"].attrs["n_poses"]
    return less_confident(steps.register_in(study, name, template, target, **settings), n_poses)
