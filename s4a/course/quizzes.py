"""Quizzes of the notebooks: questions that say, for every answer, why it is right or wrong.

They stand in ``quizzes.md``, a heading for each lesson, a paragraph for each question and a task
list of its answers, of which the right one is ticked.  What is said of an answer follows it on the
next line.  A quiz is plain HTML: it works without a kernel, on a page and in a slide.
"""

import html
import re
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

SOURCE = Path(__file__).parent / "quizzes.md"
STYLE = """
.s4a-quiz { max-width: 46em; line-height: 1.45; }
.s4a-quiz p { margin: 0.9em 0 0.3em; }
.s4a-quiz details { margin: 0.25em 0; border: 1px solid #8888; border-radius: 4px; }
.s4a-quiz summary { padding: 0.3em 0.6em; cursor: pointer; }
.s4a-quiz details div { padding: 0.3em 0.9em 0.5em; border-left: 5px solid #d55e00; }
.s4a-quiz details.right div { border-left-color: #009e73; }
"""


class Answer(NamedTuple):
    """A possible answer, and what is said to it."""

    text: str
    right: bool
    said: str


class Question(NamedTuple):
    """A question and its possible answers."""

    text: str
    answers: tuple[Answer, ...]


class Quiz:
    """Questions that a notebook and a page show; an answer that is clicked says what it is."""

    def __init__(self, lesson: str, questions: list[Question]) -> None:
        self.lesson = lesson
        self.questions = questions

    def __repr__(self) -> str:
        lines = []
        for i, question in enumerate(self.questions, 1):
            lines.append(f"{i}. {question.text}")
            lines += [f"   ( ) {answer.text}" for answer in question.answers]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        parts = [f'<div class="s4a-quiz"><style>{STYLE}</style>']
        for i, question in enumerate(self.questions, 1):
            parts.append(f"<p><b>{i}.</b> {_marked(question.text)}</p>")
            for answer in question.answers:
                kind, word = ("right", "Right.") if answer.right else ("wrong", "Not this one.")
                parts.append(
                    f'<details class="{kind}" name="quiz-{self.lesson}-{i}">'
                    f"<summary>{_marked(answer.text)}</summary>"
                    f"<div><b>{word}</b> {_marked(answer.said)}</div></details>"
                )
        return "\n".join([*parts, "</div>"])


def quiz(lesson: str) -> Quiz:
    """Three questions on a lesson; a click on an answer says whether it is right, and why.

    Parameters
    ----------
    lesson : str
        Its number, such as ``"02"``.

    Returns
    -------
    Quiz
        Its HTML needs no kernel; as text it has the questions and their answers.

    Raises
    ------
    ValueError
        For a lesson without a quiz.

    Examples
    --------
    >>> from s4a.course import quiz
    >>> print(quiz("02"))
    1. ...
       ( ) ...
    """
    known = read(SOURCE.read_text(encoding="utf-8"))
    if lesson not in known:
        raise ValueError(f"no quiz of lesson {lesson!r}; there are those of {', '.join(known)}")
    return Quiz(lesson, known[lesson])


def read(text: str) -> dict[str, list[Question]]:
    """The questions of each lesson, from Markdown as in ``quizzes.md``."""
    found: dict[str, list[Question]] = {}
    for part in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        lesson, *blocks = re.split(r"\n\s*\n", part.strip())
        questions = []
        for words, listed in zip(blocks[::2], blocks[1::2], strict=True):
            asked = " ".join(words.split())
            each = re.findall(r"- \[([ x])\] (.*)\n  (.*)", listed)
            told = [Answer(given, mark == "x", said) for mark, given, said in each]
            questions.append(Question(asked, _shuffled(asked, told)))
        found[lesson.split()[0]] = questions
    return found


def _shuffled(asked, answers):
    """The answers in an order that is always the same, and tells nothing."""
    return tuple(sorted(answers, key=lambda a: sha256(f"0{asked}{a.text}".encode()).digest()))


def _marked(text):
    """A line of Markdown as HTML: what is code, and what is stressed."""
    text = re.sub(r"`(.+?)`", r"<code>\1</code>", html.escape(text, quote=False))
    return re.sub(r"\*(.+?)\*", r"<em>\1</em>", text)
