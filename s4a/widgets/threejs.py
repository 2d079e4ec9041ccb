"""Surfaces as pythreejs objects, for scenes of your own: the one file that imports pythreejs.

The panels draw with a small script of their own, as pythreejs bundles three.js of 2018 and its
morph targets stop at eight modes.  Whoever composes a scene with lines, sprites or other objects
takes a surface from here.
"""

import numpy as np
import pythreejs as three
import xarray as xr

from s4a.geometry.mesh import as_arrays, vertex_normals
from s4a.schema import require


def surface(mesh: xr.Dataset, colors: np.ndarray | None = None) -> three.Mesh:
    """A mesh Dataset as a smooth pythreejs surface.

    Parameters
    ----------
    mesh : xarray.Dataset
        With ``position(vertex, xyz)`` and ``corner_vertex(triangle, corner)``.
    colors : float ndarray (vertex, 3), optional
        From 0 to 1, for example of :func:`s4a.show.draw.signed_colors`.

    Returns
    -------
    pythreejs.Mesh

    Raises
    ------
    ValueError
        When a position is not finite or the colours are not one for each vertex.
    """
    require(mesh, "position", "corner_vertex", what="mesh")
    X, T = as_arrays(mesh)
    if not np.isfinite(X).all():
        wrong = (~np.isfinite(X)).any(1).sum()
        raise ValueError(
            f"finite positions needed, found {wrong} vertices that are not; "
            "s4a.clean repairs the mesh"
        )
    attributes = {
        "position": X.astype(np.float32),
        "normal": vertex_normals(X, T).astype(np.float32),
    }
    look = {"color": "#cfc7b8"}
    if colors is not None:
        colors = np.asarray(colors, np.float32)[:, :3]
        if len(colors) != len(X):
            raise ValueError(
                f"one colour for each of {len(X)} vertices needed, found {len(colors)}"
            )
        attributes["color"], look = np.ascontiguousarray(colors), {"vertexColors": "VertexColors"}
    geometry = three.BufferGeometry(
        attributes={
            name: three.BufferAttribute(values, normalized=False)
            for name, values in attributes.items()
        },
        index=three.BufferAttribute(T.astype(np.uint32).ravel(), normalized=False),
    )
    material = three.MeshStandardMaterial(roughness=0.7, metalness=0.05, side="DoubleSide", **look)
    return three.Mesh(geometry, material)


def renderer(*objects: three.Object3D, size: tuple[int, int] = (600, 450)) -> three.Renderer:
    """A pythreejs renderer around objects, lit from the viewer, with controls to turn and zoom.

    Parameters
    ----------
    *objects : pythreejs.Mesh or other pythreejs objects
        At least one of :func:`surface`; the camera is set to see all of them.
    size : (int, int)
        Width and height in pixels.
    """
    surfaces = [item.geometry for item in objects if isinstance(item, three.Mesh)]
    if not surfaces:
        raise ValueError("a renderer needs at least one surface to look at")
    points = np.concatenate([geometry.attributes["position"].array for geometry in surfaces])
    middle = (points.max(0) + points.min(0)) / 2
    radius = float(np.linalg.norm(np.ptp(points, axis=0))) / 2
    camera = three.PerspectiveCamera(
        position=(middle + radius * np.array([1.5, -2.0, 0.8])).tolist(),
        up=[0, 0, 1],
        fov=40,
        aspect=size[0] / size[1],
        near=radius / 100,
        far=radius * 20,
        children=[three.DirectionalLight(position=[0, 0, 1], intensity=0.7)],
    )
    camera.lookAt(middle.tolist())
    controls = three.OrbitControls(controlling=camera, target=middle.tolist())
    scene = three.Scene(
        children=[*objects, camera, three.AmbientLight(intensity=0.5)], background="#ffffff"
    )
    width, height = size
    return three.Renderer(
        scene=scene, camera=camera, controls=[controls], width=width, height=height, antialias=True
    )
