"""Modes of a study as a pythreejs mesh that deforms.

A shader adds up the modes. The morph targets of the three.js that pythreejs bundles stop at eight
of them; a shader that reads them from a texture does not.
"""

from pathlib import Path

import anywidget
import numpy as np
import pythreejs as three
import traitlets
import xarray as xr
from ipywidgets import widget_serialization
from matplotlib.colors import to_hex

from s4a.geometry.mesh import normal_sums
from s4a.show.draw import CLAY, SIGNED
from s4a.show.surfaces import has, mode_arrays, mode_limits, template_coarse
from s4a.widgets.three_surfaces import smooth_geometry

SCRIPTS = Path(__file__).parent / "scripts"
WIDTH = 2048  # texels of a row of the table of modes: a power of two, so that places are exact
HUES = "compressed narrowed still widened expanded".split()
HEIGHT = 4096  # rows that every graphics card takes
LIGHTS = (  # what three.js fills in for a shader that is lit
    "ambientLightColor directionalLights directionalShadowMap directionalShadowMatrix spotLights "
    "spotShadowMap spotShadowMatrix rectAreaLights ltc_1 ltc_2 pointLights pointShadowMap "
    "pointShadowMatrix hemisphereLights"
).split()


class Scores(anywidget.AnyWidget):
    """Sliders of the scores of a mesh of :func:`modes`; the kernel hears when one is let go."""

    _esm = SCRIPTS / "scores.js"
    _css = SCRIPTS / "scores.css"
    mesh = traitlets.Instance(three.Mesh).tag(sync=True, **widget_serialization)


class ModesMesh(three.Mesh):
    """A pythreejs mesh whose shader moves its vertices along modes; made by :func:`modes`.

    Attributes
    ----------
    scores : list of float
        In standard deviations, one for each mode; set them and the shape follows.
    sliders : Scores
        One for each mode; they move the shape without the kernel.
    """

    scores = traitlets.List(traitlets.Float()).tag(sync=True)

    def __init__(self, geometry, material, **more):
        super().__init__(geometry, material, **more)
        self.sliders = Scores(mesh=self)

    @traitlets.validate("scores")
    def _one_for_each_mode(self, proposal):
        n = int(self.material.defines["MODES"])
        if len(proposal["value"]) != n:
            raise traitlets.TraitError(f"{n} scores needed, found {len(proposal['value'])}")
        return proposal["value"]


def modes(
    study: xr.DataTree,
    *,
    n_modes: int | None = 10,
    resolution: str = "full",
    colored: bool = True,
) -> ModesMesh:
    """The mean shape of a study, which its scores deform in the browser (6.1).

    A shader adds up X + sum_k score_k mode_k: the modes are sent once, and a step of a slider is
    no message to the kernel.  Normals follow the modes to first order.

    Parameters
    ----------
    study : xarray.DataTree
        With ``/registration`` and ``/pca``.
    n_modes : int, optional
        How many modes at most; None for all.
    resolution : {"full", "coarse"}
        Which vertices of the template.
    colored : bool
        Whether the surface is coloured by its displacement along the mean's normals, blue where it
        expands and red where it is compressed.

    Returns
    -------
    ModesMesh
        A pythreejs Mesh with ``scores`` and, to be displayed beside its scene,
        ``sliders``.  ``ipywidgets.jsdlink((panel.view, "scores"), (mesh, "scores"))`` lets it
        follow a :class:`s4a.widgets.Modes` of as many modes, in the browser.  A pythreejs Picker
        finds it where the mean is.

    Raises
    ------
    ValueError
        When the study has no modes, or there are too many numbers for a texture.

    Examples
    --------
    >>> import s4a
    >>> from s4a.widgets import threejs
    >>> mesh = threejs.modes(s4a.synthetic.example_study())
    >>> mesh.scores = [2.0, *mesh.scores[1:]]
    >>> view = threejs.renderer(mesh)  # in a notebook, display(view, mesh.sliders)
    """
    if not (has(study, "registration/position") and has(study, "pca/deformation")):
        raise ValueError("a study with /registration and /pca needed, as of s4a.analyse")
    if resolution not in ("full", "coarse"):
        raise ValueError(f"resolution needs full or coarse, found {resolution!r}")
    coarse = template_coarse(study) if resolution == "coarse" else None
    if resolution == "coarse" and coarse is None:
        raise ValueError("the study has no low resolution of its template; take the full one")
    mean, T, deformation = mode_arrays(study, coarse, n_modes)
    table, bends = mode_table(mean, T, deformation)
    limit, _ = mode_limits(study)
    hues = dict(zip(HUES, map(to_hex, SIGNED(np.linspace(0, 1, len(HUES)))), strict=True))
    slots = -(-len(deformation) // 5) * 5  # pythreejs takes lists of 2, 3, 4, 9 and 16 for vectors
    uniforms = hues | {
        "size": [WIDTH, len(table)],
        "scores": [0.0] * slots,
        "bends": [*bends.tolist(), *[0.0] * (slots - len(bends))],
        "limit": limit,
        "colored": float(colored),
        "diffuse": to_hex(CLAY),
        "specular": "#111111",
        "emissive": "#000000",
        "shininess": 30.0,
        "opacity": 1.0,
        # pythreejs gives its textures, whatever their names, to the last uniform
        "table": three.DataTexture(table, format="RGBAFormat", type="FloatType"),
    }
    material = three.ShaderMaterial(
        uniforms={name: {"value": None} for name in LIGHTS}
        | {name: {"value": value} for name, value in uniforms.items()},
        vertexShader=(SCRIPTS / "modes.vert").read_text(encoding="utf-8"),
        fragmentShader=(SCRIPTS / "modes.frag").read_text(encoding="utf-8"),
        defines={"MODES": str(len(deformation)), "SLOTS": str(slots)},
        lights=True,
        side="DoubleSide",
    )
    geometry = smooth_geometry(mean, T, row=np.arange(len(mean)))
    return ModesMesh(geometry, material, scores=[0.0] * len(deformation), frustumCulled=False)


def mode_table(
    mean: np.ndarray, T: np.ndarray, deformation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The texture (rows, 2048, 4) of modes and of how they bend the normals, and of what size.

    The change of a normal is the derivative of their sum by the score, as a share of that sum's
    length; 127 steps on each side of nothing, the last of which are `bends`.
    """
    c, n = deformation.shape[:2]
    rows = -(-n * c // WIDTH)
    if rows > HEIGHT:
        raise ValueError(
            f"at most {WIDTH * HEIGHT // n} modes of {n} vertices fit into a texture, found {c}; "
            "give n_modes, or resolution='coarse'"
        )
    area = np.linalg.norm(normal_sums(mean, T), axis=1)[:, None]
    area = np.maximum(area, np.finfo(float).tiny)
    table = np.zeros((rows * WIDTH, 4), np.float32)
    bends = np.empty(c)
    for k, step in enumerate(deformation):
        change = normal_sums(mean + step, T) - normal_sums(mean - step, T)  # exact: quadratic
        change /= 2 * area
        bends[k] = np.quantile(np.abs(change).max(1), 0.999) or 1.0
        levels = np.clip(np.round(127 * change / bends[k]), -127, 127) + 127  # 0 .. 254
        table[k : n * c : c, :3] = step
        table[k : n * c : c, 3] = levels @ [1, 256, 65536]
    return table.reshape(rows, WIDTH, 4), bends
