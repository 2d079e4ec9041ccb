"""The course (notebooks/): exercises that check themselves, quizzes, sliders, diagrams."""

from s4a.course.exercises import check, judge
from s4a.course.quizzes import quiz
from s4a.course.sliders import slide, takeaway

__all__ = ["check", "judge", "quiz", "slide", "takeaway"]
