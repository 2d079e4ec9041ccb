"""Exercises of the notebooks: what the right answer to each of them is.

A cell leaves ``answer = ...`` open.  What the reader puts there is checked here, so that the cell
itself does not tell.
"""

import html
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from s4a.analysis.transfer import transfer_scalars
from s4a.datasets.synthetic import LABELS, position
from s4a.geometry.mesh import as_arrays, triangle_areas, vertex_areas
from s4a.method.nearest import nearest_rows
from s4a.method.spectral import project, reconstruct, unit_area


class Exercise(NamedTuple):
    """An exercise: what is expected of its answer, and where to look.

    `expected` takes what the cell gives after its answer, and gives the right answer, or a
    function of the answer that says whether it is right.
    """

    expected: Callable[..., Any]
    hint: str
    within: float = 0.01


class Said(str):
    """What is said of an answer, which a notebook shows as words and not as a value."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        words = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(self))
        return f"<p>{words}</p>"


def check(number: str, answer: Any, *given: Any) -> str:
    """Check the answer to an exercise of the course.

    Parameters
    ----------
    number : str
        Of lesson and exercise, such as ``"02.1"``.
    answer : object
        ``...`` stands for none.
    *given : object
        What the right answer depends on, as the cell of the exercise has it.

    Returns
    -------
    str
        That it is right, or that there is none yet and where to look: an open exercise is no error.

    Raises
    ------
    AssertionError
        When the answer is not the right one.

    Examples
    --------
    >>> from s4a.course import check
    >>> check("02.1", ...)
    'No answer yet: put yours in the place of the dots of `answer = ...`. Hint: ...'
    >>> check("02.1", 9)
    Traceback (most recent call last):
    ...
    AssertionError: Not yet: the answer is 9. Hint: ...
    """
    exercise = EXERCISES[number]
    if answer is ...:
        return judge(answer, None, exercise.hint)
    return judge(answer, exercise.expected(*given), exercise.hint, within=exercise.within)


def judge(answer: Any, expected: Any, hint: str = "", *, within: float = 0.01) -> str:
    """Compare an answer with what is expected of it, for exercises of your own.

    Parameters
    ----------
    answer : object
        ``...`` stands for none.
    expected : array_like, str, bool or callable
        The right answer, or a function of the answer that says whether it is right.
    hint : str
        Where to look; said when the answer is missing or wrong.
    within : float
        How far numbers may be from the right ones, as a share of the largest of these.

    Returns
    -------
    str
        That it is right, or that there is none yet and where to look.

    Raises
    ------
    AssertionError
        When the answer is not the right one.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.course import judge
    >>> judge(6.28, 2 * np.pi)
    'Right.'
    >>> judge(3.1, 2 * np.pi, "once around")
    Traceback (most recent call last):
    ...
    AssertionError: Not yet: the answer is 3.1. Hint: once around.
    """
    hint = f" Hint: {hint}{'' if hint.endswith(('.', '?')) else '.'}" if hint else ""
    if answer is ...:
        return Said(f"No answer yet: put yours in the place of the dots of `answer = ...`.{hint}")
    if callable(expected):
        try:
            right = bool(expected(answer))
        except (TypeError, ValueError, IndexError, AttributeError):  # of an answer of another kind
            right = False
    elif np.asarray(expected).dtype.kind in "iuf":
        right = _near(answer, np.asarray(expected, float), within)
    else:
        right = np.array_equal(answer, expected)
    if not right:
        raise _shown(f"Not yet: the answer is {_told(answer)}.{hint}")
    return Said("Right.")


def _shown(message):
    """The error, which IPython shows without the way it took through this file."""
    error = AssertionError(message)
    setattr(error, "_render_traceback_", lambda: [message])  # noqa: B010, IPython looks for it
    return error


def _shape(answer):
    """The shape of an answer as an array; None where its rows are of several lengths."""
    try:
        return np.shape(answer)
    except ValueError:
        return None


def _near(answer, expected, within):
    if _shape(answer) != expected.shape:
        return False
    answer = np.asarray(answer)
    if answer.dtype.kind not in "iuf":
        return False
    return bool((np.abs(answer - expected) <= within * np.abs(expected).max(initial=0)).all())


def _told(answer):
    """The answer in a few words."""
    shape = _shape(answer) if not isinstance(answer, str | dict | set) else ()
    return f"an array of shape {shape}" if shape else f"{answer!r:.60}"


def _rms(brain, k):
    """How far `k` functions leave the vertices from their places, a share of sqrt(area)."""
    gap = reconstruct(brain, brain["position"].values, k=k) - brain["position"].values
    size = brain["vertex_area"].values.sum() ** 0.5
    return np.sqrt(unit_area(brain) @ (gap**2).sum(1)) / size


def _deviation_of_details(U, brain, coarse):
    gap = U @ coarse["position"].values - brain["position"].values
    area = vertex_areas(*as_arrays(brain))
    return np.sqrt(area @ (gap**2).sum(1) / area.sum())


def _is_wrong_everywhere_and_no_set_tells(match, n):
    match = np.asarray(match)
    moved = match.shape == (n,) and bool((match != np.arange(n)).all())
    return moved and np.array_equal(np.unique(match), np.arange(n))


def _overlap(carried, own, name):
    ours, theirs = (labels == LABELS.index(name) for labels in (carried, own))
    return 2 * (ours & theirs).sum() / (ours.sum() + theirs.sum())


def _loop(Y, *cycle):
    """The cycle error of the maps of the latent space."""
    C = np.eye(Y.shape[1])
    for i, j in zip(cycle, (*cycle[1:], cycle[0]), strict=True):
        C = Y[j] @ np.linalg.pinv(Y[i]) @ C
    return np.linalg.norm(C - np.eye(len(C))) / np.sqrt(len(C))


def _correlation_carried(pair, field):
    there = transfer_scalars(pair, field.parts["left"], source="left")["right/field"]
    return np.corrcoef(np.asarray(there), field.parts["right"])[0, 1]


def _directional_share(found):
    """Of the sums of squares of sides, and of individuals x sides."""
    _, sides, rest = found["sum_of_squares"].values
    return sides / (sides + rest)


def _moved_by_age(fit, years):
    return years * np.linalg.norm(fit["effect"].values, axis=1).max()


EXERCISES = {
    "00.1": Exercise(
        lambda study: study["latent"]["distance_to_median"].idxmin().item(),
        "the node /latent keeps it in its attributes: study['latent'].attrs",
    ),
    "00.2": Exercise(
        lambda study: study["pca"]["explained_variance_ratio"].values[:2].sum(),
        "/pca has the variable explained_variance_ratio",
    ),
    "00.3": Exercise(
        lambda study: abs(study["pca"]["score"][:, 0]).idxmax().item(),
        "/pca has the variable score, a row for each shape; both signs count",
    ),
    "01.1": Exercise(
        lambda report: report["components"].sel(shape="brain_01").item(),
        "the report has a variable with this name",
    ),
    "01.2": Exercise(
        lambda mesh: triangle_areas(*as_arrays(mesh)).sum() / 100,
        "add up s4a.course.triangle_areas of its arrays; 1 cm² is 100 mm²",
    ),
    "01.3": Exercise(
        lambda brain: lambda v: brain["file_vertex"].values[v] == 1000,
        "vertex_of_file looks up a row of the file",
    ),
    "02.1": Exercise(lambda: 100, "degree l has 2 l + 1 functions; add them up", 0),
    "02.2": Exercise(
        lambda sphere: (
            sphere["eigenfunction"].values.T @ (unit_area(sphere) * sphere["position"].values[:, 2])
        ),
        "the coefficients are Φᵀ A f, and A is the diagonal matrix of `area`",
    ),
    "02.3": Exercise(
        lambda brain: lambda k: _rms(brain, k) < 0.01 <= _rms(brain, k - 1),
        "call s4a.reconstruct(brain, position, k=k) for growing k",
    ),
    "03.1": Exercise(
        lambda U: U.shape[0] * U.shape[1] / U.nnz, "compare U.nnz with the product of U.shape"
    ),
    "03.2": Exercise(
        lambda coarse: coarse["vertex_area"].values,
        "each original vertex gives its area to its columns: Uᵀ times the areas",
    ),
    "03.3": Exercise(_deviation_of_details, "weigh the squared distances with area / area.sum()"),
    "04.1": Exercise(
        lambda C, a, Psi, area: lambda g: np.allclose(project(Psi[:, :20], area, g), C @ a),
        "b = C a are coefficients on the target; Psi[:, :20] turns them into values",
    ),
    "04.2": Exercise(
        lambda C, back: np.linalg.norm(back @ C - np.eye(20)) / np.sqrt(20),
        "np.linalg.norm gives the Frobenius norm; C acts first",
    ),
    "04.3": Exercise(
        lambda C, C_mirror: (
            lambda modes: sorted(modes) == [i for i in range(1, 9) if C[i, i] * C_mirror[i, i] < 0]
        ),
        "an odd eigenfunction has diagonal entries of opposite sign in the two matrices",
    ),
    "05.1": Exercise(lambda: 17, "once before each growth of C, and once for the final C", 0),
    "05.2": Exercise(
        lambda Phi, Psi, A, C: (
            Psi[:, :25].T @ (A[:, None] * Phi[nearest_rows(Psi[:, :20], Phi[:, :20] @ C.T), :25])
        ),
        "nearest_rows of Psi among Phi Cᵀ, 20 columns each; then as_map with 25",
    ),
    "05.3": Exercise(lambda gap: np.mean(gap > 5), "`after` has the errors in %"),
    "06.1": Exercise(lambda: 20_825, "choose 3 of 51", 0),
    "06.2": Exercise(
        lambda Y: lambda C: np.shape(C) == (60, 60) and np.allclose(C @ Y[0], Y[3], atol=1e-6),
        "np.linalg.pinv; shape 0 is the source",
    ),
    "06.3": Exercise(
        lambda Y: lambda e: abs(e - _loop(Y, 0, 3, 5)) < 1e-6,
        "compose three maps Y_j pinv(Y_i), subtract I, take the Frobenius norm / √60",
    ),
    "07.1": Exercise(
        lambda D: (
            lambda mean: np.shape(mean) == D.shape[1:] and np.allclose(mean, D.mean(0), atol=1e-6)
        ),
        "D has the shape as its first axis",
    ),
    "07.2": Exercise(
        lambda: lambda d: abs(d) < 1e-12,
        "both are scaled to unit area before: what is left of the difference?",
    ),
    "07.3": Exercise(
        lambda latent: latent["distance_to_median"].values,
        "(D - I)[:, 1:, 1:] / latent_eigenvalue[1:], then norms over the last two axes",
    ),
    "08.1": Exercise(lambda: 10**10, "every row of one with every row of the other", 0),
    "08.2": Exercise(
        lambda: lambda gap: 0 <= gap < 1e-6,
        "apply the function `smooth` to the field `smoothed`",
    ),
    "08.3": Exercise(
        lambda match, n: 1 - np.unique(match).size / n,
        "np.unique(match) are those that are matched",
        0.001,
    ),
    "09.1": Exercise(
        lambda pca: 1 + np.searchsorted(np.cumsum(pca["explained_variance_ratio"].values), 0.9),
        "np.cumsum of the ratios; look for the first of at least 0.9",
    ),
    "09.2": Exercise(
        lambda registration: (
            (registration["position"] + registration["displacement"].sel(shape="brain_02")).values
        ),
        "np.tensordot(s, D, axes=1) adds up; the mean is X + mean_displacement",
        1e-4,
    ),
    "09.3": Exercise(
        lambda: lambda product: abs(product) < 1e-3,
        "sum over the vertices of area times D[0] · D[1], by the sum of the areas",
    ),
    "10.1": Exercise(
        lambda X: np.linalg.norm(X - X[0], axis=1).mean(),
        "metrics.chamfer takes two arrays of points; the image is X[match]",
    ),
    "10.2": Exercise(
        lambda mean: (
            mean["seconds"].sel(way="FMAP+ZO") / mean["seconds"].sel(way="RE-MATCH")
        ).item(),
        "mean['seconds'].sel(way=...) has those of a method",
    ),
    "10.3": Exercise(
        lambda n: lambda match: _is_wrong_everywhere_and_no_set_tells(match, n),
        "each vertex may be hit once: which orders of 0 to n - 1 leave none in its place?",
    ),
    "11.1": Exercise(
        lambda carried, target: _overlap(carried, target["label"].values, "cerebellum left"),
        "metrics.dice gives a dict; LABELS.index gives the number",
    ),
    "11.2": Exercise(
        lambda carried, target: (
            np.bincount(carried, vertex_areas(*as_arrays(target)))[LABELS.index("occipital right")]
            / 100
        ),
        "`areas` of brain_04, summed where the label is that; 1 cm² is 100 mm²",
    ),
    "11.3": Exercise(
        lambda brains, target: np.corrcoef(
            position(
                brains["truth"], "brain_05", brains["truth/brain_02/reference_point"].values
            ).T[2],
            target["position"].values.T[2],
        )[0, 1],
        "s4a.transfer_scalars(pairwise, height, ...), then np.corrcoef with the third coordinate",
        0.02,
    ),
    "12.1": Exercise(lambda: 0.1, "three of six can be chosen in 20 ways"),
    "12.2": Exercise(
        lambda found: (
            np.mean(found["p_vertex"].values < 0.05) - np.mean(found["p_family_wise"].values < 0.05)
        ),
        "p_vertex and p_family_wise of `found`, two masks and np.mean",
    ),
    "12.3": Exercise(
        lambda fit: _moved_by_age(fit, 10),
        "the effect of `fit` is a vector for each vertex, in mm per year",
    ),
    "13.1": Exercise(
        lambda report: report["shape"].values[report["status"].values != "ok"].tolist(),
        "report['status'] has a value for each report['shape']",
    ),
    "13.2": Exercise(
        lambda image: (
            (np.asarray(image.dataobj) == 1).sum() * abs(np.linalg.det(image.affine)) / 1000
        ),
        "voxels times the volume of a voxel, here 2.4 × 2.4 × 3.6 mm³",
    ),
    "13.3": Exercise(
        lambda study: study["coarse/subject_4/eigenfunction"].shape[0],
        "xr.open_dataset reads study/coarse/subject_4.nc; a Dataset has .sizes",
        0,
    ),
    "14.1": Exercise(
        lambda mesh: triangle_areas(*as_arrays(mesh)).sum() / 100,
        "its attributes have what cleaning measured; 1 cm² is 100 mm²",
    ),
    "14.2": Exercise(
        _correlation_carried,
        "as with the depth: transfer_scalars, np.corrcoef",
    ),
    "14.3": Exercise(
        lambda field, own, confidence: np.corrcoef(
            *(v[confidence <= np.median(confidence)] for v in (field, own))
        )[0, 1],
        "a mask: confidence <= np.median(confidence)",
        0.002,
    ),
    "15.1": Exercise(
        lambda: 6,
        "n subjects have 2 ** (n - 1) different changes of sign, and one of them is what was "
        "measured",
        0,
    ),
    "15.2": Exercise(
        _directional_share,
        "the variance_share of `found`: sides, beside individuals x sides",
    ),
    "15.3": Exercise(
        lambda found: found["fluctuating_size"].idxmax().item(),
        "`found` has a fluctuating_size for each individual",
    ),
    "16.1": Exercise(
        lambda half, truth: np.linalg.norm(half["position"] - truth, axis=1)[
            half["present"].values == 1
        ].mean(),
        "the distance at each vertex, then the mean where `present` is 1",
    ),
    "16.2": Exercise(
        lambda found: found["level_share"].sel(level="between").sum().item(),
        "`level_share` of `found`, level between, both structures added up",
        0.005,
    ),
    "16.3": Exercise(
        lambda found: np.degrees(np.sqrt((found["pose_rotation"].values ** 2).sum(2)).max()),
        "the length of each vector of `pose_rotation`, the largest, in degrees",
    ),
    "17.1": Exercise(
        lambda: 6,
        "n children seen twice have 2 ** n orders, of which two give the same statistic",
        0,
    ),
    "17.2": Exercise(
        lambda fit: float((fit["effect"].values ** 2).sum(1).max() ** 0.5),
        "`effect` has three coordinates at every vertex, in mm per year",
    ),
    "17.3": Exercise(
        lambda thick: (thick["p_false_discovery"] <= 0.05).mean().item(),
        "`thick` has a p_false_discovery for each vertex",
    ),
}
