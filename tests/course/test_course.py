"""Exercises, quizzes and pictures of the course."""

import base64
import io
import re

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from s4a.course import check, diagrams, judge, quiz, slide, takeaway
from s4a.course.exercises import EXERCISES, HERE, Quiz, read
from s4a.datasets.synthetic import sphere
from s4a.method.latent import consistency_form
from s4a.show.charts import PALE, matrices, network, on_circle, surfaces, variance

DIAGRAMS = ["cotangents", "dual", "pull_back", "latent_space", "two_methods", "slid"]


def test_an_open_exercise_says_what_to_do_and_hints():
    feedback = judge(..., 3, "count them")
    assert re.fullmatch(r"No answer yet: .*dots.* Hint: count them\.", feedback)


@pytest.mark.parametrize(
    "answer, expected",
    [
        (3.005, 3),
        (np.float32(3), 3),
        ([1, 2.0], np.array([1.0, 2.001])),
        ("brain_01", "brain_01"),
        ([1, 4], [1, 4]),
        (True, True),
        (7, lambda n: n % 7 == 0),
    ],
)
def test_a_right_answer_passes(answer, expected):
    assert judge(answer, expected) == "Right."


@pytest.mark.parametrize(
    "answer, expected",
    [
        (3.1, 3),
        ("3", 3),
        (None, 3),
        (np.nan, 3),
        ([1.0, 2.0, 3.0], np.ones(2)),
        ([[1], [1, 2]], 3),
        ([[1], [1, 2]], lambda n: n > 0),
        (np.zeros(2), lambda n: n > 0),
        (np.ones((2, 1)), np.ones(2)),
        ("brain_02", "brain_01"),
        ([1], [1, 4]),
        (False, True),
        (8, lambda n: n % 7 == 0),
    ],
)
def test_a_wrong_answer_fails_with_itself_and_the_hint(answer, expected):
    with pytest.raises(AssertionError, match=r"Not yet: the answer is .+ Hint: look again\."):
        judge(answer, expected, "look again")


def test_an_array_is_reported_by_its_shape():
    with pytest.raises(AssertionError, match=r"an array of shape \(2, 3\)"):
        judge(np.zeros((2, 3)), np.zeros(3))


def test_a_slider_redraws_its_picture_without_a_cell_that_captures_output():
    ipywidgets = pytest.importorskip("ipywidgets")
    drawn = []

    def draw(n, shade):
        drawn.append((n, shade))
        figure = Figure(figsize=(2, 1))
        figure.subplots().bar(range(n), range(n), color=str(shade))
        return figure

    n = ipywidgets.IntSlider(3, 1, 9)
    shade = ipywidgets.FloatSlider(0.5, min=0, max=1, description="grey")
    box = slide(draw, n=n, shade=shade)
    *sliders, message, picture = box.children
    assert sliders == [n, shade]
    assert (n.description, shade.description) == ("n", "grey")
    before = picture.value
    pixels = Image.open(io.BytesIO(before)).size
    widest = int(re.fullmatch(r"min\(100%, (\d+)px\)", picture.layout.width)[1])
    assert pixels[0] / 2 < widest < pixels[0], "read from afar, and sharp"
    n.value = 5
    assert picture.value != before
    assert drawn == [(3, 0.5), (5, 0.5)]
    n.value = 0 + 1
    shade.value = 0.75
    assert drawn[-1] == (1, 0.75)
    assert message.value == ""
    assert not any(isinstance(part, ipywidgets.Output) for part in box.children)


def test_an_error_of_a_slider_is_shown_and_goes_with_the_next_picture():
    ipywidgets = pytest.importorskip("ipywidgets")

    def draw(n):
        if n > 3:
            raise ValueError("at most <3>")
        return Figure(figsize=(1, 1))

    n = ipywidgets.IntSlider(3, 1, 9)
    _, message, picture = slide(draw, n=n).children
    before = picture.value
    n.value = 5
    assert message.value == "<pre>ValueError: at most &lt;3&gt;</pre>"
    assert picture.value == before
    n.value = 2
    assert message.value == ""


def test_an_exercise_is_named_and_needs_nothing_while_it_is_open():
    for number in EXERCISES:
        assert re.match(r"No answer yet: .*Hint: .{10,}", check(number, ...)), number
    assert check("06.1", 20_825) == "Right."
    with pytest.raises(AssertionError, match="Not yet"):
        check("06.1", 20_824)
    with pytest.raises(KeyError):
        check("99.1", 1)


BASIS = np.random.default_rng(0).normal(size=(30, 20))


@pytest.mark.parametrize(
    "number, answer, given",
    [
        ("01.3", 10**6, (sphere(162).assign(file_vertex=("vertex", np.arange(162))),)),
        ("02.3", 3.0, (sphere(162),)),
        ("04.1", None, (np.eye(20), np.ones(20), BASIS, np.ones(30))),
        ("04.3", 3, (np.eye(9), -np.eye(9))),
        ("06.3", np.zeros(3), (np.tile(np.eye(4), (6, 1, 1)),)),
        ("07.2", np.zeros((60, 60)), ()),
        ("07.2", "nothing", ()),
        ("08.2", np.zeros(4), ()),
        ("09.3", np.zeros((3, 3)), ()),
    ],
)
def test_a_wrong_answer_of_another_kind_gets_the_hint(number, answer, given):
    with pytest.raises(AssertionError, match=r"Not yet: the answer is .+ Hint: "):
        check(number, answer, *given)


def test_the_odd_eigenfunctions_may_be_a_list_or_a_set():
    C = np.diag([1.0, 1, -1, 1, -1, 1, 1, 1, 1])
    for answer in ([2, 4], {2, 4}, np.array([2, 4])):
        assert check("04.3", answer, C, np.eye(9)) == "Right."
    with pytest.raises(AssertionError, match="Not yet"):
        check("04.3", {2, 3}, C, np.eye(9))


def test_values_that_are_unknown_are_grey_and_leave_the_others_as_they_are():
    ball = sphere(162)
    height = ball["position"].values[:, 2]
    some = np.where(np.arange(162) == 5, np.nan, height)
    limit = np.quantile(abs(np.delete(height, 5)), 0.99)
    shown, bar = surfaces({"a": ball}, {"a": some}).axes
    expected = surfaces({"a": ball}, {"a": some}, limit=limit).axes[0]
    np.testing.assert_array_equal(shown.images[0].get_array(), expected.images[0].get_array())
    assert bar.get_ylim() == pytest.approx((-limit, limit))
    unknown = surfaces({"a": ball}, {"a": np.full(162, np.nan)}).axes[0].images[0].get_array()
    assert np.ptp(unknown[unknown[..., 3] == 255, :3].astype(int), axis=1).max() <= 1  # grey


def test_maps_of_unknown_error_are_grey_lines_below_the_others():
    ends = np.array([0, 1, 2]), np.array([1, 2, 0])
    errors = {"after": np.array([np.nan, 0.2, 0.1]), "unknown": np.full(3, np.nan)}
    one, other, _ = network(on_circle(3), list("abc"), *ends, errors).axes
    for ax, n in ((one, 1), (other, 3)):
        [lines] = ax.collections[:1]
        colors = lines.get_colors()
        np.testing.assert_allclose(colors[:n, :3], [to_rgb(PALE)] * n)
        assert (np.ptp(colors[n:, :3], axis=1) > 0.1).all()


LESSONS = read((HERE / "quizzes.md").read_text(encoding="utf-8"))
each_quiz = pytest.mark.parametrize("lesson", LESSONS)


@each_quiz
def test_a_quiz_has_three_questions_of_which_one_answer_is_right_and_all_say_why(lesson):
    assert len(LESSONS[lesson]) == 3
    for question in LESSONS[lesson]:
        assert question.text.endswith("?")
        assert len(question.answers) == 3
        assert sum(answer.right for answer in question.answers) == 1
        for answer in question.answers:
            assert re.fullmatch(r".*\w.*[.?]", answer.text)
            assert re.fullmatch(r".{9,}[.?]", answer.explanation)


def test_right_answers_occur_at_all_positions():
    questions = [question for lesson in LESSONS.values() for question in lesson]
    positions = [[a.right for a in question.answers].index(True) for question in questions]
    assert min(positions.count(position) for position in range(3)) > len(questions) / 6


def test_a_quiz_is_shut_until_an_answer_is_clicked_and_needs_no_script():
    shown = quiz("02")._repr_html_()
    assert shown.count("<details") == shown.count("</details>") == 9
    assert " open" not in shown
    assert "<script" not in shown
    assert shown.count("<b>Right.</b>") == 3
    names = re.findall(r'name="([^"]+)"', shown)
    assert sorted(set(names)) == ["quiz-02-1", "quiz-02-2", "quiz-02-3"], "one open at a time"
    text = repr(quiz("02"))
    for question in LESSONS["02"]:
        assert question.text in text
        assert all(answer.text in text for answer in question.answers)
        assert not any(answer.explanation in text for answer in question.answers)


def test_a_quiz_of_no_lesson_is_an_error():
    with pytest.raises(ValueError, match=r"no quiz of lesson '77'; the lessons are 00, 01"):
        quiz("77")


def test_a_question_is_read_from_a_task_list_and_its_text_is_escaped():
    text = (
        "# T\n\n## 01\n\nIs 1 < 2\nby `f(x)`?\n\n- [ ] *No*.\n  It is.\n- [x] Yes.\n  So it is.\n"
    )
    [question] = read(text)["01"]
    assert question.text == "Is 1 < 2 by `f(x)`?"
    assert sorted((a.text, a.right, a.explanation) for a in question.answers) == [
        ("*No*.", False, "It is."),
        ("Yes.", True, "So it is."),
    ]
    shown = Quiz("01", [question])._repr_html_()
    assert "Is 1 &lt; 2 by <code>f(x)</code>?" in shown
    assert "<em>No</em>." in shown


def test_a_takeaway_has_its_pictures_side_by_side_and_none_of_them_small():
    figures = variance([0.7, 0.3]), matrices({"C": np.eye(3)})
    whole = takeaway("A sentence.", *figures)
    assert whole.get_suptitle() == "A sentence."
    boxes = [ax.get_position() for ax in whole.axes]
    assert len(boxes) == 2
    assert boxes[0].x1 <= boxes[1].x0
    for ax, box in zip(whole.axes, boxes, strict=True):
        high, wide = ax.images[0].get_array().shape[:2]
        pixels = box.width * whole.get_figwidth() * whole.dpi
        assert pixels > 300
        assert pixels / (box.height * whole.get_figheight() * whole.dpi) == pytest.approx(
            wide / high, rel=0.02
        )


@pytest.mark.parametrize("name", DIAGRAMS)
def test_texts_of_a_diagram_do_not_overlap_and_are_inside(name):
    figure = getattr(diagrams, name)()
    figure.canvas.draw()
    for ax in figure.axes:
        texts = [text for text in (*ax.texts, ax.title) if text.get_text()]
        assert texts
        boxes = [text.get_window_extent() for text in texts]
        for i, box in enumerate(boxes):
            assert figure.bbox.x0 <= box.x0, texts[i]
            assert box.x1 <= figure.bbox.x1, texts[i]
            assert figure.bbox.y0 <= box.y0, texts[i]
            assert box.y1 <= figure.bbox.y1, texts[i]
            for j in range(i):
                assert not box.overlaps(boxes[j]), (texts[i], texts[j])


@pytest.mark.parametrize("name", DIAGRAMS)
def test_a_diagram_is_shown_in_parts_with_an_alternative_text(name):
    figure = getattr(diagrams, name)()
    shown = figure.html()
    assert shown.count("<img") == len(figure.axes)
    assert "flex-wrap: wrap" in shown
    alt = re.search(r'aria-label="([^"]+)"', shown)[1]
    assert len(alt.split()) > 25
    for ax, data in zip(figure.axes, re.findall(r"base64,([^\"]+)", shown), strict=True):
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("L"))
        assert min(picture.shape) > 300, ax.get_title()
        boundary = np.r_[picture[0], picture[-1], picture[:, 0], picture[:, -1]]
        assert (boundary > 250).mean() > 0.99, "nothing is cut"


def test_pictures_of_surfaces_wrap_in_a_row_and_stay_together_in_rows():
    ball = sphere(162)
    height = ball["position"].values[:, 2]
    row = surfaces({"a": ball, "b": ball}, {"a": height, "b": height}).html()
    assert row.count("<img") == 3, "with the colour bar"
    assert 'aria-label="a, b"' in row
    rows = surfaces(dict.fromkeys("abc", ball), columns=2).html()
    assert rows.count("<img") == 1
    assert takeaway("1 < 2.", variance([0.7]), variance([0.6])).html().count("1 &lt; 2.") == 2


def test_pictures_in_one_frame_show_which_surface_is_larger():
    ball = sphere(162)
    shapes = {"whole": ball, "half": ball.assign(position=0.5 * ball["position"])}

    def pixels(figure):
        return [np.count_nonzero(ax.images[0].get_array()[..., 3]) for ax in figure.axes]

    whole, half = pixels(surfaces(shapes))
    assert half == pytest.approx(whole, rel=0.02)
    whole, half = pixels(surfaces(shapes, one_frame=True))
    assert half == pytest.approx(whole / 4, rel=0.05)


def test_feedback_is_shown_as_text():
    assert judge(3, 3)._repr_html_() == "<p>Right.</p>"
    feedback = check("03.1", ...)._repr_html_()
    assert feedback.startswith("<p>No answer yet:")
    assert "<code>answer = ...</code>" in feedback
    assert "<b" not in judge(..., 3, "is 2 <b 3?")._repr_html_()


def test_the_matrix_of_the_diagram_is_the_form_of_the_latent_basis():
    rng = np.random.default_rng(0)
    C, Y = rng.normal(size=(3, 2, 2)), rng.normal(size=(3, 2, 2))
    source, target = np.array([0, 1, 2]), np.array([1, 2, 0])
    form = consistency_form(C, source, target, np.ones(3), 3)
    rows = [text.get_text().strip("$") for text in diagrams.latent_space().axes[1].texts]
    blocks = [row for row in rows if not row.startswith("Y")]
    names = {"C_{12}": C[0], "C_{23}": C[1], "C_{31}": C[2]}

    def value(block):
        name = re.search(r"C_\{\d\d\}", block)[0]
        if block.startswith("-"):
            return -(names[name].T if "^T" in block else names[name])
        return names[name].T @ names[name] + np.eye(2)

    L = np.block([[value(block) for block in blocks[3 * i : 3 * i + 3]] for i in range(3)])
    np.testing.assert_allclose(L @ Y.reshape(6, 2), form(Y.reshape(6, 2)), atol=1e-12)
