"""Save picture and Save film of a page without a kernel, in Chromium: the files that they give."""

import base64
import io

import numpy as np
import pytest
from browsing import needed
from PIL import Image

from s4a import widgets

pytestmark = needed


@pytest.fixture(scope="module")
def study(example_study):
    return example_study


@pytest.fixture
def page(show, study, request):
    """The page of a panel, none of whose values are recorded."""
    page = show(getattr(widgets, request.param)(study), limit=0)
    page.get_by_role("button", name="save a picture or a film").first.click()
    return page


def downloaded(page, button, **choices):
    """The bytes of what a button of the dialog saves."""
    part = page.locator("dialog.s4a-save fieldset").filter(
        has=page.get_by_role("button", name=button)
    )
    for label, value in choices.items():
        part.get_by_label(label).select_option(value)
    with page.expect_download(timeout=60_000) as loaded:
        part.get_by_role("button", name=button).click()
    page.locator("dialog.s4a-save output", has_text="saved: ").wait_for()
    return loaded.value.path().read_bytes()


def reddest(picture):
    """Red less blue, where there is a colour."""
    pixels = np.asarray(picture.convert("RGB")).astype(int)
    return (pixels[..., 0] - pixels[..., 2])[np.ptp(pixels, axis=-1) > 60]


modes = pytest.mark.parametrize("page", ["Modes"], indirect=True)
two = pytest.mark.parametrize("page", ["FunctionalMap"], indirect=True)


@modes
def test_a_picture_of_4k_has_surface_and_colour_bar_on_the_given_background(page):
    with Image.open(io.BytesIO(downloaded(page, "Save picture", width="3840"))) as picture:
        assert picture.width == 3840
        small = picture.convert("RGBA").resize((384, picture.height // 10))
    pixels = np.asarray(small).astype(int)
    assert (pixels[..., 3] == 255).all()
    surface = pixels[30:-40, :, :3]
    assert 0.1 < (surface.min(-1) < 250).mean() < 0.9
    bar = reddest(Image.fromarray(np.asarray(small)[-40:]))
    assert bar.min() < -60 < 60 < bar.max()
    content = downloaded(page, "Save picture", width="600", background="")
    with Image.open(io.BytesIO(content)) as picture:
        opacity = np.asarray(picture)[..., 3]
    assert (opacity[0, 0], opacity.max()) == (0, 255)
    assert np.isin(opacity[60:-60, 20:-20], (0, 255)).mean() > 0.97  # a surface is not seen through


@modes
def test_the_tiles_of_a_large_picture_are_those_of_a_small_one(page):
    large, small = (
        Image.open(io.BytesIO(downloaded(page, "Save picture", width=width)))
        for width in ("2560", "800")
    )
    large = large.convert("RGB").resize((800, small.height))
    difference = np.abs(
        np.asarray(large).astype(int) - np.asarray(small.convert("RGB")).astype(int)
    )
    assert difference[40:-60].mean() < 3


@modes
def test_a_film_of_a_slider_goes_from_one_end_to_the_other_and_back(page):
    before = page.locator(".s4a-slider input").first.input_value()
    with Image.open(io.BytesIO(downloaded(page, "Save film", motion="slider"))) as film:
        assert (film.n_frames, film.width, film.info["duration"]) == (50, 600, 80)
        frames = []
        for i in (0, 25, 49):
            film.seek(i)
            frames.append(np.asarray(film.convert("RGB")).astype(int)[40:-60])
    first, middle, last = frames
    assert np.abs(first - middle).mean() > 3 * np.abs(first - last).mean() > 0
    assert page.locator(".s4a-slider input").first.input_value() == before


@two
def test_both_surfaces_of_a_panel_turn_once_in_one_film(page):
    page.get_by_label("surfaces").select_option("all")
    with Image.open(io.BytesIO(downloaded(page, "Save film", motion="turn"))) as film:
        frames = []
        for i in (0, 25):
            film.seek(i)
            frames.append(np.asarray(film.convert("RGB")).astype(int)[40:-60])
    for half in np.split(np.abs(frames[0] - frames[1]), 2, axis=1):
        assert half.mean() > 3


@two
def test_a_browser_that_records_writes_webm(page):
    film = downloaded(page, "Save film", format="webm")
    assert film[:4] == b"\x1a\x45\xdf\xa3"  # EBML
    seconds = page.evaluate(
        """async (data) => {
            const video = document.createElement("video");
            video.src = `data:video/webm;base64,${data}`;
            await new Promise((done) => (video.onloadedmetadata = done));
            video.currentTime = 1e6;
            await new Promise((done) => (video.onseeked = done));
            return video.currentTime;
        }""",
        base64.b64encode(film).decode(),
    )
    assert 3.5 < seconds < 6, "a busy machine may take longer, but shows all"


@modes
def test_the_dialog_is_closed_with_escape_and_ends_a_film(page):
    page.get_by_role("button", name="Save film").click()
    page.keyboard.press("Escape")
    page.locator("dialog.s4a-save").wait_for(state="detached")
    page.wait_for_timeout(200)  # an error would be in the fixture's list
    page.get_by_role("button", name="save a picture or a film").first.click()
    page.get_by_role("button", name="Save picture").wait_for()
