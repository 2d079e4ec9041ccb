"""Exercises and quizzes of the notebooks: right answers, and the check of a reader's answer.

A cell has ``answer = ...``, which the reader replaces.  The right answers are here, so that the
cell does not show them.

The questions of a quiz are in ``quizzes.md``: a heading for each lesson, a paragraph for each
question, and a task list of its answers, in which the right one is ticked.  The explanation of an
answer is on the next line.  A quiz is plain HTML: it works without a kernel, on a page and in a
slide.
"""

import html
import re
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from s4a.analysis.transfer import transfer_scalars
from s4a.datasets.synthetic import LABELS, position
from s4a.evaluation.metrics import dice
from s4a.geometry.mesh import as_arrays, triangle_areas, vertex_areas
from s4a.method.nearest import nearest_rows
from s4a.method.spectral import project, reconstruct, unit_area

HERE = Path(__file__).parent


class Feedback(str):
    """Feedback on an answer, which a notebook shows as text instead of a quoted string."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        text = re.sub(r"`([^`]+)`", r"<code>\1</code>", html.escape(self))
        return f"<p>{text}</p>"


def check(number: str, answer: Any, *given: Any) -> str:
    """Check the answer to an exercise of the course.

    Parameters
    ----------
    number : str
        Number of lesson and exercise, such as ``"02.1"``.
    answer : object
        Answer of the reader; ``...`` stands for none.
    *given : object
        Variables of the lesson from which the right answer is computed.

    Returns
    -------
    str
        ``"Right."``, or a hint if there is no answer yet, which is not an error.

    Raises
    ------
    AssertionError
        If the answer is wrong.

    See Also
    --------
    judge : check an answer to an exercise of your own

    Examples
    --------
    >>> from s4a.course import check
    >>> check("02.1", ...)
    'No answer yet: replace the dots in `answer = ...`. Hint: ...'
    >>> check("02.1", 9)
    Traceback (most recent call last):
    ...
    AssertionError: Not yet: the answer is 9. Hint: ...
    """
    expected = EXERCISES[number]
    if answer is not ... and callable(expected):
        expected = expected(*given)
    return judge(answer, expected, hints()[number], within=WITHIN.get(number, 0.01))


def hints() -> dict[str, str]:
    """Return the hint of each exercise, from ``hints.md``."""
    text = (HERE / "hints.md").read_text(encoding="utf-8")
    return dict(re.findall(r"^- (\d\d\.\d): (.+)$", text, re.MULTILINE))


def judge(answer: Any, expected: Any, hint: str = "", *, within: float = 0.01) -> str:
    """Check an answer to an exercise of your own.

    Parameters
    ----------
    answer : object
        Answer of the reader; ``...`` stands for none.
    expected : array_like, str, bool or callable
        Right answer, or a function of the answer that returns True if it is right.
    hint : str
        Hint that is shown if the answer is missing or wrong.
    within : float
        Tolerance of numbers, relative to the largest absolute value of `expected`.

    Returns
    -------
    str
        ``"Right."``, or the hint if there is no answer yet.

    Raises
    ------
    AssertionError
        If the answer is wrong.

    See Also
    --------
    check : check an answer to an exercise of the course

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
        return Feedback(f"No answer yet: replace the dots in `answer = ...`.{hint}")
    if callable(expected):
        try:
            right = bool(expected(answer))
        except (TypeError, ValueError, IndexError, AttributeError):  # an answer of another type
            right = False
    elif np.asarray(expected).dtype.kind in "iuf":
        right = _is_close(answer, np.asarray(expected, float), within)
    else:
        right = np.array_equal(answer, expected)
    if not right:
        raise _without_traceback(f"Not yet: the answer is {_summary(answer)}.{hint}")
    return Feedback("Right.")


def _without_traceback(message):
    """Return an error that IPython shows without a traceback."""
    error = AssertionError(message)
    setattr(error, "_render_traceback_", lambda: [message])  # noqa: B010, IPython looks for it
    return error


def _shape(answer):
    """Return the shape of an answer as an array, or None if its rows differ in length."""
    try:
        return np.shape(answer)
    except ValueError:
        return None


def _is_close(answer, expected, within):
    if _shape(answer) != expected.shape:
        return False
    answer = np.asarray(answer)
    if answer.dtype.kind not in "iuf":
        return False
    return bool((np.abs(answer - expected) <= within * np.abs(expected).max(initial=0)).all())


def _summary(answer):
    """Return the answer, shortened, or the shape of an array."""
    shape = _shape(answer) if not isinstance(answer, str | dict | set) else ()
    return f"an array of shape {shape}" if shape else f"{answer!r:.60}"


def _reconstruction_error(brain, k):
    """Return the RMS error of positions from `k` eigenfunctions, as a share of sqrt(area)."""
    error = reconstruct(brain, brain["position"].values, k=k) - brain["position"].values
    size = brain["vertex_area"].values.sum() ** 0.5
    return np.sqrt(unit_area(brain) @ (error**2).sum(1)) / size


def _rms_distance(U, brain, coarse):
    """Return the RMS distance between the vertices and the coarse positions transferred by U."""
    difference = U @ coarse["position"].values - brain["position"].values
    area = vertex_areas(*as_arrays(brain))
    return np.sqrt(area @ (difference**2).sum(1) / area.sum())


def _is_derangement(match, n):
    """Return True for a permutation of the vertices that leaves none in place."""
    match = np.asarray(match)
    moved = match.shape == (n,) and bool((match != np.arange(n)).all())
    return moved and np.array_equal(np.unique(match), np.arange(n))


def _cycle_error(Y, *cycle):
    """Return the cycle error of the maps through the latent space."""
    C = np.eye(Y.shape[1])
    for i, j in zip(cycle, (*cycle[1:], cycle[0]), strict=True):
        C = Y[j] @ np.linalg.pinv(Y[i]) @ C
    return np.linalg.norm(C - np.eye(len(C))) / np.sqrt(len(C))


def _correlation_transferred(pair, field):
    """Return the correlation of a field that is transferred from left to right with its own."""
    transferred = transfer_scalars(pair, field.parts["left"], source="left")["right/field"]
    return np.corrcoef(np.asarray(transferred), field.parts["right"])[0, 1]


# quizzes


class Answer(NamedTuple):
    """Possible answer to a question, and its explanation."""

    text: str
    right: bool
    explanation: str


class Question(NamedTuple):
    """Question and its possible answers."""

    text: str
    answers: tuple[Answer, ...]


@dataclass(repr=False)
class Quiz:
    """Questions of a lesson; a click on an answer shows its explanation."""

    lesson: str
    questions: list[Question]

    def __repr__(self) -> str:
        lines = []
        for i, question in enumerate(self.questions, 1):
            lines.append(f"{i}. {question.text}")
            lines += [f"   ( ) {answer.text}" for answer in question.answers]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from jinja2 import Environment

        pages = Environment(trim_blocks=True, autoescape=True)
        pages.filters["marked"] = _marked
        page = pages.from_string((HERE / "quiz.html").read_text(encoding="utf-8"))
        return page.render(lesson=self.lesson, questions=self.questions)


def quiz(lesson: str) -> Quiz:
    """Return the three questions of a lesson; a click on an answer shows why it is right or wrong.

    Parameters
    ----------
    lesson : str
        Number of the lesson, such as ``"02"``.

    Returns
    -------
    Quiz
        Questions and answers, as HTML that needs no kernel, or as text.

    Raises
    ------
    ValueError
        If the lesson has no quiz.

    Examples
    --------
    >>> from s4a.course import quiz
    >>> print(quiz("02"))
    1. ...
       ( ) ...
    """
    known = read((HERE / "quizzes.md").read_text(encoding="utf-8"))
    if lesson not in known:
        raise ValueError(f"no quiz of lesson {lesson!r}; the lessons are {', '.join(known)}")
    return Quiz(lesson, known[lesson])


def read(text: str) -> dict[str, list[Question]]:
    """Read the questions of each lesson from Markdown as in ``quizzes.md``."""
    lessons: dict[str, list[Question]] = {}
    for part in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        lesson, *blocks = re.split(r"\n\s*\n", part.strip())
        questions = []
        for paragraph, task_list in zip(blocks[::2], blocks[1::2], strict=True):
            question = " ".join(paragraph.split())
            items = re.findall(r"- \[([ x])\] (.*)\n  (.*)", task_list)
            answers = [Answer(text, mark == "x", explanation) for mark, text, explanation in items]
            questions.append(Question(question, _shuffled(question, answers)))
        lessons[lesson.split()[0]] = questions
    return lessons


def _shuffled(question, answers):
    """Return the answers in a fixed order that is independent of which one is right."""
    return tuple(sorted(answers, key=lambda a: sha256(f"0{question}{a.text}".encode()).digest()))


def _marked(text):
    """Convert code and emphasis in a line of Markdown to HTML."""
    text = re.sub(r"`(.+?)`", r"<code>\1</code>", html.escape(text, quote=False))
    return Markup(re.sub(r"\*(.+?)\*", r"<em>\1</em>", text))


# exercises

# The right answer, or a function of the arguments that follow the answer in the cell.  It returns
# the right answer, or a function of the answer that returns True if the answer is right.
EXERCISES: dict[str, Any] = {
    "00.1": lambda study: study["latent"]["distance_to_limit"].idxmin().item(),
    "00.2": lambda study: study["pca"]["explained_variance_ratio"].values[:2].sum(),
    "00.3": lambda study: abs(study["pca"]["score"][:, 0]).idxmax().item(),
    "01.1": lambda report: report["components"].sel(shape="brain_01").item(),
    "01.2": lambda mesh: triangle_areas(*as_arrays(mesh)).sum() / 100,
    "01.3": lambda brain: lambda v: brain["file_vertex"].values[v] == 1000,
    "02.1": 100,
    "02.2": lambda sphere: (
        sphere["eigenfunction"].values.T @ (unit_area(sphere) * sphere["position"].values[:, 2])
    ),
    "02.3": lambda brain: (
        lambda k: _reconstruction_error(brain, k) < 0.01 <= _reconstruction_error(brain, k - 1)
    ),
    "03.1": lambda U: U.shape[0] * U.shape[1] / U.nnz,
    "03.2": lambda coarse: coarse["vertex_area"].values,
    "03.3": _rms_distance,
    "04.1": lambda C, a, Psi, area: lambda g: np.allclose(project(Psi[:, :20], area, g), C @ a),
    "04.2": lambda C, back: np.linalg.norm(back @ C - np.eye(20)) / np.sqrt(20),
    "04.3": lambda C, C_mirror: (
        lambda odd: sorted(odd) == [i for i in range(1, 9) if C[i, i] * C_mirror[i, i] < 0]
    ),
    "05.1": 17,
    "05.2": lambda Phi, Psi, A, C: (
        Psi[:, :25].T @ (A[:, None] * Phi[nearest_rows(Psi[:, :20], Phi[:, :20] @ C.T), :25])
    ),
    "05.3": lambda error: np.mean(error > 5),
    "06.1": 20_825,
    "06.2": lambda Y: lambda C: np.shape(C) == (60, 60) and np.allclose(C @ Y[0], Y[3], atol=1e-6),
    "06.3": lambda Y: lambda e: abs(e - _cycle_error(Y, 0, 3, 5)) < 1e-6,
    "07.1": lambda D: (
        lambda mean: np.shape(mean) == D.shape[1:] and np.allclose(mean, D.mean(0), atol=1e-6)
    ),
    "07.2": lambda: lambda d: abs(d) < 1e-12,
    "07.3": lambda latent: latent["distance_to_limit"].values,
    "08.1": 10**10,
    "08.2": lambda: lambda difference: 0 <= difference < 1e-6,
    "08.3": lambda match, n: 1 - np.unique(match).size / n,
    "09.1": lambda pca: 1 + np.searchsorted(np.cumsum(pca["explained_variance_ratio"].values), 0.9),
    "09.2": lambda registration: (
        (registration["position"] + registration["displacement"].sel(shape="brain_02")).values
    ),
    "09.3": lambda: lambda product: abs(product) < 1e-3,
    "10.1": lambda X: np.linalg.norm(X - X[0], axis=1).mean(),
    "10.2": lambda mean: (
        mean["seconds"].sel(algorithm="FMAP+ZO") / mean["seconds"].sel(algorithm="RE-MATCH")
    ).item(),
    "10.3": lambda n: lambda match: _is_derangement(match, n),
    "11.1": lambda labels, target: dice(labels, target["label"])[LABELS.index("cerebellum left")],
    "11.2": lambda labels, target: (
        np.bincount(labels, vertex_areas(*as_arrays(target)))[LABELS.index("occipital right")] / 100
    ),
    "11.3": lambda brains, target: np.corrcoef(
        position(brains["truth"], "brain_05", brains["truth/brain_02/reference_point"].values).T[2],
        target["position"].values.T[2],
    )[0, 1],
    "12.1": 0.1,
    "12.2": lambda test: (
        np.mean(test["p_vertex"].values < 0.05) - np.mean(test["p_family_wise"].values < 0.05)
    ),
    "12.3": lambda fit: 10 * np.linalg.norm(fit["effect"].values, axis=1).max(),
    "13.1": lambda report: report["shape"].values[report["status"].values != "ok"].tolist(),
    "13.2": lambda image: (
        (np.asarray(image.dataobj) == 1).sum() * abs(np.linalg.det(image.affine)) / 1000
    ),
    "13.3": lambda study: study["coarse/subject_4/eigenfunction"].shape[0],
    "14.1": lambda mesh: triangle_areas(*as_arrays(mesh)).sum() / 100,
    "14.2": _correlation_transferred,
    "14.3": lambda field, own, confidence: np.corrcoef(
        *(v[confidence <= np.median(confidence)] for v in (field, own))
    )[0, 1],
    "15.1": 6,
    "15.2": lambda a: a["sum_of_squares"].values[1] / a["sum_of_squares"].values[1:].sum(),
    "15.3": lambda asymmetries: asymmetries["fluctuating_size"].idxmax().item(),
    "16.1": lambda half, truth: np.linalg.norm(half["position"] - truth, axis=1)[
        half["present"].values == 1
    ].mean(),
    "16.2": lambda poses: poses["level_share"].sel(level="between").sum().item(),
    "16.3": lambda poses: np.degrees(np.sqrt((poses["pose_rotation"].values ** 2).sum(2)).max()),
    "17.1": 6,
    "17.2": lambda fit: float((fit["effect"].values ** 2).sum(1).max() ** 0.5),
    "17.3": lambda thick: (thick["p_false_discovery"] <= 0.05).mean().item(),
}
# tolerances (`within` of `judge`) other than 0.01
WITHIN = dict.fromkeys(("02.1", "05.1", "06.1", "08.1", "13.3", "15.1", "17.1"), 0.0)
WITHIN |= {"08.3": 0.001, "09.2": 0.0001, "11.3": 0.02, "14.3": 0.002, "16.2": 0.005}
