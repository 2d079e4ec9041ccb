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

from markupsafe import Markup

SOURCE = Path(__file__).parent / "quizzes.md"
PAGE = SOURCE.with_name("quiz.html")


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
        from jinja2 import Environment

        pages = Environment(trim_blocks=True, autoescape=True)
        pages.filters["marked"] = _marked
        page = pages.from_string(PAGE.read_text(encoding="utf-8"))
        return page.render(lesson=self.lesson, questions=self.questions)


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
    return Markup(re.sub(r"\*(.+?)\*", r"<em>\1</em>", text))
