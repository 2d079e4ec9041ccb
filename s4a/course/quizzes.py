"""Quizzes of the notebooks: questions with an explanation of every answer.

The questions are in ``quizzes.md``: a heading for each lesson, a paragraph for each question, and a
task list of its answers, in which the right one is ticked.  The explanation of an answer is on the
next line.  A quiz is plain HTML: it works without a kernel, on a page and in a slide.
"""

import html
import re
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

SOURCE = Path(__file__).parent / "quizzes.md"
PAGE = SOURCE.with_name("quiz.html")


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
        page = pages.from_string(PAGE.read_text(encoding="utf-8"))
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
    known = read(SOURCE.read_text(encoding="utf-8"))
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
