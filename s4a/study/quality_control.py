"""Quality control of a run: flag suspect shapes, and exclude them from the network and the modes.

Shapes are compared with their collection before the computation, checked by their number of
eigenfunctions, and in the end by their registration.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import xarray as xr
from scipy.spatial.distance import pdist, squareform
from scipy.special import betaincc

from s4a.geometry.crossing import can_count
from s4a.input.plausibility import (
    Flag,
    Flags,
    find_warnings,
    flag,
    flagged_lines,
    in_words,
    pick_references,
)
from s4a.options import Options
from s4a.schema import POSE
from s4a.study.netcdf import arrays, attributes, open_file, read
from s4a.study.runner import Keys, Run, Task
from s4a.study.store import task_key
from s4a.study.tasks import compare_shape, describe_shape

# registration_error: 0.02 to 0.03 for shapes of one kind, 0.01 to 0.03 for large pose differences,
# 0.14 to 0.16 between a cat and a man
FLAGGED = 0.06
# registration_error times mean |distortion|: 0.0002 to 0.005 for correct pairs of bodies and cats,
# 0.0033 to 0.08 for failed ones (docs/plausibility.md)
WRONG, UNSURE = 0.0065, 0.004
# the same over the median of the collection, as coarse meshes raise the product for all shapes
WRONG_RATIO, UNSURE_RATIO = 2.0, 1.5
# modes of variation: least number of shapes for near copies; least share of a shape in the sum of
# squared scores, its largest p value, least share of the variance
FEW, SHARE, ALONE, LARGE = 6, 0.7, 0.001, 0.3
# near copies: largest distance over the usual one and over sqrt(area), and largest p value
NEAR, COPY, CHANCE = 0.2, 0.005, 0.02
NOT_COMPARED = "quality_control='off': mirrored, partial or duplicate shapes are not detected"


def check_plausibility(run: Run, original: Keys, options: Options) -> tuple[Keys, Flags, list[str]]:
    """Compare the shapes with each other, and flag suspect ones.

    With ``quality_control="off"`` they are not compared, and only what cleaning found is reported.

    Returns
    -------
    original : dict of str to str
        Keys of the shapes that could be compared.
    flags : dict of str to list of Flag
    remarks : list of str
    """
    if len(original) < 2:
        return original, {}, []
    attrs = {n: attributes(run.folder / f"original/{n}.nc") for n in original}
    if options.quality_control == "off":
        flags, remarks = find_warnings(attrs, {})
        return original, flags, [*remarks, NOT_COMPARED]
    compared = comparisons_of(run, original, options)
    used = {n: attrs[n] for n in compared}
    return {n: original[n] for n in compared}, *find_warnings(used, compared)


def comparisons_of(run: Run, original: Keys, options: Options) -> dict[str, xr.Dataset]:
    """:func:`s4a.input.plausibility.compare` each shape with the references."""
    # the method of counting is part of the key
    settings = (can_count(options.intersections),)
    counted = ("exactly",) if settings[0] else settings
    todo = []
    for n, key in original.items():
        file, arguments = f"network/descriptor_{n}.nc", (run.folder, n, *settings)
        todo.append(Task(n, file, describe_shape, arguments, (key, counted)))
    descriptors = run.do("descriptor", todo)
    references = references_of(run, descriptors, options.k)
    reference_key = task_key(*(descriptors[n] for n in references))
    todo = []
    for n, key in descriptors.items():
        file, inputs = f"network/comparison_{n}.nc", (reference_key, key)
        todo.append(Task(n, file, compare_shape, (run.folder, n, references), inputs))
    compared = run.do("compare", todo)
    return {name: comparison_of(run, name) for name in compared}


def references_of(run: Run, descriptors: Keys, k: int) -> list[str]:
    """Choose the references: typical shapes with enough vertices for k."""
    vertices = {n: open_file(run.folder / f"original/{n}.nc").sizes["vertex"] for n in descriptors}
    least = usable_k(list(vertices.values()), k)
    fine = [name for name in descriptors if vertices[name] >= least]
    return pick_references(
        {n: read(run.folder / f"network/descriptor_{n}.nc") for n in fine or descriptors}
    )


def comparison_of(run: Run, name: str) -> xr.Dataset:
    """Read the comparison of a shape with the references."""
    return read(run.folder / f"network/comparison_{name}.nc")


def stop_if_flagged(flags: Flags, options: Options) -> None:
    """Raise ValueError if a shape is flagged and ``quality_control="stop"``."""
    if options.quality_control != "stop":
        return
    kinds = {
        name: " ".join(dict.fromkeys(flag.kind for flag in shape_flags if flag.flagged))
        for name, shape_flags in flags.items()
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
    """Split the shapes into those of the network and flagged ones, excluded from it.

    Shapes with fewer eigenfunctions than most others fail.  All flags are lifted with
    ``quality_control="off"``, and if fewer than two shapes are not flagged, since there is no
    reference to compare with.

    Returns
    -------
    flags : dict of str to list of Flag
    coarse, excluded : dict of str to str
        Keys of the low-resolution meshes of both.
    remarks : list of str
    """
    flags = unflagged(flags) if options.quality_control == "off" else flags
    count = {n: len(arrays(run.folder / f"coarse/{n}.nc", "eigenvalue")[0]) for n in coarse}
    is_flagged = {n: any(flag.flagged for flag in flags.get(n, [])) for n in coarse}
    # a template that the user names is trusted
    trusted = [n for n in coarse if n == options.template or not is_flagged[n]]
    remarks = []
    if len(trusted) < 2:
        flags = unflagged(flags)
        if len(coarse) > 1:
            remarks = [
                f"{len(coarse) - len(trusted)} of {len(coarse)} shapes are flagged, too many to "
                "exclude them; all shapes are used"
            ]
        trusted = list(coarse)
    k = usable_k([count[n] for n in trusted], options.k)
    n_enough = sum(count[n] >= k for n in trusted)
    for n in coarse:
        if count[n] < k:
            run.failures[n] = (
                f"only {count[n]} eigenfunctions, but {n_enough} of {len(trusted)} shapes have "
                f"{k} or more: give a finer mesh, or a smaller k"
            )
    network = {n: coarse[n] for n in trusted if count[n] >= k}
    excluded = {n: coarse[n] for n in coarse if n not in trusted and count[n] >= k}
    check_usable(run, network, options)
    return flags, network, excluded, remarks


def flag_poses(run: Run, aligned: Iterable[str], flags: Flags) -> Flags:
    """Add flags to the shapes whose pose is ambiguous."""
    found = {n: attributes(run.folder / f"network/alignment_{n}.nc")["ambiguity"] for n in aligned}
    new = {name: [Flag(POSE, words, True)] for name, words in found.items() if words}
    return flags | {name: [*flags.get(name, []), *new[name]] for name in new}


def exclude_ambiguous(
    run: Run, coarse: Keys, flags: Flags, options: Options
) -> tuple[Flags, Keys, Keys, list[str]]:
    """Split the shapes of the network into those with one pose and ambiguous ones.

    If half of the shapes or more are ambiguous, none is excluded, nor with
    ``quality_control="off"``.

    Returns
    -------
    flags, coarse, excluded, remarks : see :func:`exclude_flagged`
    """
    flags = flag_poses(run, coarse, flags)
    if options.quality_control == "off":
        return unflagged(flags), coarse, {}, []
    ambiguous = [n for n in coarse if any(flag.kind == POSE for flag in flags.get(n, []))]
    excluded = {n: coarse[n] for n in ambiguous if n != options.template}
    if 2 * len(excluded) >= len(coarse):
        remark = (
            f"{len(ambiguous)} of {len(coarse)} shapes fit the others equally well in several "
            "poses, too many to exclude; all are used, some perhaps in the wrong pose: give "
            "landmarks=, or alignment='given' if the files are aligned"
        )
        return flags, coarse, {}, [remark]
    return flags, {n: coarse[n] for n in coarse if n not in excluded}, excluded, []


def unflagged(flags: Flags) -> Flags:
    """Return the flags as warnings, which exclude no shape."""
    return {name: [flag._replace(flagged=False) for flag in flags[name]] for name in flags}


def usable_k(counts: Sequence[int], k: int) -> int:
    """Return the size of maps that most shapes allow, by their numbers of eigenfunctions.

    It is k if most shapes have that many, else the least number of the shapes that have at least
    half of the median: one shape with few eigenfunctions does not reduce the maps of all.

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
    """Raise ValueError if fewer than two shapes are left, or the template has failed."""
    if len(coarse) < 2:
        reasons = "; ".join(f"{name}: {why}" for name, why in run.failures.items())
        raise ValueError(
            f"an analysis needs at least 2 usable shapes, found {len(coarse)} "
            f"({reasons or 'only one was given'})"
        )
    if options.template in run.failures:
        why = run.failures[options.template]
        raise ValueError(f"template {options.template!r} cannot be used: {why}")


def check_registrations(run: Run, registered: Keys, inserted: Keys) -> tuple[Flags, list[str]]:
    """Flag the registrations of the network that are probably wrong; see :func:`flagged`."""
    names = [name for name in registered if name not in inserted]
    files = {name: open_file(run.folder / f"registration/{name}.nc") for name in names}
    registration_error = {name: file.attrs["score"] for name, file in files.items()}
    distortion = {
        name: float(abs(file["distortion"].values).mean()) for name, file in files.items()
    }
    n = {name: min(f.sizes["vertex"], f.sizes["original_vertex"]) for name, f in files.items()}
    return flagged(registration_error, distortion, n)


def check_modes(pca: xr.Dataset, area: float) -> Flags:
    """Warn about shapes that dominate a mode of variation, and about near copies.

    Parameters
    ----------
    pca : Dataset
        ``/pca``.
    area : float
        Area of the template.

    Returns
    -------
    flags : dict of str to list of Flag
        Warnings ``influential`` and ``near-copy``, which flag no shape.

    Notes
    -----
    The scores of a mode of s normal shapes in random directions have Beta distributed shares of
    their sum of squares, which give the p value of the largest share.  A near copy is much closer
    to a shape than neighbours usually are; p is n x^m for a distance of x times the usual one in m
    dimensions.  The number of dimensions is that of the modes (participation ratio), or that of the
    distances to two neighbours (Facco et al. 2017), whichever is larger.

    References
    ----------
    E. Facco et al. (2017), Estimating the intrinsic dimension of datasets by a minimal neighborhood
    information, Scientific Reports 7.
    """
    flags: Flags = {}
    names, n = pca["shape"].values.tolist(), pca.sizes["shape"]
    score, ratio = pca["score"].values, pca["explained_variance_ratio"].values
    share = score**2 / (score**2).sum(0)  # (n, c)
    p = n * betaincc(0.5, (n - 2) / 2, np.minimum(share.max(0) * n / (n - 1), 1))
    for c in np.flatnonzero((share.max(0) > SHARE) & (p < ALONE) & (ratio > LARGE)):
        values = {"component": c + 1, "percent": 100 * share[:, c].max()}
        one = flag("influential", **values, mode_percent=100 * ratio[c])
        flags.setdefault(names[share[:, c].argmax()], []).append(one)
    if n < FEW:
        return flags
    distance = squareform(pdist(score * pca["standard_deviation"].values))
    np.fill_diagonal(distance, np.inf)
    first, second = np.sort(distance, axis=1)[:, :2].T
    usual = np.median(first)
    dimension = np.log(2) / np.log(max(np.median(second / np.maximum(first, 1e-300)), 1.001))
    dimension = min(max(dimension, 1 / (ratio**2).sum()), n)
    for i, j in enumerate(distance.argmin(1)):
        near = first[i] / usual
        is_copy = near < NEAR and first[i] < COPY * np.sqrt(area) and n * near**dimension < CHANCE
        if is_copy and not any(one.kind == "near-copy" for one in flags.get(names[j], [])):
            one = flag("near-copy", other=names[j], percent=100 * near)
            flags.setdefault(names[i], []).append(one)
    return flags


def check_pair(score: float, distortion: float, n: int, options: Options) -> dict[str, str]:
    """Return status and warning of a single registration, by the limits of :func:`flagged`.

    There is no collection to compare with.

    Parameters
    ----------
    score, distortion : float
        Registration error score, and mean |distortion|.
    n : int
        Number of vertices of the coarser surface.
    options : Options
        With ``quality_control="off"`` the status is always "ok".

    Returns
    -------
    dict
        ``status``, "ok" or "flagged", and ``warning``, empty if nothing was found.

    Examples
    --------
    >>> from s4a.options import Options
    >>> from s4a.study.quality_control import check_pair
    >>> check_pair(0.036, 0.4, 6890, Options())["status"]
    'flagged'
    >>> check_pair(0.078, 0.17, 200, Options())
    {'status': 'ok', 'warning': ''}
    """
    found, _ = flagged({"pair": score}, {"pair": distortion}, {"pair": n}, usual=0.0)
    found = unflagged(found) if options.quality_control == "off" else found
    is_flagged = any(one.flagged for one in found.get("pair", []))
    return {"status": "flagged" if is_flagged else "ok", "warning": in_words(found.get("pair", []))}


def flagged(
    registration_error: dict[str, float],
    distortion: dict[str, float] | None = None,
    n: dict[str, int] | None = None,
    usual: float | None = None,
) -> tuple[Flags, list[str]]:
    """Flag shapes by their registration error, alone and times distortion.

    On coarse meshes correct registrations score up to 1.2 times the vertex spacing 1 / sqrt(n), so
    those below twice the spacing are not flagged.

    Parameters
    ----------
    registration_error : dict of str to float
        See :func:`s4a.method.spectral_icp.registration_score`.
    distortion : dict of str to float, optional
        Mean |distortion|.  A wrong map misses the surface and distorts, so the product separates
        better than either number.
    n : dict of str to int, optional
        Number of vertices of the coarser surface.
    usual : float, optional
        Product of a usual registration; by default the median.

    Returns
    -------
    flags : dict of str to list of Flag
        Flags of the kind ``registration``, of suspect shapes only.
    remarks : list of str
        If most shapes are suspect, a remark on the template and options, and no flags.

    Examples
    --------
    >>> from s4a.study.quality_control import flagged
    >>> flags, remarks = flagged({"template": 0.0, "good": 0.02, "wrong": 0.12})
    >>> list(flags), remarks
    (['wrong'], [])
    """
    distortion, n = distortion or {}, n or {}
    product = {
        name: score * distortion.get(name, 0.0) for name, score in registration_error.items()
    }
    if usual is None:
        usual = float(np.median([value for value in product.values() if value > 0] or [0.0]))
    limit, warning_limit = max(WRONG, WRONG_RATIO * usual), max(UNSURE, UNSURE_RATIO * usual)
    visible = {
        name: score
        for name, score in registration_error.items()
        if score > WRONG_RATIO / np.sqrt(n.get(name, np.inf))
    }
    wrong = {m: score for m, score in visible.items() if score > FLAGGED or product[m] > limit}
    if len(registration_error) > 2 and len(wrong) > len(registration_error) / 2:
        return {}, [
            f"{len(wrong)} of {len(registration_error)} registrations are flagged "
            f"(registration_error {min(wrong.values()):.3f} to {max(wrong.values()):.3f}): "
            "try another template, a larger n_coarse or k"
        ]
    flags: Flags = {}
    for name, score in visible.items():
        if name not in wrong and product[name] <= warning_limit:
            continue
        sure = "probably wrong" if name in wrong else "possibly wrong in parts"
        mean = f", mean |distortion| {distortion[name]:.2f}" if name in distortion else ""
        values = {"sure": sure, "registration_error": score, "distortion": mean}
        flags[name] = [flag("registration", name in wrong, **values)]
    return flags, []
