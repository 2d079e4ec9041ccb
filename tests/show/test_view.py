"""Pictures and the page of a study, on a small simulated study of ellipsoids."""

import base64
import json
import re

import numpy as np
import pytest
import xarray as xr

from s4a import synthetic
from s4a.geometry.mesh import as_arrays
from s4a.schema import dataset
from s4a.show import draw, page
from s4a.show.browser import PARTS, color_scale
from s4a.show.charts import svg, variance
from s4a.show.surfaces import mode_limits

pytestmark = pytest.mark.usefixtures("no_pictures_in_module")
N_SHAPES = 6


def sphere(n=366):
    """Vertices and triangles of a closed sphere."""
    return as_arrays(synthetic.sphere(n))


@pytest.fixture(scope="module")
def study(example_study):
    """The study of examples, with a repaired shape and an excluded one; their texts are HTML."""
    tree = example_study.copy()
    report = tree["report"].to_dataset()
    excluded = report.isel(shape=[0]).assign_coords(shape=["broken <b>"])
    report = xr.concat([report, excluded], "shape", data_vars="minimal")
    reasons = ["3 duplicate triangles removed", "not a surface: <script>alert('&')</script>"]
    tree["report"] = xr.DataTree(
        report.assign(
            status=("shape", ["ok"] * 5 + ["repaired", "excluded"]),
            reason=("shape", [""] * 5 + reasons),
            peak_memory=("stage", np.full(report.sizes["stage"], 1200.0)),
        )
    )
    return tree


@pytest.fixture(scope="module")
def html(study):
    return page.study_html(study, title="Seven <ellipsoids>")


def test_a_sphere_is_drawn_as_a_disk_of_its_area():
    X, T = sphere(3122)
    picture = draw.render(X, T, size=(200, 200))
    assert picture.shape == (200, 200, 4)
    assert picture[..., 3].sum() / 255 == pytest.approx(np.pi * (0.94 * 100) ** 2, rel=0.01)
    assert picture[100, 100, 3] == 255
    assert picture[0, 0, 3] == 0


def test_the_front_surface_hides_the_back_one_in_any_order():
    X, T = sphere()
    both = np.concatenate([X, 0.5 * X + draw.rotation()[2] * 2])
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], len(X), axis=0)
    triangles = np.concatenate([T, T + len(X)])
    pictures = [
        draw.render(both, t, colors=colors, size=(100, 100)) for t in (triangles, triangles[::-1])
    ]
    assert np.array_equal(pictures[0], pictures[1])
    red, _, blue, opacity = pictures[0][50, 50].astype(int)
    assert opacity == 255
    assert blue > red
    red, _, blue, _ = pictures[0][50, 12].astype(int)
    assert red > blue


def test_chunks_do_not_change_the_picture(monkeypatch):
    X, T = sphere()
    whole = draw.render(X, T, size=(80, 60))
    monkeypatch.setattr(draw, "CHUNK", 1000)
    assert np.array_equal(whole, draw.render(X, T, size=(80, 60)))


def test_a_surface_turned_inside_out_looks_the_same():
    X, T = sphere()
    assert np.array_equal(
        draw.render(X, T, size=(80, 60)), draw.render(X, T[:, ::-1], size=(80, 60))
    )


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_the_up_axis_points_up_and_views_are_rotations(up):
    axis = np.eye(3)["xyz".index(up)]
    for name in draw.VIEWS:
        R = draw.rotation(name, up)
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1)
    assert np.allclose(draw.rotation("front", up) @ axis, [0, 1, 0])


def test_labels_are_not_interpolated():
    X, T = sphere()
    colors = draw.label_colors((X[:, 0] > 0).astype(int))
    picture = draw.render(X, T, colors=colors, flat=True, view="top", size=(100, 100))
    inner = picture[10:90, 10:90, :3][picture[10:90, 10:90, 3] == 255].astype(float)
    hue = inner[:, 2] / inner.sum(1)
    # orange has no blue and sky blue is mostly blue:
    # only antialiased samples of the border lie in between
    assert ((hue > 0.15) & (hue < 0.35)).mean() < 0.05


def test_positive_is_blue_negative_is_red_and_unknown_is_grey():
    X, T = sphere()

    def middle(value):
        colors = draw.signed_colors(np.full(len(X), value), 1)
        return draw.render(X, T, colors=colors, size=(60, 60))[30, 30, :3].astype(int)

    assert middle(1)[2] > middle(1)[0] + 50
    assert middle(-1)[0] > middle(-1)[2] + 50
    assert np.ptp(middle(np.nan)) < 12


def test_a_broken_surface_is_refused_with_advice():
    X, T = sphere()
    with pytest.raises(ValueError, match="clean the mesh"):
        draw.render(np.where(X > 0.9, np.nan, X), T)
    with pytest.raises(ValueError, match="front"):
        draw.rotation("sideways")
    with pytest.raises(ValueError, match="up needs"):
        draw.rotation(up="w")


def test_the_page_is_one_file_without_any_address_outside(html):
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:|#)""", html)
    assert "http" not in re.sub(r"data:[^\"]*|http://www.w3.org/2000/svg", "", html)
    assert html.count("<section>") == len(page.SECTIONS)
    assert "Missing:" not in html


def test_sliders_are_first_and_the_contents_link_to_every_section(html):
    headings = re.findall(r'<h2 id="(section-\d+)">(.*?)</h2>', html)
    assert headings[0][1] == "Explore the modes of variation"
    contents = re.search(r'<nav aria-label="contents">(.*?)</nav>', html, re.DOTALL)[1]
    assert re.findall(r'<a href="#(.*?)">(.*?)</a>', contents) == headings
    assert len(headings) == len(page.SECTIONS)


def test_warnings_are_at_the_top_and_every_shape_links_to_its_picture(study):
    part = study.copy()
    report = part["report"].to_dataset()
    kinds = ["", "mirrored", "", "", "", "", ""]
    part["report"] = xr.DataTree(
        report.assign(
            flag_kinds=("shape", kinds),
            warning_kinds=("shape", ["", "", "", "size", "", "", ""]),
            status=("shape", ["ok", "flagged", "ok", "ok", "ok", "repaired", "excluded"]),
        )
    )
    text = page.study_html(part)
    top = text[: text.index("<nav")]
    assert "left out" in top
    assert "broken &lt;b&gt;" in top
    pictures = dict(re.findall(r'<figure id="(shape-\d)".*?<figcaption>(.*?)</figcaption>', text))
    for kind, name in (("mirrored", "brain_02"), ("size", "brain_04")):
        line = re.search(rf"<li class=.*?{kind}.*?</li>", top)[0]
        target = re.search(rf'<a href="#(.*?)">{name}</a>', line)[1]
        assert pictures[target].startswith(name)
    shapes = text[text.index("Shapes</h2>") :]
    assert len(set(re.findall(r'<td><a href="#(shape-\d)">', shapes))) == N_SHAPES


def test_text_of_the_study_is_escaped(html):
    assert "Seven &lt;ellipsoids&gt;" in html
    assert "broken &lt;b&gt;" in html
    assert "<script>alert" not in html
    assert "&lt;script&gt;alert" in html


def test_the_page_shows_the_results_of_the_study(study, html):
    median, template = study["latent"].attrs["median"], study["registration"].attrs["template"]
    summary = f"7 shapes, 1 repaired, 0 flagged, 1 excluded; median {median}; template {template}; "
    first = study["pca"]["explained_variance_ratio"].values[0]
    texts = [f"{median}, the median", "1,200", "mode 3, +3 σ, from behind", "mode 1, −3 σ"]
    for text in (summary, *texts, f"{100 * first:.1f}% of the variance"):
        assert text in html


def test_the_parameters_are_those_of_the_run_and_no_keys_of_files(html):
    assert "made_from" not in html
    assert "<td>n_coarse</td>" in html


def test_the_page_holds_the_modes_as_they_are(study, html):
    state = json.loads(re.search(r'id="modes-state">(.*?)</script>', html, re.DOTALL)[1])
    deformation = np.frombuffer(base64.b64decode(state["deformation"]["base64"]), "<f4")
    assert (deformation == study["pca"]["deformation"].values.ravel().astype(np.float32)).all()
    assert state["ratio"] == pytest.approx(study["pca"]["explained_variance_ratio"].values)
    assert 'id="modes-fallback"' in html.replace("'", '"')


def test_sliders_and_pictures_of_a_page_have_the_same_scale(study, html):
    state = json.loads(re.search(r'id="modes-state">(.*?)</script>', html, re.DOTALL)[1])
    assert state["limit"] == mode_limits(study)[0]
    assert state["bars"]["normal"]["high"] == state["limit"]


def test_the_scale_of_modes_is_the_displacement_at_three_standard_deviations():
    X, T = sphere()
    grows = dataset(
        mean_displacement=0 * X,
        deformation=np.stack([2 * X, X, X, 9 * X]),  # along the normals, which are X itself
    )
    of_four = xr.DataTree.from_dict(
        {"registration": dataset(position=X, corner_vertex=T), "pca": grows}
    )
    np.testing.assert_allclose(mode_limits(of_four), 3 * 2, rtol=0.01)


def test_of_many_modes_the_page_holds_the_first(study, monkeypatch):
    monkeypatch.setattr(page, "N_LIVE", 2)
    html = page.study_html(study)
    state = json.loads(re.search(r'id="modes-state">(.*?)</script>', html, re.DOTALL)[1])
    deformation = np.frombuffer(base64.b64decode(state["deformation"]["base64"]), "<f4")
    assert (deformation == study["pca"]["deformation"].values[:2].ravel().astype("<f4")).all()
    assert {len(scores) for scores in state["samples"]} == {len(state["ratio"])} == {2}
    assert "the first 2 modes" in html


def test_the_page_and_its_charts_are_the_same_every_time(study, html):
    assert page.study_html(study, title="Seven <ellipsoids>") == html
    assert svg(variance([0.7, 0.3])) == svg(variance([0.7, 0.3]))


@pytest.mark.parametrize(
    "node", ["original", "coarse", "network", "latent", "registration", "pca", "report"]
)
def test_an_unfinished_study_shows_what_there_is(study, node, tmp_path):
    part = study.copy()
    del part[node]
    text = page.write_page(part, tmp_path / "page.html").read_text(encoding="utf-8")
    assert ("Missing:" in text) == (node != "original")
    assert text.count("<section>") == len(page.SECTIONS)


def test_a_vertex_of_unknown_distortion_leaves_the_others_their_colours(study, monkeypatch):
    limits = []
    monkeypatch.setattr(
        page, "ramp_colors", lambda values, low, high: limits.append(high) or 0 * values[:, None]
    )
    registration = study["registration"].to_dataset()
    values = np.random.default_rng(0).random(registration["confidence"].shape)
    values[:, 3] = np.nan
    registration["distortion"] = registration["confidence"].copy(data=values)
    registration["round_trip"] = registration["confidence"].copy(data=np.full(values.shape, np.nan))
    part = study.copy()
    part["registration"].dataset = registration
    page.study_html(part)
    known = np.delete(values, 3, axis=1).mean(0)
    assert limits[-2:] == pytest.approx([1.0, np.quantile(known, 0.95)])


def test_an_empty_study_gives_a_page_too():
    text = page.study_html(xr.DataTree())
    assert "The study is empty." in text
    assert text.count("Missing:") == len(page.SECTIONS)


def test_modes_that_could_not_be_are_explained(study):
    part = study.copy()
    del part["pca"]
    part["report"].attrs["no_modes"] = "three shapes are needed <found 2>"
    del part["coarse"], part["registration"]
    missing = page.study_html(part).split("Missing:")[1:]
    assert any("three shapes are needed &lt;found 2&gt;" in text[:400] for text in missing)


def test_a_colour_bar_of_a_page_has_three_digits_and_no_powers_of_ten_for_usual_lengths():
    for limit, text in ((0.12345, "0.123"), (123.4, "123"), (1234.5, "1230")):
        bar = PARTS.color_bar(color_scale("viridis", -limit, limit, "<b>"))
        assert f"<span>−{text}</span><span>&lt;b&gt;</span><span>{text}</span>" in bar
