"""Surfaces as pythreejs objects."""

import numpy as np
import pytest
import traitlets
import xarray as xr
from scipy.spatial.distance import cdist, pdist

import s4a
from s4a import synthetic
from s4a.geometry.mesh import vertex_normals
from s4a.show.draw import cycle_error_colors
from s4a.show.surfaces import mode_limits, network_limits

pythreejs = pytest.importorskip("pythreejs")
threejs = pytest.importorskip("s4a.widgets.threejs")


def test_the_arrays_arrive_as_the_browser_needs_them():
    mesh = synthetic.sphere(162)
    colors = np.tile([1.0, 0.5, 0.0], (162, 1))
    surface = threejs.surface(mesh, colors)
    geometry = surface.geometry
    assert geometry.index.array.dtype == np.uint32
    np.testing.assert_array_equal(geometry.index.array, mesh["corner_vertex"].values.ravel())
    np.testing.assert_array_equal(
        geometry.attributes["position"].array, mesh["position"].values.astype("f4")
    )
    np.testing.assert_array_equal(geometry.attributes["color"].array, colors.astype("f4"))
    normals = geometry.attributes["normal"].array
    assert np.einsum("nx,nx->n", normals, mesh["position"].values).min() > 0.99


def test_a_field_has_the_colours_of_its_values():
    mesh = synthetic.sphere(162)
    height = mesh["position"][:, 2]

    def colors(*field, **options):
        return threejs.surface(mesh, *field, **options).geometry.attributes["color"].array

    signed = colors(height)
    top, bottom = height.values.argmax(), height.values.argmin()
    assert signed[top][2] > signed[top][0], "blue"
    assert signed[bottom][0] > signed[bottom][2], "red"
    grey = colors(height + 5, "gray", limits=(5, 6))
    np.testing.assert_allclose(grey[bottom], 0, atol=0.01)
    np.testing.assert_allclose(grey[top], 1, atol=0.01)
    labels = (height > 0).values
    assert len(np.unique(colors(labels), axis=0)) == 2
    unknown = np.where(labels, np.nan, height.values)
    np.testing.assert_allclose(colors(unknown)[top], 0.6, atol=1e-6)
    np.testing.assert_array_equal(
        threejs.surface(mesh.assign(height=height), "height").geometry.attributes["color"].array,
        signed,
    )


def shader(mesh, row, scores):
    """The sums of the vertex shader at a vertex: its position and normal."""
    uniforms = {name: value["value"] for name, value in mesh.material.uniforms.items()}
    table = uniforms["table"].data.reshape(-1, 4)
    n_modes = int(mesh.material.defines["MODES"])
    position = mesh.geometry.attributes["position"].array[row].astype(float)
    normal = mesh.geometry.attributes["normal"].array[row].astype(float)
    for mode, score in enumerate(scores):
        texel = table[row * n_modes + mode]
        number = int(texel[3])
        steps = np.array([number % 256, number // 256 % 256, number // 65536])
        position += score * texel[:3]
        normal += score * uniforms["bends"][mode] * (steps - 127) / 127
    return position, normal / np.linalg.norm(normal)


def test_the_table_holds_positions_and_normals_of_the_modes(study):
    mesh = threejs.modes(study)
    n_modes = study["pca"].sizes["component"]
    scores = np.array([1.0, -0.7, 0.5])[:n_modes]
    shape = s4a.synthesize(study, scores)
    X, T = shape["position"].values, shape["corner_vertex"].values
    normals = vertex_normals(X, T)
    turned = []
    for row in range(0, len(X), 7):
        position, normal = shader(mesh, row, scores)
        np.testing.assert_allclose(position, X[row], atol=1e-4 * np.abs(X).max())
        turned.append(normal @ normals[row])
    assert np.quantile(turned, 0.05) > 0.97
    still = threejs.modes(study).geometry.attributes["normal"].array[::7]
    unturned = np.einsum("nx,nx->n", still, normals[::7])
    assert np.mean(turned) > np.mean(unturned), "more accurate than the mean's normals"


def test_pythreejs_takes_no_list_of_the_scores_for_a_vector_or_a_matrix(study):
    for n_modes in (1, 2, 3):
        mesh = threejs.modes(study, n_modes=n_modes)
        assert len(mesh.material.uniforms["scores"]["value"]) == 5
        assert len(mesh.scores) == n_modes


def test_scores_are_one_for_each_mode(study):
    mesh = threejs.modes(study, n_modes=2)
    mesh.scores = [1.0, -2.0]
    with pytest.raises(traitlets.TraitError, match="2 scores needed, found 3"):
        mesh.scores = [1.0, 2.0, 3.0]
    assert mesh.scores == [1.0, -2.0]


def test_modes_at_low_resolution_are_those_of_its_vertices(study):
    low = threejs.modes(study, resolution="coarse", colored=False)
    template = study["registration"].attrs["template"]
    n = study["coarse"][template].sizes["vertex"]
    assert len(low.geometry.attributes["position"].array) == n < 1500
    assert low.material.uniforms["colored"]["value"] == 0


def test_scenes_at_both_resolutions_have_the_scale_of_sliders_and_pictures(study):
    for resolution in ("full", "coarse"):
        mesh = threejs.modes(study, resolution=resolution, n_modes=2)
        assert mesh.material.uniforms["limit"]["value"] == mode_limits(study)[0]


def test_too_many_modes_for_a_texture_are_refused():
    with pytest.raises(ValueError, match="at most 8 modes of 1000000 vertices"):
        threejs.mode_table(np.zeros((1_000_000, 3)), None, np.broadcast_to(0, (9, 1_000_000, 3)))


def test_landmarks_are_spheres_with_their_names(meshes):
    mesh = meshes["brain_01"]
    group = threejs.points(mesh)
    assert [ball.name for ball in group.children] == mesh["landmark_name"].values.tolist()
    np.testing.assert_allclose(
        [ball.position for ball in group.children], mesh["landmark_position"].values
    )
    assert all(isinstance(ball.children[0], pythreejs.Sprite) for ball in group.children)
    bare = threejs.points(mesh["landmark_position"].values[:2], radius=3.0)
    assert bare.children[0].geometry.radius == 3
    assert not bare.children[0].children


def test_lines_of_a_correspondence_join_matched_vertices(meshes):
    source, target = (meshes[name] for name in ("brain_01", "brain_02"))
    match = np.random.default_rng(0).integers(1500, size=1500).astype(np.int32)
    pair = xr.Dataset({"match": ("vertex", match)})
    group = threejs.correspondence(pair, source, target, n_lines=20)
    left, right, lines = group.children
    np.testing.assert_allclose(threejs.renderer(group).controls[0].target, 0, atol=1e-3)
    X, Y = (part.geometry.attributes["position"].array for part in (left, right))
    ends = lines.geometry.positions
    assert ends.shape == (20, 2, 3)
    for begin, end in ends:
        here = np.linalg.norm(Y - end, axis=1).argmin()
        np.testing.assert_allclose(X[match[here]], begin, atol=1e-3)
    assert X[:, 0].max() < Y[:, 0].min(), "side by side"
    colors = (part.geometry.attributes["color"].array for part in (left, right))
    source_colors, target_colors = colors
    np.testing.assert_array_equal(target_colors, source_colors[match])


def test_a_study_matches_two_of_its_shapes(study):
    left, right, _ = threejs.correspondence(study, "brain_01", "brain_02").children
    X, Y = (part.geometry.attributes["position"].array for part in (left, right))
    colors = [part.geometry.attributes["color"].array for part in (left, right)]
    nearest = cdist(Y - Y.mean(0), X - X.mean(0)).argmin(1)
    assert np.abs(colors[1] - colors[0][nearest]).mean() < 0.1, (
        "corresponding points have one colour"
    )


def test_the_network_is_placed_by_shape_differences_and_coloured_by_cycle_errors(study):
    group = threejs.network(study, names=False)
    *bodies, lines = group.children
    scores = study["latent"]["area_score"]
    assert [part.name for part in bodies] == scores["shape"].values.tolist()
    positions = np.array([part.position for part in bodies])
    ratio = pdist(positions) / pdist(scores.values[:, :3])
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)
    net = study["network"].dataset
    names = [part.name for part in bodies]
    mean = {}
    for source, target, error in zip(
        net["source"].values, net["target"].values, net["cycle_error"].values, strict=True
    ):
        mean.setdefault(frozenset((str(source), str(target))), []).append(error)
    limits = network_limits(study)
    assert (group.bar["low"], group.bar["high"]) == limits
    for segment, color in zip(lines.geometry.positions, lines.geometry.colors, strict=True):
        ends = [names[np.linalg.norm(positions - end, axis=1).argmin()] for end in segment]
        error = np.mean(mean[frozenset(ends)])
        np.testing.assert_allclose(color, cycle_error_colors(np.full(2, error), limits), atol=1e-6)


def test_the_colour_bar_of_a_network_is_below_it_and_moves_with_the_camera(study):
    group = threejs.network(study)
    scene = threejs.renderer(group, size=(400, 300), view="top")
    assert not [part for part in threejs.renderer(group.children[0]).camera.children if part.name]
    (bar,) = [part for part in scene.camera.children if part.name == "colour bar"]
    strip, low, label, high = bar.children
    assert (low.name, label.name) == ("", "")
    texts = [part.material.map.string for part in (low, label, high)]
    assert texts[0] == f"{group.bar['low']:.2g}"
    assert texts[2] == f"{group.bar['high']:.2g}"
    assert "cycle error" in texts[1]
    limits = group.bar["low"], group.bar["high"]
    ends = cycle_error_colors(np.array(limits), limits)
    np.testing.assert_allclose(strip.material.map.data[0, [0, -1], :3] / 255, ends, atol=0.01)
    # in the picture's plane at the bar's distance, from -1 to 1
    x, y, _ = np.array(bar.position) / (-bar.position[2] * np.tan(np.deg2rad(20)))
    width = bar.scale[0] / (-bar.position[2] * np.tan(np.deg2rad(20)))
    assert abs(x) + width / 2 < 400 / 300
    assert -1 < y - 0.0725 * width < y + 0.02 * width < -0.7


def test_what_is_in_a_group_is_in_the_picture():
    group = pythreejs.Group(
        children=[threejs.surface(synthetic.sphere(162))],
        position=[100, 0, 0],
        scale=[2, 2, 2],
        quaternion=[0, 0, 1, 0],
    )
    view = threejs.renderer(group)
    np.testing.assert_allclose(view.controls[0].target, [100, 0, 0], atol=0.2)
    assert np.linalg.norm(np.subtract(view.camera.position, [100, 0, 0])) > 2 * 2


def test_the_camera_sees_the_surface():
    view = threejs.renderer(threejs.surface(synthetic.ellipsoid(162)))
    distance = np.linalg.norm(view.camera.position)
    assert view.camera.near < distance - 3 < distance + 3 < view.camera.far
    np.testing.assert_allclose(view.controls[0].target, 0, atol=0.1)


@pytest.mark.parametrize("size", [(360, 200), (500, 500), (300, 600)])
def test_a_long_object_fills_the_picture_and_nothing_is_cut(size):
    long = synthetic.ellipsoid(500, (6, 1, 1))
    view = threejs.renderer(threejs.surface(long), size=size, view="front")
    X = long["position"].values
    half = np.tan(np.deg2rad(view.camera.fov) / 2)
    depth = np.linalg.norm(view.camera.position) - X @ np.array([0, -1, 0])
    across = np.abs(X[:, 0] / depth).max() / (half * size[0] / size[1])
    up = np.abs(X[:, 2] / depth).max() / half
    assert 0.7 < max(across, up) < 1


def test_what_cannot_be_shown_is_refused():
    mesh = synthetic.sphere(162)
    with pytest.raises(ValueError, match="162 vertices"):
        threejs.surface(mesh, np.ones((5, 3)))
    with pytest.raises(ValueError, match=r"found 'hight'; it has position"):
        threejs.surface(mesh, "hight")
    with pytest.raises(ValueError, match=r"finite points \(p, 3\)"):
        threejs.points(np.ones((4, 2)))
    short = xr.Dataset({"match": ("vertex", np.zeros(5, np.int32))})
    with pytest.raises(ValueError, match="found 5 up to 0"):
        threejs.correspondence(short, mesh, mesh)
    with pytest.raises(ValueError, match="/registration and /pca"):
        threejs.modes(xr.DataTree())
    with pytest.raises(ValueError, match="network/cycle_error"):
        threejs.network(xr.DataTree())
    with pytest.raises(ValueError, match="finite"):
        threejs.surface(mesh.assign(position=mesh["position"] * np.nan))
    with pytest.raises(ValueError, match="at least one object"):
        threejs.renderer()
