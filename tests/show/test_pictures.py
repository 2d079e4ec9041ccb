"""Pictures and films that are written without a browser."""

import numpy as np
import pytest
from PIL import Image
from simulated import X, study_of
from test_view import sphere

import s4a
from s4a.geometry.mesh import as_dataset
from s4a.show.surfaces import mode_limits


@pytest.fixture(scope="module")
def study():
    """Ellipsoids that differ most in their height, by their scores, three of which are negative."""
    score = np.array([[-1.0, 0.2, 0.1], [-0.6, -0.3, 0.1], [-0.4, 0.3, -0.2], [2.0, -0.2, 0.0]])
    modes = X * np.array([[0, 0, 0.3], [0.05, 0, 0], [0, 0.03, 0]])[:, None]
    return study_of(np.einsum("sc,cnx->snx", score, modes))


def pixels(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def reddest(part):
    """Red less blue, where there is a colour."""
    return (part[..., 0] - part[..., 2])[np.ptp(part, axis=-1) > 60]


def film_frames(path):
    with Image.open(path) as film:
        frames = []
        for i in range(film.n_frames):
            film.seek(i)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
    return frames


def test_a_picture_of_the_modes_is_blue_where_the_shape_grows(study, tmp_path):
    path = s4a.write_picture(study, tmp_path / "modes.png", view="front", width=360)
    frames = pixels(path)
    assert frames.shape[1] == 360
    small, mean, large = np.split(frames[: len(frames) // 4], 3, axis=1)
    assert (reddest(small) > 0).all()
    assert (reddest(large) < 0).all()
    assert len(reddest(mean)) == 0


def test_a_picture_has_the_given_width_and_background(study, tmp_path):
    options = {"mode": 1, "score": 2, "width": 401}
    for transparent in (False, True):
        path = s4a.write_picture(study, tmp_path / "a.png", transparent=transparent, **options)
        with Image.open(path) as picture:
            assert (picture.mode, picture.width) == ("RGBA", 401)
            opacity = np.asarray(picture)[..., 3]
        assert (opacity.min() == 0) == transparent
        assert opacity.max() == 255


def test_a_picture_that_is_rendered_in_bands_is_the_same(study, tmp_path, monkeypatch):
    options = {"mode": 1, "score": 2, "width": 200}
    whole = pixels(s4a.write_picture(study, tmp_path / "whole.png", **options))
    monkeypatch.setattr(s4a.show.pictures, "BAND", 200 * 40)
    bands = pixels(s4a.write_picture(study, tmp_path / "bands.png", **options))
    assert np.abs(whole - bands).max() < 40  # the shade of creases is cut off
    assert np.abs(whole - bands).mean() < 1


def test_the_colour_bar_has_the_limits_of_the_panels(study, tmp_path, monkeypatch):
    words = []
    write = s4a.show.pictures._write
    monkeypatch.setattr(
        s4a.show.pictures,
        "_write",
        lambda sheet, text, *a: words.append(text) or write(sheet, text, *a),
    )
    s4a.write_picture(study, tmp_path / "a.png", mode=1, score=-2, title="Ellipsoids", width=300)
    limit = f"{mode_limits(study)[0]:.3g}"
    assert {"Ellipsoids", limit, f"−{limit}"} <= set(words)
    assert any("mode 1" in text and "−2.0 σ" in text for text in words)


def test_the_scale_of_nonnegative_numbers_begins_at_0_in_white(tmp_path):
    X, T = sphere()
    values = np.clip(X[:, 2], 0, None)
    frames = pixels(
        s4a.write_picture(as_dataset(X, T), tmp_path / "a.png", values=values, width=200)
    )
    assert (reddest(frames[:100]) < 0).all()
    assert len(reddest(frames[:100])) > 100
    assert len(reddest(frames[150:190])) == 0


def test_values_of_another_mesh_are_refused(tmp_path):
    mesh = s4a.synthetic.brains(1, 300)["original/brain_01"].to_dataset()
    n = mesh.sizes["vertex"]
    with pytest.raises(ValueError, match=f"each of the {n} vertices"):
        s4a.write_picture(mesh, tmp_path / "a.png", values=np.arange(3))


@pytest.mark.parametrize("n_frames", [7, 48])
def test_a_film_has_the_given_duration(study, tmp_path, n_frames):
    path = s4a.write_film(study, tmp_path / "a.gif", n_frames=n_frames, width=100, seconds=4)
    with Image.open(path) as film:
        total = 0
        for i in range(film.n_frames):
            film.seek(i)
            total += film.info["duration"]
    assert total == 4000


def test_a_film_of_a_mode_goes_to_both_ends_and_back(study, tmp_path):
    path = s4a.write_film(study, tmp_path / "a.gif", mode=1, n_frames=6, width=120, seconds=3)
    with Image.open(path) as film:
        assert film.n_frames == 6
        assert (film.width, film.info["duration"], film.info["loop"]) == (120, 500, 0)
    first, *_, last = frames = film_frames(path)
    assert np.abs(first - frames[3]).max() > 100
    assert (reddest(first[:100]) > 0).all()
    assert (reddest(frames[3][:100]) < 0).all()
    assert frames[1] == pytest.approx(last, abs=60)
    assert (first[0, 0] == 255).all()


@pytest.mark.parametrize("ending", ["gif", "webp", "apng"])
def test_a_film_of_one_rotation_shows_every_side(tmp_path, ending):
    X, T = sphere()
    colors = np.where(X[:, :1] > 0, [[1.0, 0, 0]], [[0, 0, 1.0]])
    path = tmp_path / f"a.{ending}"
    mesh = as_dataset(X, T)
    s4a.write_film(mesh, path, turn=True, values=colors, view="right", n_frames=4, width=100)
    frames = film_frames(path)
    assert len(frames) == 4
    assert np.median(reddest(frames[0])) > 60
    assert np.median(reddest(frames[2])) < -60
    assert reddest(frames[1]).min() < 0 < reddest(frames[1]).max()


@pytest.mark.parametrize(
    "name, options, message",
    [
        ("a.jpg", {}, r"\.png, found a.jpg"),
        ("a.png", {"width": 3841}, "an integer of at most 3840"),
        ("a.png", {"mode": 9}, "mode needs whole numbers from 1 to 3, found 9"),
        ("a.png", {"mode": 0}, "mode needs whole numbers from 1 to 3, found 0"),
    ],
)
def test_an_impossible_picture_is_refused(study, tmp_path, name, options, message):
    with pytest.raises(ValueError, match=message):
        s4a.write_picture(study, tmp_path / name, **options)
    assert not (tmp_path / name).exists()


def test_an_impossible_film_is_refused(study, tmp_path):
    with pytest.raises(ValueError, match=r"found a\.webm; a panel's Save film writes WebM"):
        s4a.write_film(study, tmp_path / "a.webm")
    with pytest.raises(ValueError, match="turn=True"):
        s4a.write_film(as_dataset(*sphere()), tmp_path / "a.gif")
    with pytest.raises(ValueError, match="or a mesh, is needed, found str; a panel"):
        s4a.write_film("study", tmp_path / "a.gif", turn=True)
