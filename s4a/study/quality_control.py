"""Shapes that may spoil a study: which are left out, which stand apart, and what is told of them.

A shape is held against the others of its collection before anything is computed with it, by its
eigenfunctions once it has some, and by its registration in the end.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from s4a.geometry.crossing import can_count
from s4a.input.plausibility import Flags, find_warnings, flag, flagged_lines, pick_references
from s4a.options import Options
from s4a.study.netcdf import arrays, attributes, open_file, read
from s4a.study.runner import Keys, Run, Task
from s4a.study.store import task_key
from s4a.study.tasks import compare_shape, portray_shape

# registration_error: of one kind 0.02 to 0.03, in far poses 0.01 to 0.03, of a cat and a man 0.14
# to 0.16
FLAGGED = 0.06
# registration_error times mean |distortion|: of pairs of bodies and cats that are right 0.0002 to
# 0.005, of those that failed 0.0033 to 0.08 (docs/plausibility.md)
WRONG, UNSURE = 0.0065, 0.004
# and times the median of the collection, as coarse meshes raise the product of all shapes
WRONG_BESIDE, UNSURE_BESIDE = 2.0, 1.5


def check_plausibility(run: Run, original: Keys, options: Options) -> tuple[Keys, Flags, list[str]]:
    """What looks wrong with each shape beside the others, and with all of them.

    Returns
    -------
    original : dict of str to str
        Keys of the shapes that could be compared.
    flags : dict of str to list of Doubt
    remarks : list of str
    """
    if len(original) < 2:
        return original, {}, []
    attrs = {n: attributes(run.folder / f"original/{n}.nc") for n in original}
    looks = comparisons_of(run, original, options)
    return {n: original[n] for n in looks}, *find_warnings({n: attrs[n] for n in looks}, looks)


def comparisons_of(run: Run, original: Keys, options: Options) -> dict[str, xr.Dataset]:
    """What :func:`s4a.input.plausibility.compare` sees in each shape that could be compared."""
    # how they are counted is part of the key: by PyMeshLab, as once, they were others
    settings = (can_count(options.intersections),)
    counted = ("exactly",) if settings[0] else settings
    todo = [
        Task(
            n,
            f"network/descriptor_{n}.nc",
            portray_shape,
            (run.folder, n, *settings),
            (key, counted),
        )
        for n, key in original.items()
    ]
    descriptors = run.do("descriptor", todo)
    references = references_of(run, descriptors, options.k)
    reference_key = task_key(*(descriptors[n] for n in references))
    todo = [
        Task(
            n,
            f"network/comparison_{n}.nc",
            compare_shape,
            (run.folder, n, references),
            (reference_key, key),
        )
        for n, key in descriptors.items()
    ]
    compared = run.do("compare", todo)
    return {name: comparison_of(run, name) for name in compared}


def references_of(run: Run, descriptors: Keys, k: int) -> list[str]:
    """The shapes beside which all are seen: of usual form, fine enough for k."""
    vertices = {n: open_file(run.folder / f"original/{n}.nc").sizes["vertex"] for n in descriptors}
    least = usable_k(list(vertices.values()), k)
    fine = [name for name in descriptors if vertices[name] >= least]
    return pick_references(
        {n: read(run.folder / f"network/descriptor_{n}.nc") for n in fine or descriptors}
    )


def comparison_of(run: Run, name: str) -> xr.Dataset:
    """What :func:`s4a.input.plausibility.compare` saw in a shape."""
    return read(run.folder / f"network/comparison_{name}.nc")


def stop_if_flagged(flags: Flags, options: Options) -> None:
    """ValueError where a shape is flagged and the run shall stop at that."""
    if options.quality_control != "stop":
        return
    kinds = {
        name: " ".join(dict.fromkeys(flag.kind for flag in of_shape if flag.flagged))
        for name, of_shape in flags.items()
        if name != options.template
    }
    kinds = {name: words for name, words in kinds.items() if words}
    if kinds:
        lines = "\n".join(f"  {line}" for line in flagged_lines(kinds))
        raise ValueError(
            f"{len(kinds)} of {len(flags)} shapes are flagged, and quality_control='stop' ends the "
            f"run before its long stages:\n{lines}\nrepair or remove these files, or pass "
            "quality_control='exclude' to exclude them from the network"
        )


def exclude_flagged(
    run: Run, coarse: Keys, flags: Flags, options: Options
) -> tuple[Flags, Keys, Keys, list[str]]:
    """The shapes that make the network, and the flagged ones, which stand apart from it.

    Those with fewer eigenfunctions than most others are left out.  Where fewer than two are beyond
    flag, none is flagged: there is nothing to hold them against.

    Returns
    -------
    flags : dict of str to list of Doubt
    coarse, apart : dict of str to str
        Keys of the low-resolution meshes of both.
    remarks : list of str
    """
    count = {n: len(arrays(run.folder / f"coarse/{n}.nc", "eigenvalue")[0]) for n in coarse}
    named = options.template  # who names a template trusts it
    is_flagged = {n: any(flag.flagged for flag in flags.get(n, [])) for n in coarse}
    sure = [n for n in coarse if n == named or not is_flagged[n]]
    remarks = []
    if len(sure) < 2:
        flags = {n: [flag._replace(flagged=False) for flag in flags.get(n, [])] for n in flags}
        if len(coarse) > 1:
            remarks = [
                f"{len(coarse) - len(sure)} of {len(coarse)} shapes are flagged, and fewer than "
                "two are not: all are treated alike"
            ]
        sure = list(coarse)
    k = usable_k([count[n] for n in sure], options.k)
    enough = sum(count[n] >= k for n in sure)
    for n in coarse:
        if count[n] < k:
            run.failures[n] = (
                f"only {count[n]} eigenfunctions, where {enough} of {len(sure)} shapes have "
                f"{k} or more: give a finer mesh, or a smaller k"
            )
    network = {n: coarse[n] for n in sure if count[n] >= k}
    apart = {n: coarse[n] for n in coarse if n not in sure and count[n] >= k}
    check_usable(run, network, options)
    return flags, network, apart, remarks


def usable_k(counts: Sequence[int], k: int) -> int:
    """The size of maps that most shapes allow, by their numbers of eigenfunctions.

    It is k where most have as many.  Else it is the least number of those shapes that have at least
    half of what is usual: few eigenfunctions of one shape are no reason to take them from all.

    Examples
    --------
    >>> from s4a.study.quality_control import usable_k
    >>> usable_k([100, 100, 2], 100), usable_k([58, 2, 48, 62], 100)
    (100, 48)
    """
    if 2 * sum(count >= k for count in counts) > len(counts):
        return k
    usual = np.median(counts)
    return min(count for count in counts if 2 * count >= usual)


def check_usable(run: Run, coarse: Keys, options: Options) -> None:
    """ValueError where too few shapes are left, or the template is not among them."""
    if len(coarse) < 2:
        reasons = "; ".join(f"{name}: {why}" for name, why in run.failures.items())
        raise ValueError(
            f"an analysis needs at least 2 usable shapes, found {len(coarse)} "
            f"({reasons or 'only one was given'})"
        )
    if options.template in run.failures:
        why = run.failures[options.template]
        raise ValueError(f"template {options.template!r} cannot be used: {why}")


def check_registrations(run: Run, registered: Keys, placed: Keys) -> tuple[Flags, list[str]]:
    """What is flagged of the registrations within the network."""
    names = [name for name in registered if name not in placed]
    files = {name: run.folder / f"registration/{name}.nc" for name in names}
    registration_error = {name: attributes(file)["score"] for name, file in files.items()}
    distortion = {
        name: float(np.abs(arrays(file, "distortion")[0]).mean()) for name, file in files.items()
    }
    return flagged(registration_error, distortion)


def flagged(
    registration_error: dict[str, float], distortion: dict[str, float] | None = None
) -> tuple[Flags, list[str]]:
    """Flags about the shapes whose registration scores badly, or for all of them.

    Parameters
    ----------
    registration_error : dict of str to float
        See :func:`s4a.method.spectral_icp.registration_score`.
    distortion : dict of str to float, optional
        Mean size of the distortion.  A wrong map both misses the surface and distorts: the product
        is told where neither number alone is.

    Returns
    -------
    of_shapes : dict of str to list of Doubt
        Of the kind ``registration``; only names that have one.
    of_all : list of str
        In place of the former where most shapes are flagged: then the template or the options are.

    Examples
    --------
    >>> from s4a.study.quality_control import flagged
    >>> of_shapes, of_all = flagged({"template": 0.0, "good": 0.02, "wrong": 0.12})
    >>> list(of_shapes), of_all
    (['wrong'], [])
    """
    distortion = distortion or {}
    product = {
        name: score * distortion.get(name, 0.0) for name, score in registration_error.items()
    }
    usual = float(np.median([one for one in product.values() if one > 0] or [0.0]))
    far, near = max(WRONG, WRONG_BESIDE * usual), max(UNSURE, UNSURE_BESIDE * usual)
    wrong = {
        n: score for n, score in registration_error.items() if score > FLAGGED or product[n] > far
    }
    if len(registration_error) > 2 and len(wrong) > len(registration_error) / 2:
        return {}, [
            f"{len(wrong)} of {len(registration_error)} registrations are flagged "
            f"(registration_error {min(wrong.values()):.3f} to {max(wrong.values()):.3f}): "
            "try another template, a larger n_coarse or k"
        ]
    found: Flags = {}
    for name, score in registration_error.items():
        if name not in wrong and product[name] <= near:
            continue
        sure = "probably" if name in wrong else "maybe, in places,"
        also = f", mean |distortion| {distortion[name]:.2f}" if name in distortion else ""
        said = flag(
            "registration", name in wrong, sure=sure, registration_error=score, distortion=also
        )
        found[name] = [said]
    return found, []
