"""What a run has to say of itself: ``/report`` (4, 6.1).

What was done to each shape, doubtful registrations, numbers reduced to what there is, costs.
"""

import numpy as np
import xarray as xr

from s4a.input.collection import shape_report
from s4a.schema import dataset
from s4a.study.options import Options
from s4a.study.runner import Run
from s4a.study.sources import Sources
from s4a.study.store import arrays, attributes, read, write

# badness: of one kind 0.02 to 0.03, in far poses 0.01 to 0.03, of a cat and a man 0.14 to 0.16
DOUBTFUL = 0.06


def write_report(
    run: Run,
    sources: Sources,
    options: Options,
    remarks: list[str],
    no_modes: str,
    registered: dict[str, str],
) -> None:
    """Write ``/report``: every shape, what looks wrong, what was reduced, costs and options.

    Parameters
    ----------
    run : Run
    sources : dict
        Of all shapes that were given, see :func:`s4a.study.sources.find_sources`.
    options : Options
    remarks : list of str
        On the collection, from earlier steps.
    no_modes : str
        Why there are no modes; empty where there are.
    registered : dict of str to str
        Keys of the registrations.
    """
    names = list(registered)
    template = attributes(run.folder / "registration.nc")["template"]
    network, latent = read(run.folder / "network.nc"), read(run.folder / "latent.nc")
    badness = {n: attributes(run.folder / f"registration/{n}.nc")["score"] for n in names}
    spectra = {n: arrays(run.folder / f"coarse/{n}.nc", "eigenvalue")[0] for n in names}
    of_shapes, of_all = doubtful(badness)
    report = shape_report(
        {name: of_shape(run, name, source, options) for name, (source, _) in sources.items()},
        {name: of_look(run, name) for name in names},
        [
            *remarks,
            *of_all,
            *reductions(options, network.sizes["pair"] // 2, latent.sizes["mode"], spectra),
            *tied(latent["shape"].values.tolist(), latent["distance_to_median"].values),
        ],
        of_shapes,
    )
    report = report.assign(costs(run).variables)
    report = report.assign_attrs(options.to_report() | {"template": template, "no_modes": no_modes})
    warning = report["warning"].sel(shape=template).item()
    if warning:
        report.attrs["remarks"] += (
            f"\nthe template {template} is itself doubtful ({warning}): give template=NAME"
        )
    write(report, run.folder / "report.nc", made_from=registered.values())


def of_shape(run: Run, name: str, source: str | xr.Dataset, options: Options) -> dict:
    """Attributes of a shape for :func:`s4a.input.collection.shape_report`: what was done to it."""
    path = {"path": source} if isinstance(source, str) else {}  # may have moved since it was read
    if name in run.failures:
        return {"status": "excluded", "reason": run.failures[name]} | path
    mesh, coarse = (
        attributes(run.folder / stage / f"{name}.nc") for stage in ("original", "coarse")
    )
    done = [mesh["reason"]] if mesh["reason"] else []
    if coarse["wrapped"]:
        done.append("wrapped watertight before remeshing")
    if coarse["kept_whole"]:
        done.append(f"all vertices are used, as there are fewer than n_coarse = {options.n_coarse}")
    if coarse["laplacian"] == "robust":
        done.append("not manifold at low resolution: robust Laplacian")
    return mesh | {"reason": "; ".join(done)} | path


def of_look(run: Run, name: str) -> dict:
    """What :func:`s4a.input.plausibility.examine` saw in a shape."""
    look = read(run.folder / f"network/look_{name}.nc")
    return look.attrs | {"rotation": look["rotation"].values}


def costs(run: Run) -> xr.Dataset:
    """Seconds and peak memory of every stage."""
    seconds, memory = np.array(list(run.costs.values())).T
    return dataset(seconds=seconds, peak_memory=memory).assign_coords(stage=list(run.costs))


def doubtful(badness: dict[str, float]) -> tuple[dict[str, str], list[str]]:
    """Warnings for the shapes whose registration scores badly, or for all of them.

    See :func:`s4a.method.joint.registration_score`.

    Returns
    -------
    of_shapes : dict of str to str
    of_all : list of str
        In place of the former where most shapes are doubtful: then the template or the options are.

    Examples
    --------
    >>> from s4a.study.report import doubtful
    >>> of_shapes, of_all = doubtful({"template": 0.0, "good": 0.02, "wrong": 0.12})
    >>> list(of_shapes), of_all
    (['wrong'], [])
    """
    wrong = {name: score for name, score in badness.items() if score > DOUBTFUL}
    if len(badness) > 2 and len(wrong) > len(badness) / 2:
        return {}, [
            f"{len(wrong)} of {len(badness)} registrations are doubtful "
            f"(badness {min(wrong.values()):.3f} to {max(wrong.values()):.3f}, above {DOUBTFUL}): "
            "try another template, a larger n_coarse or k"
        ]
    return {
        name: f"probably registered wrongly (badness {score:.3f}, above {DOUBTFUL}): "
        "look at it in s4a view, compare its file with the template's, or leave it out"
        for name, score in wrong.items()
    }, []


def reductions(options: Options, n_pairs: int, k: int, spectra: dict) -> list[str]:
    """What of the options was reduced to what the shapes allow, in words.

    Parameters
    ----------
    options : Options
    n_pairs, k : int
        Pairs and size of the maps that were used.
    spectra : dict of str to sequence
        The eigenvalues of every shape.

    Examples
    --------
    >>> from s4a.study.options import Options
    >>> from s4a.study.report import reductions
    >>> spectra = {"a": range(100), "b": range(57), "c": range(100)}
    >>> for words in reductions(Options(n_pairs=500, k=100), 3, 57, spectra):
    ...     print(words)
    all 3 pairs of 3 shapes are used (n_pairs = 500)
    k = 100 reduced to 57, the eigenfunctions of b
    """
    words = []
    if n_pairs < options.n_pairs:
        words.append(
            f"all {n_pairs} pairs of {len(spectra)} shapes are used (n_pairs = {options.n_pairs})"
        )
    if k < options.k:
        shortest = min(spectra, key=lambda name: len(spectra[name]))
        words.append(f"k = {options.k} reduced to {k}, the eigenfunctions of {shortest}")
    return words


def tied(names: list[str], distance: np.ndarray, relative: float = 1e-6) -> list[str]:
    """Whether the median shape is one of several, in words.

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
        "one of them was taken"
    ]
