"""Without a kernel a notebook shows a note in place of a panel."""

import json

import pytest

from s4a.show.browser import FRAME

nbformat = pytest.importorskip("nbformat")
client = pytest.importorskip("nbclient")
exporters = pytest.importorskip("nbconvert.exporters")
widgets = pytest.importorskip("s4a.widgets")

VIEW, STATE = (f"application/vnd.jupyter.widget-{kind}+json" for kind in ("view", "state"))
SAYS = "writes a page that works without one"
CELLS = """
import s4a
study = s4a.open_study({folder!r})
s4a.explore(study)
s4a.widgets.Median(study)
"""


@pytest.fixture(scope="module")
def executed(study_folder):
    """A notebook with all panels and a single one, as `jupyter nbconvert --execute` runs it."""
    opened, panels, panel = CELLS.format(folder=str(study_folder)).strip().rsplit("\n", 2)
    cells = [nbformat.v4.new_code_cell(text) for text in (opened, panels, panel)]
    notebook = nbformat.v4.new_notebook(cells=cells)
    client.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    return notebook


def stored(notebook, state):
    """A copy of the notebook with the state of its widgets, or without."""
    copy = nbformat.from_dict(json.loads(json.dumps(notebook)))
    if not state:
        del copy.metadata["widgets"]
    return copy


@pytest.mark.parametrize("kind", [exporters.HTMLExporter, exporters.SlidesExporter])
def test_the_sentence_stands_where_no_state_is_stored(executed, kind):
    page, _ = kind().from_notebook_node(stored(executed, state=False))
    assert VIEW not in page
    assert page.count(SAYS) == 2
    assert f"<b>{widgets.Median.title}</b>" in page


@pytest.mark.parametrize("kind", [exporters.HTMLExporter, exporters.SlidesExporter])
def test_widgets_with_their_state_are_kept_as_they_are(executed, kind):
    page, _ = kind().from_notebook_node(stored(executed, state=True))
    assert page.count(f'<script type="{VIEW}">') == 2


# a frame in a page: `manager` is what the front end has, `answers` whether Python does
FRAMED = """<div class="s4a-panel"><div id="at"></div></div><script type="module">
%s
const state = { title: "Panel", help: {}, font: 0 }, heard = [];
window.state = state;
window.answer = () => { state.pong = state.ping; heard.forEach((act) => act()); };
widget.render({ el: document.getElementById("at"), model: {
  widget_manager: %s, saved: %s,
  get: (name) => state[name], set: (name, value) => { state[name] = value; },
  on: (event, act) => event === "change:pong" && heard.push(act), off: () => {},
  save_changes: () => {},
} });
window.ready = true;
</script>"""


@pytest.fixture
def framed(browser):
    """Open a frame in a page with a simulated clock."""
    page = browser.new_page()
    page.clock.install()

    def opened(manager="undefined", saved="false"):
        script = FRAME.replace("export default", "const widget =")
        page.set_content(FRAMED % (script, manager, saved))
        page.wait_for_function("window.ready")
        return page

    yield opened
    page.close()


def test_a_panel_whose_kernel_does_not_answer_says_so_until_it_does(framed):
    page = framed()
    note = page.get_by_role("status")
    page.clock.run_for(4000)
    assert note.count() == 0, "it has time to answer"
    page.clock.run_for(2000)
    assert "does not answer" in note.inner_text()
    assert "save_html" in note.inner_text()
    page.evaluate("answer()")
    assert note.count() == 0
    page.clock.run_for(20_000)
    assert note.count() == 0


def test_a_kernel_that_is_at_work_is_waited_for(framed):
    page = framed("{ kernel: { status: 'busy' } }")
    page.clock.run_for(60_000)
    assert page.get_by_role("status").count() == 0


def test_a_saved_page_asks_for_no_kernel(framed):
    page = framed(saved="true")
    page.clock.run_for(60_000)
    assert page.get_by_role("status").count() == 0
    assert page.evaluate("state.ping") is None


def test_python_answers_what_it_is_asked(study):
    panel = widgets.Median(study)
    panel.frame.ping = 17.0
    assert panel.frame.pong == 17.0
    panel.close()


def test_a_click_on_what_a_saved_page_did_not_keep_says_so(browser, study, tmp_path):
    panel = widgets.Median(study)
    path = panel.save_html(tmp_path / "median.html", limit=0)
    panel.close()
    page = browser.new_page()
    page.goto(path.as_uri())
    page.wait_for_selector("canvas.s4a-view")
    texts = page.locator("#not-recorded")
    assert texts.inner_text() == ""
    other = next(name for name in study["coarse"].children if name != panel.shape.value)
    page.locator(f"rect.s4a-mark[aria-label^='{other}:']").dispatch_event("click")
    assert texts.inner_text().startswith(f"{other} is not recorded in this page")
    page.close()
