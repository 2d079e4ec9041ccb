"""Surfaces as pythreejs objects."""

import numpy as np
import pytest

from s4a import synthetic

pytest.importorskip("pythreejs")
from s4a.widgets import threejs


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


def test_the_camera_sees_the_surface():
    view = threejs.renderer(threejs.surface(synthetic.ellipsoid(162)))
    distance = np.linalg.norm(view.camera.position)
    assert view.camera.near < distance - 3 < distance + 3 < view.camera.far
    np.testing.assert_allclose(view.controls[0].target, 0, atol=0.1)


def test_what_cannot_be_shown_is_refused():
    mesh = synthetic.sphere(162)
    with pytest.raises(ValueError, match="162 vertices"):
        threejs.surface(mesh, np.ones((5, 3)))
    with pytest.raises(ValueError, match="finite"):
        threejs.surface(mesh.assign(position=mesh["position"] * np.nan))
    with pytest.raises(ValueError, match="at least one surface"):
        threejs.renderer()
