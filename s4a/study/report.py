"""Report of a run, ``/report`` (4, 6.1): repairs, flags, reduced options, costs."""

from typing import Any

import numpy as np
import xarray as xr

from s4a.input.chirality import AUTO
from s4a.input.collection import shape_report
from s4a.input.plausibility import Flags
from s4a.options import Options, with_options
from s4a.schema import dataset
from s4a.study.netcdf import arrays, attributes, read
from s4a.study.quality_control import comparison_of
from s4a.study.runner import Run, names_and_keys
from s4a.study.sources import Sources
from s4a.study.store import write


def write_report(
    run: Run,
    sources: Sources,
    options: Options,
    remarks: list[str],
    no_modes: str,
    registered: dict[str, str],
    flags: Flags,
    ambiguous: bool = False,
) -> None:
    """Write ``/report``: every shape, warnings, reduced options, costs and options.

    Parameters
    ----------
    run : Run
    sources : dict
        All shapes given, see :func:`s4a.study.sources.find_sources`.
    options : Options
    remarks : list of str
        On the collection, from earlier steps.
    no_modes : str
        Reason why there are no modes; empty if there are.
    registered : dict of str to str
        Keys of the registrations.
    flags : dict of str to list of Flag
        Flags of the registered shapes.
    ambiguous : bool
        Whether shapes with an ambiguous pose are in the modes.
    """
    names = list(registered)
    template = attributes(run.folder / "registration.nc")["template"]
    network, latent = read(run.folder / "network.nc"), read(run.folder / "latent.nc")
    in_network = latent["shape"].values.tolist()
    spectra = {n: arrays(run.folder / f"coarse/{n}.nc", "eigenvalue")[0] for n in in_network}
    report = shape_report(
        {name: shape_attrs(run, name, source, options) for name, (source, _) in sources.items()},
        flags,
        [
            *reduced_k(options.k, latent.sizes["eigenpair"], spectra),
            *remarks,
            *reduced_pairs(options.n_pairs, network.sizes["pair"] // 2, len(spectra)),
            *tied(in_network, latent["distance_to_limit"].values),
        ],
        {name: comparison_of(run, name) for name in names if options.quality_control != "off"},
    )
    if options.reflect is not None:
        report = report.assign(chirality_evidence(run, list(sources), options).variables)
    report = report.assign(costs(run).variables)
    report = report.assign_attrs(
        with_options(
            {"template": template, "no_modes": no_modes, "ambiguous_included": int(ambiguous)},
            vars(options),
        )
    )
    report.attrs["unforeseen"] = " ".join(run.unforeseen)  # names of shapes, which have no blanks
    template_row = report.sel(shape=template)
    if options.template and template_row["status"].item() == "flagged":
        report.attrs["remarks"] += (
            f"\nthe template {template}, given by name, is flagged "
            f"({template_row['warning'].item()})"
        )
    made_from = names_and_keys("registration", registered)
    write(report, run.folder / "report.nc", made_from=made_from, name="report")


def shape_attrs(run: Run, name: str, source: str | xr.Dataset, options: Options) -> dict[str, Any]:
    """Attributes of a shape for :func:`s4a.input.collection.shape_report`."""
    path = {"path": source} if isinstance(source, str) else {}  # the file may have moved
    if name in run.failures:
        return {"status": "excluded", "reason": run.failures[name]} | path
    mesh, coarse = (
        attributes(run.folder / stage / f"{name}.nc") for stage in ("original", "coarse")
    )
    done = [mesh["reason"]] if mesh["reason"] else []
    if coarse["wrapped"]:
        done.append("wrapped watertight before remeshing")
    if coarse["kept_whole"]:
        done.append(f"all vertices used, as there are fewer than n_coarse = {options.n_coarse}")
    if coarse["laplacian"] == "robust":
        done.append("not manifold at low resolution: robust Laplacian used")
    return mesh | {"reason": "; ".join(done)} | path


def chirality_evidence(run: Run, names: list[str], options: Options) -> xr.Dataset:
    """Mirrored shapes and, with ``reflect="auto"``, mean chirality."""
    files = {name: run.folder / f"original/{name}.nc" for name in names}
    reflected = [
        n not in run.failures and bool(attributes(files[n]).get("reflected")) for n in names
    ]
    data = dataset(reflected=np.array(reflected))
    if options.reflect == AUTO:
        choice = read(run.folder / "network/chirality.nc")
        chirality = choice["mean_chirality"].reindex(shape=names).values
        data = data.merge(dataset(mean_chirality=chirality))
    return data


def costs(run: Run) -> xr.Dataset:
    """Seconds and peak memory of every stage."""
    seconds, memory = np.array(list(run.costs.values())).T
    return dataset(seconds=seconds, peak_memory=memory).assign_coords(stage=list(run.costs))


def reduced_k(requested: int, k: int, spectra: dict[str, Any]) -> list[str]:
    """Remark if the maps are smaller than requested.

    Parameters
    ----------
    requested, k : int
        Requested size of the maps, and size used.
    spectra : dict of str to sequence
        Eigenvalues of every shape.

    Examples
    --------
    >>> from s4a.study.report import reduced_k
    >>> reduced_k(100, 57, {"a": range(80), "b": range(57), "c": range(100)})
    ['k = 100 reduced to 57, the eigenfunctions of b: 2 of 3 shapes have fewer than 100']
    """
    if k >= requested:
        return []
    shortest = min(spectra, key=lambda name: len(spectra[name]))
    fewer = sum(len(values) < requested for values in spectra.values())
    return [
        f"k = {requested} reduced to {k}, the eigenfunctions of {shortest}: {fewer} of "
        f"{len(spectra)} shapes have fewer than {requested}"
    ]


def reduced_pairs(requested: int, n_pairs: int, n: int) -> list[str]:
    """Remark if n shapes have fewer pairs than requested.

    Examples
    --------
    >>> from s4a.study.report import reduced_pairs
    >>> reduced_pairs(500, 3, 3)
    ['all 3 pairs of 3 shapes are used (n_pairs = 500)']
    """
    if n_pairs >= requested:
        return []
    return [f"all {n_pairs} pairs of {n} shapes are used (n_pairs = {requested})"]


def tied(names: list[str], distance: np.ndarray, relative: float = 1e-6) -> list[str]:
    """Remark if several shapes are equally near the limit shape.

    Examples
    --------
    >>> from s4a.study.report import tied
    >>> tied(["c", "a", "b"], [0.5, 0.5, 0.7])[0][:64]
    'the median is not unique: a, c are equally near the limit shape;'
    """
    least = min(distance) * (1 + relative) + 1e-9
    near = sorted(name for name, d in zip(names, distance, strict=True) if d <= least)
    if len(near) < 2:
        return []
    always = " (of two shapes, always)" if len(names) == 2 else ""
    return [
        f"the median is not unique: {', '.join(near)} are equally near the limit shape{always}; "
        "one of them is used"
    ]
