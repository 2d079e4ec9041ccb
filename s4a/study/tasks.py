"""What a worker computes, one file of a study at a time: the steps of 4 for a shape or some pairs.

A task gets paths and names, reads the files of earlier tasks, and returns the Dataset of its own.
"""

from pathlib import Path

import numpy as np
import xarray as xr
from tqdm.auto import tqdm

from s4a.geometry.align import align, motion_between, realign
from s4a.geometry.mesh import as_arrays, triangle_areas
from s4a.input import plausibility
from s4a.input.clean import clean
from s4a.input.collection import read_shape
from s4a.method import steps
from s4a.method.register import from_latent, identity
from s4a.method.remesh import coarsen
from s4a.method.shape import Basis, Shape
from s4a.method.spectral import spectrum
from s4a.schema import dataset, in_unit, unit_of
from s4a.study.options import Options
from s4a.study.store import arrays, open_file, read


def clean_shape(source: str | xr.Dataset, cleaning: dict) -> xr.Dataset:
    """A file read and cleaned, or a mesh in memory cleaned where it is not yet."""
    if isinstance(source, str):
        return read_shape(source, **cleaning)
    if "file_vertex" in source:
        area = float(triangle_areas(*as_arrays(source)).sum())
        mesh = source.assign_attrs({"status": "ok", "reason": "", "area": area} | source.attrs)
    else:
        mesh = clean(source, **cleaning)
    return in_unit(mesh, source.attrs.get("unit"))


def compare_shape(folder: Path, name: str, reference: str, intersections: bool) -> xr.Dataset:
    """What :func:`s4a.input.plausibility.examine` sees in a shape beside the reference."""
    mesh, other = (read(folder / "original" / f"{n}.nc") for n in (name, reference))
    look = plausibility.examine(mesh, plausibility.sample_vertices(other), intersections)
    rotation = look.pop("rotation")
    return dataset(look, rotation=rotation)


def remesh_shape(
    folder: Path, name: str, n_coarse: int, wrap: bool, seed: int, k: int
) -> xr.Dataset:
    """The low-resolution mesh of a shape of the study, its U (4.1) and its spectrum (3.3)."""
    mesh = read(folder / "original" / f"{name}.nc")
    low = spectrum(coarsen(mesh, n_coarse=n_coarse, wrap=wrap, seed=seed), k=k)
    return in_unit(low, unit_of(mesh["position"]))


def shape_of(folder: Path, name: str) -> Shape:
    """A shape of the study at both resolutions; its arrays are read when they are used."""
    return Shape(*(open_file(folder / stage / f"{name}.nc") for stage in ("original", "coarse")))


def low_basis(folder: Path, name: str) -> Basis:
    """The coarse mesh of a shape, centred and for unit area, and its eigenfunctions."""
    return Shape(None, open_file(folder / "coarse" / f"{name}.nc")).low


def align_shape(folder: Path, name: str, reference: str) -> xr.Dataset:
    """Rigid motion of a shape onto the reference, both centred and for unit area (4.1, step 2)."""
    R, t = np.eye(3), np.zeros(3)
    if name != reference:
        M, N = low_basis(folder, name), low_basis(folder, reference)
        R, t, _ = align(M.X, M.area, N.X, N.area)
    return dataset({"reference": reference}, rotation=R, translation=t)


def motion_to_reference(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """R and t of :func:`align_shape`."""
    R, t = arrays(folder / "network" / f"motion_{name}.nc", "rotation", "translation")
    return R, t


def map_pairs(folder: Path, pairs: list, k_init: int, init: str) -> xr.Dataset:
    """First maps of some pairs, in both directions (4.1, steps 3 and 4)."""
    names = sorted({name for pair in pairs for name in pair})
    bases = {name: low_basis(folder, name) for name in names}
    motions = {name: motion_to_reference(folder, name) for name in names}
    return steps.map_pairs(bases, motions, pairs, k_init=k_init, init=init)


def consistent_maps(
    folder: Path, names: list[str], first: xr.Dataset, options: Options, n_jobs: int
) -> tuple[xr.Dataset, xr.Dataset]:
    """Consistent ZoomOut over the network and the median (4.2): ``/network`` and ``/latent``."""
    coarse = {name: open_file(folder / "coarse" / f"{name}.nc") for name in names}
    k_init = first.sizes["mode_source_initial"]
    with tqdm(total=options.k - k_init, desc="consistent ZoomOut") as bar:
        tree = steps.refine_network(
            coarse,
            first,
            k=options.k,
            step=options.step,
            n_latent=options.n_latent,
            norm=options.norm,
            n_jobs=n_jobs,
            progress=lambda size: bar.update(size - k_init - bar.n),
        )
        bar.total = bar.n  # k may be less than was asked for
    return tree["network"].to_dataset(), tree["latent"].to_dataset()


def register_shape(
    folder: Path, name: str, template: str, how: str, refine: str, scale: bool
) -> xr.Dataset:
    """One shape registered to the template: eq. 6 at low resolution, then eq. 7 or eq. 3 and 4."""
    target = shape_of(folder, template)
    if name == template:
        return identity(target)
    source = shape_of(folder, name)
    Y = read(folder / "latent.nc")["latent_basis"]
    bases = Y.sel(shape=name).values, Y.sel(shape=template).values
    M, N = source.low, target.low
    start = motion_between(*(motion_to_reference(folder, n) for n in (name, template)))
    motion = realign(M.cloud, N.cloud, start)
    return from_latent(source, target, bases, motion, how=how, refine=refine, scale=scale)
