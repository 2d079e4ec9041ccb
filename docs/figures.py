"""Draw the pictures of README and pages: ``make figures``, or ``figures.py NAME ...``.

The figures of the paper show the sample data: twelve synthetic brains of 40,000 vertices, analysed
with all defaults, as by ``s4a demo``. The two panels are drawn in Chromium, and the scene in
JupyterLab in Chromium. NAME is the name of a picture without its suffix;
``docs/heads.png`` is made by ``benchmarks/compare.py heads``, and ``docs/structure.svg`` by
``make structure``.

Pictures of data that the project may not redistribute are drawn only if they are named and the data
are next to the checkout. They are written into ``docs/_build``: ``structures_real``.
"""

import re
import sys
import tempfile
from contextlib import chdir
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from PIL import Image

import s4a
import s4a_morphometrics
from s4a.datasets.synthetic import LABELS
from s4a.method import fmap, steps
from s4a.method import pca as modes
from s4a.show import charts
from s4a.show.draw import (
    OKABE_ITO,
    label_colors,
    on_white,
    plane_box,
    position_colors,
    render,
    signed_colors,
    with_balls,
)
from s4a.show.pictures import mode_pictures
from s4a.show.surfaces import mesh_of, mode_arrays, network_positions, surface, transferred_colors

HERE = Path(__file__).parent
LOCAL_FOLDER = HERE / "_build"
DATA = HERE.parents[1] / "shared" / "data"  # next to the checkout
VOLUMES = 24  # label volumes of hippocampi
SHAPES, VERTICES, PAIR = 12, 40_000, 10_000
LOOK = {"view": "corner", "up": "z"}
HALVES = {"default": None, "preset of the paper": "paper"}
DRAWN = (
    "[...document.querySelectorAll('canvas.s4a-view')]"
    ".some((c) => c.offsetParent && c.view && c.view.frames > 0)"
)
MOVE = """() => {
  const input = document.querySelector(".s4a-slider input");
  input.value = 2;
  input.dispatchEvent(new Event("input"));
}"""


@cache
def collection(shapes=SHAPES, vertices=VERTICES):
    return s4a.synthetic.brains(shapes, vertices, seed=0)


@cache
def analysed(preset=None, shapes=SHAPES, vertices=VERTICES):
    """Study of the collection; its folder exists as long as the process."""
    store = Path(tempfile.mkdtemp(prefix="s4a-figures-")) / "study"
    return s4a.analyse(collection(shapes, vertices), preset=preset, store=store, n_jobs=1)


def twice(draw, name, study, size, across=False):
    """Draw a figure of the paper by default and with its preset, next to or below each other."""
    figure = Figure(figsize=size, layout="constrained")
    parts = figure.subfigures(*((1, 2) if across else (2, 1)))
    for part, (title, preset) in zip(parts, HALVES.items(), strict=True):
        part.suptitle(title, fontsize=11, weight="bold")
        draw(part, study(preset))
    return write(figure, name)


def pictures_in(part, pictures):
    """Show pictures by title in a row."""
    axes = part.subplots(1, len(pictures))
    for ax, (title, picture) in zip(axes, pictures.items(), strict=True):
        ax.set_title(title, fontsize=10)
        ax.set_axis_off()
        if picture is not None:
            ax.imshow(picture)
    return axes


def write(figure, name, dpi=120, folder=None):
    """Write a matplotlib figure in 256 colours, next to this file or into a folder."""
    folder = HERE if folder is None else folder
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.png"
    figure.savefig(path, dpi=dpi, facecolor="white")
    reduce(path)
    return path


def reduce(path, width=None):
    """Reduce a picture to 256 colours and to a width."""
    picture = Image.open(path).convert("RGB")
    if width is not None and picture.width > width:
        picture = picture.resize((width, round(picture.height * width / picture.width)))
    # MEDIANCUT takes colours of most pixels; MAXCOVERAGE leaves stripes on shaded surfaces
    colours = picture.quantize(256, Image.Quantize.MEDIANCUT, kmeans=2, dither=Image.Dither.NONE)
    colours.save(path, optimize=True)


def tiled(pictures, columns=2):
    """Join pictures of one size, row by row."""
    white = np.full_like(pictures[0], 255)
    pictures = [*pictures, *[white] * (-len(pictures) % columns)]
    rows = [np.hstack(pictures[i : i + columns]) for i in range(0, len(pictures), columns)]
    return np.vstack(rows)


def near(X, T, share=0.2):
    """Enlarge the middle of a surface, so that every triangle is visible."""
    box = plane_box(X, **LOOK)
    frame = box.mean(0) + np.array([[-1], [1]]) * share * (box[1] - box[0])
    return seen(X[T].reshape(-1, 3), np.arange(T.size).reshape(-1, 3), frame=frame)


def seen(X, T, size=(240, 205), **options):
    return on_white(render(X, T, size=size, **LOOK, **options))


# --------------------------------------------------------------------- the figures of the paper


def pipeline(part, study):
    """Figure 1: input, low resolution, maps, correspondence and modes of variation."""
    template = study["registration"].attrs["template"]
    names = list(study["original"].children)
    shown = [template, *[name for name in names if name != template][:3]]
    X, T = mesh_of(study["registration"].dataset)
    colors = position_colors(X)
    matched = [(X, T, colors), *[transferred_colors(study, name, colors) for name in shown[1:]]]
    remeshed = [near(*surface(study, template, stage)) for stage in ("original", "coarse")]
    remeshed = [*[seen(*surface(study, template, s)) for s in ("original", "coarse")], *remeshed]
    drawn = mode_pictures(study, (-3, 3), 2, size=(240, 205), **LOOK)
    modes = [on_white(picture) for row in drawn for picture in row]
    parts = {
        "1 · a collection": tiled([seen(*surface(study, name, "original")) for name in shown]),
        "2 · remeshed": tiled(remeshed),
        "3 · a network of maps": None,
        "4 · in correspondence": tiled([seen(X, T, colors=c) for X, T, c in matched]),
        "5 · modes of variation": tiled(modes),
    }
    axes = pictures_in(part, parts)
    pairs = study["network"].dataset
    places = network_positions(study, names)
    ends = [[names.index(str(n)) for n in pairs[end].values] for end in ("source", "target")]
    lines = np.stack([places[ends[0]], places[ends[1]]])  # (2, pair, 2)
    axes[2].plot(lines[..., 0], lines[..., 1], color=charts.BLUE, linewidth=0.8, alpha=0.6)
    median = names.index(study["latent"].attrs["median"])
    axes[2].scatter(*places.T, s=26, color="#333333", zorder=2)
    axes[2].scatter(*places[median], s=110, facecolor="none", edgecolor=charts.ORANGE, zorder=3)
    axes[2].margins(0.12)


def swapped(vertices=6000, n_coarse=1500, stretch=1.2):
    """Figure 2: initial map and swapped eigenfunctions."""
    brains = s4a.synthetic.brains(2, vertices)
    source, target = (brains[f"original/brain_0{i}"].to_dataset() for i in (1, 2))
    high = target.assign(position=target["position"] * [1, 1, stretch])
    M, N, H = (
        s4a.spectrum(s4a.coarsen(mesh, n_coarse=n_coarse), k=100) for mesh in (source, target, high)
    )
    bases = steps.bases_of({"source": M, "target": N, "high": H})
    low = bases["source"], bases["target"]
    R, t, _ = s4a.geometry.align.align(low[1].X, low[1].area, low[0].X, low[0].area)
    lie = {"source": (np.eye(3), np.zeros(3)), "high": (R, t)}  # as in a scanner: alike
    found = steps.map_pairs(
        {name: bases[name] for name in lie}, lie, [("source", "high")], init="landmarks"
    )
    C = found["fmap_initial"].values[0]
    runs = fmap.swapped_blocks(C)
    sys.stdout.write(f"figure 2: eigenfunctions that are exchanged: {runs[:3]}\n")
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 2.1))
    ax = left.subplots()
    image = ax.imshow(C, cmap=charts.SIGNED, vmin=-1, vmax=1)
    ax.set(title="C, 20 × 20", xlabel="mode of the source", ylabel="mode of the target")
    left.colorbar(image, ax=ax, shrink=0.7, location="left")
    rows = (("source", M, np.eye(3)), ("target", H, R))
    for row, (name, mesh, turn) in zip(right.subplots(2, 4), rows, strict=True):
        X, T = mesh_of(mesh)
        X = X @ turn.T
        for i, ax in enumerate(row, 1):
            values = mesh["eigenfunction"].values[:, i]
            colors = signed_colors(values, np.quantile(np.abs(values), 0.99))
            ax.imshow(on_white(render(X, T, colors=colors, view="front", size=(300, 260))))
            ax.set_title(f"{name}, mode {i}", fontsize=9)
            ax.set_axis_off()
    return write(figure, "figure_2")


def seconds(vertices=PAIR):
    """Figure 3: CPU seconds of every step of the methods on one pair."""
    brains = s4a.synthetic.brains(2, vertices, seed=0)
    source, target = (brains[f"original/brain_0{i}"].to_dataset() for i in (1, 2))
    found = s4a.compare(source, {"brain_02": target})["block_seconds"].isel(pair=0)
    found = found.drop_sel(algorithm="registered surface")  # the same run as "registered"
    blocks = [str(name) for name in found["block"].values]
    return write(
        charts.stacked([str(w) for w in found["algorithm"].values], blocks, found.values),
        "figure_3",
    )


def components(part, study):
    """Figure 4: the first three components at -3 and +3 standard deviations, on one scale."""
    share = study["pca"]["explained_variance_ratio"].values
    rows = part.subplots(3, 2)
    for i, row in enumerate(mode_pictures(study, (-3, 3))):
        for ax, score, picture in zip(rows[i], "−+", row, strict=True):
            ax.imshow(on_white(picture))
            ax.set_title(f"mode {i + 1} ({share[i]:.0%}), {score}3 σ", fontsize=9)
            ax.set_axis_off()


def film(study, n_frames=36):
    """Film at the top of README: the first three modes of variation."""
    modes, path = (1, 2, 3), HERE / "modes.gif"
    return s4a.write_film(study, path, mode=modes, width=720, n_frames=n_frames, seconds=5)


def variance(study):
    """Figure 5: explained variance at both resolutions, registered as in the paper."""
    registration = study["registration"].to_dataset()
    names = registration["shape"].values.tolist()
    R, t = registration["icp_rotation"].values, registration["icp_translation"].values
    options = {"refine": "intrinsic", "displacement_alignment": "initial"}
    fields = [
        s4a.register_shape(study, name, initial_transform=transform, **options)
        for name, *transform in zip(names, R, t, strict=True)
    ]
    fields = xr.concat([f[["displacement", "displacement_low"]] for f in fields], "shape")
    area = s4a.geometry.mesh.vertex_areas(*mesh_of(registration))
    template = study["coarse"][registration.attrs["template"]].to_dataset()
    paper = modes.pca(fields.assign_coords(shape=names), area, coarse=template)
    high, low = (paper[f"explained_variance_ratio{kind}"].values for kind in ("", "_low"))
    ours = study["pca"]["explained_variance_ratio"].values
    figure = charts.variance(high, low)
    (ax,) = figure.axes
    share = np.cumsum(ours)
    ax.plot(np.arange(1, len(share) + 1), share, color=charts.GREY, label="default", zorder=0)
    ax.legend(frameon=False, loc="lower right")
    for name, ratio in (("high", high), ("low", low), ("default", ours)):
        sys.stdout.write(f"figure 5: {name}: {ratio[:3].sum():.0%} by three components\n")
    return write(figure, "figure_5")


@cache
def carried(preset=None, shapes=5, vertices=PAIR):
    """Study of a collection, and a template that is not in it."""
    brains = s4a.synthetic.brains(shapes, vertices, seed=0)
    meshes = {name: node.to_dataset() for name, node in brains["original"].children.items()}
    template = meshes.pop(f"brain_{shapes:02d}")
    return s4a.analyse(meshes, preset=preset, n_jobs=1), template


def labels(part, held_out):
    """Figure 6: labels of a template, transferred to a shape of the collection."""
    study, template = held_out
    target = study["original"]["brain_01"].to_dataset()
    tree = s4a.transfer_labels(study, template["label"].values, source=template)
    found = tree["brain_01/label"].values
    own = target["label"].values
    right = s4a.metrics.label_accuracy(found, own, s4a.geometry.mesh.vertex_areas(*mesh_of(target)))
    sys.stdout.write(f"figure 6: {right:.1%} of the area has its own label\n")
    palette = label_colors(np.arange(len(LABELS)))
    shown = {
        "template": (template, template["label"].values),
        "transferred to the shape": (target, found),
        "the shape's own": (target, own),
    }
    options = {"flat": True, "size": (360, 300)}
    drawn = {
        title: on_white(render(*mesh_of(mesh), colors=palette[values], **options))
        for title, (mesh, values) in shown.items()
    }
    pictures_in(part, drawn)


def landmarks(part, held_out):
    """Figure 7: transferred landmarks of the same template, and the ground truth."""
    study, template = held_out
    target = study["original"]["brain_01"].to_dataset()
    marks = template[["landmark_name", "landmark_position"]]
    tree = s4a.transfer_landmarks(study, marks, source=template)
    found, true = tree["brain_01/landmark_position"].values, target["landmark_position"].values
    error = np.linalg.norm(found - true, axis=1)
    sys.stdout.write(f"figure 7: {error.mean():.1f} mm off, the worst {error.max():.1f}\n")
    palette = np.array([to_rgb(OKABE_ITO[i % len(OKABE_ITO)]) for i in range(len(true))])
    shown = {
        "template": (template, marks["landmark_position"].values),
        "transferred to the shape": (target, found),
        "true positions": (target, true),
    }
    drawn = {}
    for title, (mesh, places) in shown.items():
        balls = np.column_stack([places, palette, np.full(len(places), 5.0)]).tolist()
        X, T, colors = with_balls(*mesh_of(mesh), None, balls)
        drawn[title] = on_white(render(X, T, colors=colors, view=(200, 15), size=(360, 300)))
    pictures_in(part, drawn)


# ------------------------------------------------------------------------------------ the panels


def front_ends():
    """Script that opens notebooks in Chromium."""
    sys.path.insert(0, str(HERE.parent / "benchmarks"))
    import frontends

    return frontends


def panel(widget, name, act):
    """Picture of the page of a panel in Chromium, 894 pixels wide."""
    from playwright.sync_api import sync_playwright

    front = front_ends()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        page_file = widget.save_html(Path(folder) / "panel.html", limit=0)
        browser = front.chromium.launched(driver)
        page = browser.new_page(viewport={"width": 910, "height": 1000})
        page.goto(page_file.as_uri())
        page.wait_for_function(DRAWN)
        act(page)
        page.wait_for_timeout(3000)
        path = HERE / f"{name}.png"
        page.locator("#w0").screenshot(path=path)
        browser.close()
    reduce(path)
    return path


def sliders(study):
    """Panel of modes, the first at two standard deviations."""
    from s4a import widgets

    return panel(widgets.Modes(study), "pca", lambda page: page.evaluate(MOVE))


def network(study):
    """Panel of the functional map network."""
    from s4a import widgets

    shown = widgets.Network(study)
    shown.where.value, shown.budget.value = "shape differences", 30
    shown.edge = shown.shown[0]
    return panel(shown, "network", lambda page: None)


# ------------------------------------------------------------------------------------ the scene

SCENE = """
import s4a
from s4a.widgets import threejs

study = s4a.open_study({store!r})
joined = threejs.correspondence(study, "brain_01", "brain_02", n_lines=40)
view = threejs.renderer(joined, size=(860, 380), view="front")
view
"""


def scene(study):
    """Scene of pythreejs in a notebook in JupyterLab."""
    import nbformat
    from playwright.sync_api import sync_playwright

    front = front_ends()
    store = Path(study["coarse/brain_01"].to_dataset().encoding["source"]).parents[1]
    cell = nbformat.v4.new_code_cell(SCENE.format(store=str(store)))
    path = HERE / "scene.png"
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
        notebook = nbformat.v4.new_notebook(cells=[cell], metadata={"kernelspec": kernel})
        nbformat.write(notebook, Path(folder) / "panel.ipynb")
        browser = front.chromium.launched(driver)
        with front.served("jupyterlab", Path(folder)) as address:
            page = browser.new_page(viewport={"width": 1600, "height": 1000})
            page.set_default_timeout(180_000)
            page.goto(address)
            page.wait_for_selector(".jp-Cell")
            page.wait_for_timeout(3000)  # the kernel
            page.evaluate("window.jupyterapp.commands.execute('notebook:run-all-cells')")
            drawn = page.locator(".jp-OutputArea-output canvas").first
            drawn.wait_for()
            page.wait_for_timeout(5000)
            drawn.screenshot(path=path)
        browser.close()
    return path


def reliability():
    """Reliability diagram of confidence, from the table that ``confidence.py`` prints."""
    text = (HERE / "decisions.md").read_text(encoding="utf-8")
    said, right = (
        [float(cell) for cell in re.search(rf"\| {row} \|(.+)\|", text)[1].split("|")]
        for row in ("confidence", "share that is right")
    )
    figure = Figure(figsize=(3.6, 3.4), layout="constrained")
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1], color="#dddddd")
    ax.plot(said, right, "o-", color=charts.BLUE)
    ax.set(xlabel="confidence", ylabel="share within 1 % of √area", xlim=(0, 1), ylim=(0, 1))
    ax.set_aspect("equal")
    return write(figure, "reliability")


# ------------------------------------------------------------------- data that are not given away


@cache
def hippocampi(n=VOLUMES):
    """Study of the anterior and the posterior part of real hippocampi."""
    files = sorted((DATA / "hippocampi_msd").glob("*.nii.gz"))[:n]
    if len(files) < n:
        raise ValueError(
            f"{n} label volumes of hippocampi needed in {DATA / 'hippocampi_msd'}, "
            f"found {len(files)}: those of Task04 of the Medical Segmentation Decathlon"
        )
    parts = {"anterior": 1, "posterior": 2}
    return s4a_morphometrics.analyse_structures(files, structures=parts, n_coarse=1000, k=60)


def joint_modes(study, what, name, folder=LOCAL_FOLDER, n_modes=3):
    """First joint modes of several structures, each from above and from the side."""
    found = s4a_morphometrics.structures(study)
    names = found["structure"].values.tolist()
    mean, T, steps = mode_arrays(s4a_morphometrics.structures_modes(study, found), n_modes=n_modes)
    palette = np.array([to_rgb(OKABE_ITO[i]) for i in (0, 4, 2, 6, 1, 5, 3, 7)])
    colors = palette[found["structure_of_vertex"].values % len(palette)]
    ends = np.concatenate([mean + s * step for step in steps for s in (-2, 2)])
    share = found["level_share"].sum("structure")
    figure = Figure(figsize=(10, 0.7 + 1.5 * len(steps)), layout="constrained")
    figure.suptitle(
        f"{found.sizes['shape']} {what}: {100 * float(share.sel(level='between')):.0f} % of the "
        f"variance between the structures, {100 * float(share.sel(level='within')):.0f} % within",
        fontsize=11,
    )
    rows = figure.subplots(len(steps), 3, squeeze=False)
    for i, (step, row) in enumerate(zip(steps, rows, strict=True)):
        for s, ax in zip((-2, 0, 2), row, strict=True):
            views = [
                render(
                    mean + s * step, T, colors=colors, flat=True, view=view, size=size,
                    frame=plane_box(ends, view),
                )
                for view, size in (("top", (230, 300)), ("left", (300, 300)))
            ]  # fmt: skip
            ax.imshow(on_white(np.hstack(views)))
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
        explained, between = (
            100 * float(found[v][i]) for v in ("explained_variance_ratio", "between_share")
        )
        row[0].set_ylabel(
            f"mode {i + 1}: {explained:.0f} %\n{between:.0f} % of it between", fontsize=9
        )
    for ax, title in zip(rows[0], ("−2 sd", "mean", "+2 sd"), strict=True):
        ax.set_title(title, fontsize=10)
    kinds = [Patch(color=palette[k % len(palette)], label=one) for k, one in enumerate(names)]
    figure.legend(handles=kinds, loc="outside lower center", ncols=len(kinds), frameon=False)
    return write(figure, name, folder=folder)


def quickstart():
    """Run the quickstart of README and keep its picture."""
    readme = (HERE.parent / "README.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", readme, re.DOTALL)[1]
    path = HERE / "quickstart.png"
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        exec(code, {})
        path.write_bytes(Path("modes.png").read_bytes())
    reduce(path)
    return path


PICTURES = {
    "quickstart": quickstart,
    "figure_1": lambda: twice(pipeline, "figure_1", analysed, (11, 5.2)),
    "figure_2": swapped,
    "figure_3": seconds,
    "figure_4": lambda: twice(components, "figure_4", analysed, (11, 7.2), across=True),
    "modes": lambda: film(analysed()),
    "figure_5": lambda: variance(analysed()),
    "figure_6": lambda: twice(labels, "figure_6", carried, (7.5, 5.4)),
    "figure_7": lambda: twice(landmarks, "figure_7", carried, (7.5, 5.4)),
    "pca": lambda: sliders(analysed()),
    "network": lambda: network(analysed()),
    "scene": lambda: scene(analysed()),
    "reliability": reliability,
}
LOCAL = {"structures_real": lambda: joint_modes(hippocampi(), "hippocampi", "structures_real")}


def main(names):
    known = PICTURES | LOCAL
    unknown = set(names) - set(known)
    if unknown:
        sys.stderr.write(f"pictures are {', '.join(known)}, found {', '.join(unknown)}\n")
        return 2
    for name in names or PICTURES:
        sys.stdout.write(f"{known[name]().relative_to(HERE.parent)}\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
