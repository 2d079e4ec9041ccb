"""Diagrams of the notebooks.

The second paragraph of a docstring is the alternative text of its diagram.
"""

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle
from scipy.spatial import Delaunay

from s4a.show.charts import BLUE, GREY, ORANGE, STYLE
from s4a.show.draw import SIGNED
from s4a.show.tiled_figure import TiledFigure

SOFT = {"blue": "#cfe4f2", "orange": "#f7d9c4", "grey": "#eeeeee", "green": "#cdebe0"}


def cotangents() -> Figure:
    """Cotangent weights of an interior edge and a boundary edge, and the area of a vertex.

    An interior edge i j has two triangles, with the opposite angles alpha and beta. Its weight
    is half the sum of their cotangents. A boundary edge has one triangle, and its weight is half
    of one cotangent. The area of a vertex is a third of the area of the triangles around it.

    Examples
    --------
    >>> from s4a.course.diagrams import cotangents
    >>> len(cotangents().axes)
    3
    """
    figure, ((inside, boundary, area),) = _plain(cotangents, 3, 9.5, 3.1)
    i, j, above, below = np.array([[0.25, 0.5], [1.0, 0.62], [0.52, 1.05], [0.78, 0.08]])
    for ax, corners in ((inside, (above, below)), (boundary, (above,))):
        for corner, color, name in zip(corners, (BLUE, ORANGE), ("α", "β"), strict=False):
            ax.add_patch(Polygon([i, j, corner], fc=SOFT["grey"], ec=GREY))
            _angle(ax, corner, i, j, color, name)
        ax.plot(*np.c_[i, j], color="black", lw=3, zorder=3)
        for point, name in ((i, "i"), (j, "j")):
            ax.plot(*point, "o", color="black", ms=6, zorder=4)
            shift = [-0.07, -0.01] if name == "i" else [0.06, 0]
            ax.text(*(point + shift), name, ha="center", va="center", fontsize=11, style="italic")
    inside.set_title("interior edge: two triangles")
    inside.text(0.6, -0.12, r"$w_{ij} = \frac{1}{2}\,(\cot\alpha + \cot\beta)$", ha="center")
    boundary.set_title("boundary edge: one triangle")
    boundary.text(0.66, 0.37, "no triangle here", ha="center", color=GREY)
    boundary.text(0.6, -0.12, r"$w_{ij} = \frac{1}{2}\,\cot\alpha$", ha="center")
    _areas_around(area)
    for ax in (inside, boundary, area):
        ax.set(xlim=(0.08, 1.18), ylim=(-0.22, 1.15))
        ax.set_aspect("equal")
    return figure


def dual(n_samples: int = 12) -> Figure:
    """Voronoi cells of a flat mesh, the triangles where three cells meet, and the dual mesh.

    A flat mesh has twelve samples. In the first picture every vertex has the colour of its
    nearest sample. In the second, the triangles where three colours meet are black. In the
    third, each black triangle has become a large triangle of the dual, which joins the samples.

    Parameters
    ----------
    n_samples : int
        Number of farthest-point samples.

    Examples
    --------
    >>> from s4a.course.diagrams import dual
    >>> [ax.get_title() for ax in dual().axes]
    ['1. assign vertices to samples', '2. find where three cells meet', '3. join the three samples']
    """
    rng = np.random.default_rng(4)
    rows = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 30)]), -1).reshape(-1, 2)
    inside = np.all((rows > 0) & (rows < 1), axis=1).astype(float)
    X = rows + inside[:, None] * rng.uniform(-0.009, 0.009, rows.shape)
    T = Delaunay(X).simplices
    sample = [int(np.linalg.norm(X - 0.5, axis=1).argmin())]
    while len(sample) < n_samples:  # farthest points
        distance = np.linalg.norm(X[:, None] - X[sample], axis=2).min(1)
        sample.append(int(distance.argmax()))
    cell = np.linalg.norm(X[:, None] - X[sample], axis=2).argmin(1)
    corners = [np.unique(cell[t]) for t in T]
    meeting = np.array([len(c) == 3 for c in corners])
    triangles = np.unique([c for c in corners if len(c) == 3], axis=0)
    shades = colormaps["Set3"]
    figure, ((first, second, third),) = _plain(dual, 3, 9.5, 3.4)
    for ax, alpha in ((first, 1.0), (second, 1.0), (third, 0.35)):
        interior = np.array([len(c) == 1 for c in corners])
        shade = cell[T[interior, 0]]
        ax.tripcolor(*X.T, T[interior], shade, cmap=shades, vmin=0, vmax=11, alpha=alpha)
        ax.triplot(*X.T, T, color="white", lw=0.4)
        ax.plot(*X[sample].T, "o", color="black", ms=5, zorder=5)
        ax.set_aspect("equal")
    for t in T[meeting]:
        second.add_patch(Polygon(X[t], fc="black", ec="black", zorder=4))
    third.triplot(*X[sample].T, triangles, color=BLUE, lw=1.8, zorder=4)
    first.set_title("1. assign vertices to samples")
    second.set_title("2. find where three cells meet")
    third.set_title("3. join the three samples")
    return figure


def pull_back() -> Figure:
    """Pull-back of a function by a match, and the same as a functional map.

    Left: an arrow leads from a point y of the target N to T of y on the source M, and a second
    arrow takes the value of f back to y. Right: a commutative square. T F maps f on M to f of T
    on N. Below it, C maps the coefficients a to b. Phi and Psi map functions to coefficients.

    Examples
    --------
    >>> from s4a.course.diagrams import pull_back
    >>> len(pull_back().axes)
    2
    """
    figure, ((shapes, square),) = _plain(pull_back, 2, 9.5, 3.1)
    u = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 160)]), -1)
    inside = np.hypot(*u.transpose(2, 0, 1)) < 1
    f = np.where(inside, np.sin(2.4 * u[..., 0] + 0.4) * np.cos(1.6 * u[..., 1]), np.nan)
    for left, bend, name in ((0.0, 0.0, "source M"), (3.1, 0.45, "target N")):
        X = u[..., 0] * (1 - 0.25 * bend) + left
        Y = u[..., 1] * (1 - 0.3 * bend) + bend * (u[..., 0] ** 2 - 0.4)
        shapes.pcolormesh(X, Y, f, cmap=SIGNED, vmin=-1.3, vmax=1.3, shading="gouraud")
        shapes.text(left, -1.5, name, ha="center", fontsize=11)
    y, T_y = np.array([3.455, 0.195]), np.array([0.4, 0.35])
    for point, name, shift in ((y, "y", (0.14, -0.2)), (T_y, "T(y)", (0, -0.27))):
        shapes.plot(*point, "o", color="black", ms=6)
        shapes.text(*(point + shift), name, ha="center", fontsize=11, style="italic")
    _arrow(shapes, y, T_y, "1. the match takes y to T(y)", bend=0.28, rise=0.62)
    _arrow(shapes, (0.75, -0.75), (2.4, -0.75), "2. y gets the value f(T(y))", bend=0.2, rise=-0.4)
    shapes.text(-0.5, 1.1, "f", ha="center", fontsize=12, style="italic", color=BLUE)
    shapes.text(3.5, 1.1, "f(T(y))", ha="center", fontsize=12, style="italic", color=BLUE)
    shapes.set(xlim=(-1.2, 4.3), ylim=(-1.75, 1.6))
    shapes.set_aspect("equal")
    for up, kind, texts in (
        (1, "blue", ("f on M\nn values", "f ∘ T on N\nn values")),
        (0, "orange", ("a\nk numbers", "b = C a\nk numbers")),
    ):
        for across, text in zip((0, 2.2), texts, strict=True):
            _box(square, (across, up), text, SOFT[kind], (1.0, 0.42))
    _arrow(square, (0.55, 1), (1.65, 1), "$T_F$", rise=0.12)
    _arrow(square, (0.55, 0), (1.65, 0), "C", rise=0.1)
    _arrow(square, (0, 0.76), (0, 0.24), "$\\Phi^T A$", rise=0, across=-0.28)
    _arrow(square, (2.2, 0.76), (2.2, 0.24), "$\\Psi^T A$", rise=0, across=0.28)
    square.set(xlim=(-0.7, 2.9), ylim=(-0.4, 1.5))
    square.set_title("both paths lead to b")
    return figure


def latent_space() -> Figure:
    """Latent space of three shapes, and the matrix whose eigenvectors are its basis.

    Left: three shapes around a latent space. The maps Y 1 to Y 3 lead from the latent space to
    the shapes, the maps C 12, C 23 and C 31 from shape to shape. Right: the matrix L in nine
    blocks. Its diagonal has products of the maps, the other blocks have the maps themselves. Next
    to it are Y 1 to Y 3, stacked.

    Examples
    --------
    >>> from s4a.course.diagrams import latent_space
    >>> len(latent_space().axes)
    2
    """
    figure, ((star, matrix),) = _plain(latent_space, 2, 9.5, 3.7)
    angle = np.deg2rad([90, 210, 330])
    nodes = 1.25 * np.c_[np.cos(angle), np.sin(angle)]
    for i, node in enumerate(nodes):
        _box(star, node, f"shape {i + 1}", SOFT["blue"], (0.8, 0.3))
        across, up = [(0.2, 0), (-0.12, 0.14), (0.12, 0.14)][i]
        ends = 0.3 * node, 0.82 * node
        _arrow(star, *ends, f"$Y_{i + 1}$", color=ORANGE, across=across, rise=up)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        begin, end = 0.76 * nodes[i] + 0.24 * nodes[j], 0.24 * nodes[i] + 0.76 * nodes[j]
        outwards = (begin + end) / np.linalg.norm(begin + end)
        _arrow(star, begin + 0.12 * outwards, end + 0.12 * outwards, "", color=BLUE)
        x, y = (begin + end) / 2 + 0.32 * outwards
        name = f"$C_{{{i + 1}{j + 1}}}$"
        star.text(x, y, name, ha="center", va="center", color=BLUE, fontsize=11)
    _box(star, (0, 0), "latent\nspace", SOFT["orange"], (0.5, 0.36))
    star.set(xlim=(-1.8, 1.8), ylim=(-1.1, 1.6))
    star.set_aspect("equal")
    star.set_title(r"goal: $C_{ij}\, Y_i = Y_j$ for every map")
    blocks = [
        [r"$C_{12}^T C_{12} + I$", r"$-C_{12}^T$", r"$-C_{31}$"],
        [r"$-C_{12}$", r"$C_{23}^T C_{23} + I$", r"$-C_{23}^T$"],
        [r"$-C_{31}^T$", r"$-C_{23}$", r"$C_{31}^T C_{31} + I$"],
    ]
    for i, row in enumerate(blocks):
        for j, text in enumerate(row):
            color = SOFT["blue" if i == j else "grey"]
            matrix.add_patch(Rectangle((1.3 * j, -0.7 * i), 1.3, 0.7, fc=color, ec="white", lw=2))
            matrix.text(1.3 * j + 0.65, 0.35 - 0.7 * i, text, ha="center", va="center")
        matrix.add_patch(Rectangle((4.3, -0.7 * i), 0.6, 0.7, fc=SOFT["orange"], ec="white", lw=2))
        matrix.text(4.6, 0.35 - 0.7 * i, f"$Y_{i + 1}$", ha="center", va="center")
    matrix.set(xlim=(-0.1, 5), ylim=(-1.6, 0.9))
    matrix.set_title("the matrix L, and the stacked Y (weights 1)")
    return figure


def two_methods() -> Figure:
    """Two methods from latent functions to a match at full resolution: eq. 3 and 4, and eq. 7.

    Each method has template and shape at low and at full resolution, and U from low to full. The
    standard method searches at low resolution, converts the match to C, and searches again at full
    resolution. Equation 7 searches once, at full resolution, with U Phi Y.

    Examples
    --------
    >>> from s4a.course.diagrams import two_methods
    >>> [ax.get_title() for ax in two_methods().axes]
    ['standard (eq. 3 and 4): two searches', 'eq. 7: one search']
    """
    figure, ((standard, latent),) = _plain(two_methods, 2, 9.5, 3.3)
    for ax, low in ((standard, SOFT["orange"]), (latent, SOFT["grey"])):
        for x, name in ((0, "template"), (2.6, "shape")):
            _box(ax, (x, 0), f"{name}, low\n$\\Phi\\, Y$", low, (1.05, 0.42))
            up = "$U \\Phi$" if ax is standard else "$U \\Phi\\, Y$"
            _box(ax, (x, 1.15), f"{name}, full\n{up}", SOFT["blue"], (1.05, 0.42))
            _arrow(ax, (x, 0.25), (x, 0.9), "U", rise=0, across=0.14)
        ax.set(xlim=(-0.7, 3.3), ylim=(-0.45, 1.6))
    _arrow(standard, (0.58, 0), (2.02, 0), "search: eq. 3", rise=0.1, color=ORANGE)
    _arrow(standard, (1.3, 0.24), (1.3, 0.92), "map C", rise=0, across=0.29, color=ORANGE)
    _arrow(standard, (0.58, 1.15), (2.02, 1.15), "search: eq. 4", rise=0.1, color=ORANGE)
    _arrow(latent, (0.58, 1.15), (2.02, 1.15), "search: eq. 7", rise=0.1, color=ORANGE)
    standard.set_title("standard (eq. 3 and 4): two searches")
    latent.set_title("eq. 7: one search")
    return figure


def slid() -> Figure:
    """Match with a tangential error: it slid along a fold, and is still on the surface.

    Two folds of a surface, seen from the side. The true position of a point is the crest of a
    fold. The match of this point has slid down the flank, and is still on the surface.

    Examples
    --------
    >>> from s4a.course.diagrams import slid
    >>> [ax.get_title() for ax in slid().axes]
    ['a slide: still on the surface']
    """
    figure, ((folds,),) = _plain(slid, 1, 5, 3.1)
    u = np.linspace(0, 2, 200)
    height = 0.3 * (1 - np.cos(2 * np.pi * u))
    folds.plot(u, height, color=GREY, lw=2.5)
    crest, flank = 52, 78  # rows of u
    folds.plot(u[crest:flank], height[crest:flank], color=ORANGE, lw=4)
    for i, color, name, shift in (
        (crest, "black", "true position", (0, 0.13)),
        (flank, ORANGE, "match", (0.2, 0.05)),
    ):
        folds.plot(u[i], height[i], "o", color=color, ms=8, zorder=4)
        folds.text(u[i] + shift[0], height[i] + shift[1], name, ha="center", color=color)
    folds.text(1, -0.15, "surface of the source", ha="center", color=GREY)
    folds.set(xlim=(-0.05, 2.05), ylim=(-0.3, 0.95))
    folds.set_title("a slide: still on the surface")
    return figure


def _plain(draw, columns, width, height):
    """Return axes without frames; the alternative text comes from the docstring of `draw`."""
    with rc_context(STYLE):
        figure = TiledFigure(figsize=(width, height), layout="constrained", dpi=120)
        axes = figure.subplots(1, columns, squeeze=False)
    figure.alt = " ".join((draw.__doc__ or "\n\n").split("\n\n")[1].split())
    for ax in axes.flat:
        ax.set_axis_off()
        ax.title.set_fontsize(STYLE["axes.titlesize"])
    return figure, axes


def _angle(ax, corner, i, j, color, name):
    """Draw the angle of a triangle at a corner, opposite to the edge from i to j."""
    ends = np.array([np.arctan2(*(p - corner)[::-1]) for p in (i, j)])
    ends = np.unwrap(np.sort(ends))
    if ends[1] - ends[0] > np.pi:
        ends = np.array([ends[1], ends[0] + 2 * np.pi])
    t = np.linspace(ends[0], ends[1], 30)
    arc = corner + 0.15 * np.c_[np.cos(t), np.sin(t)]
    ax.add_patch(Polygon([corner, *arc], fc=color, alpha=0.5, ec="none"))
    middle = corner + 0.23 * np.array([np.cos(ends.mean()), np.sin(ends.mean())])
    ax.text(*middle, name, color=color, ha="center", va="center", fontsize=12)


def _areas_around(ax):
    """Draw a third of every triangle around a vertex."""
    center = np.array([0.62, 0.56])
    angle = np.deg2rad([10, 75, 130, 200, 255, 310])
    length = np.array([0.5, 0.46, 0.52, 0.48, 0.47, 0.5])
    ring = center + length[:, None] * np.c_[np.cos(angle), np.sin(angle)]
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        ax.add_patch(Polygon([center, a, b], fc=SOFT["grey"], ec=GREY))
        middle = (center + a + b) / 3
        part = [center, (center + a) / 2, middle, (center + b) / 2]
        ax.add_patch(Polygon(part, fc=BLUE, alpha=0.35, ec="none"))
    ax.plot(*center, "o", color="black", ms=6)
    ax.set_title("vertex area: a third of each triangle")
    ax.text(0.6, -0.12, r"$a_i = \frac{1}{3} \sum$ areas around", ha="center")


def _box(ax, center, text, color, size):
    corner = np.subtract(center, np.divide(size, 2))
    style = {"boxstyle": "round,pad=0,rounding_size=0.06", "fc": color, "ec": "none"}
    ax.add_patch(FancyBboxPatch(corner, *size, **style, zorder=2))
    ax.text(*center, text, ha="center", va="center", zorder=3, fontsize=10)


def _arrow(ax, begin, end, text, *, bend=0.0, rise=0.1, across=0.0, color="black"):
    """Draw an arrow with a text, which is `across` and `rise` from the middle of the arrow."""
    style = {"arrowstyle": "-|>", "mutation_scale": 14, "lw": 1.6, "color": color}
    curve = f"arc3,rad={bend}"
    ax.add_patch(FancyArrowPatch(begin, end, **style, connectionstyle=curve, zorder=4))
    x, y = np.add(begin, end) / 2
    ax.text(x + across, y + rise, text, ha="center", va="center", color=color, fontsize=10)
