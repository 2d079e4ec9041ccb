"""The small study that tests share, and small pictures, shapes and searches where any will do."""

from importlib.util import find_spec

import numpy as np

OPTIONS = {"n_coarse": 400, "k_init": 10, "k": 24, "n_jobs": 1}
FLAGS = [
    word for name, value in OPTIONS.items() for word in (f"--{name.replace('_', '-')}", str(value))
]


def without_pictures(patch):
    """Let pages have pictures of a few pixels, and charts that are made but not drawn."""
    from s4a.show import charts, page, pictures

    patch.setattr(charts, "svg", lambda figure: b"<svg/>")
    for module in (page, pictures):
        patch.setattr(module, "render", lambda *a, **options: np.zeros((2, 2, 4), np.uint8))
    if find_spec("anywidget"):
        from s4a.widgets import views

        patch.setattr(views, "SIZE", (120, 96))  # of the stills of panels


def small_pictures(patch, figures=(72, 60), pages=None):
    """Let figures, and where a size is given pages, have pictures of few pixels."""
    from s4a.show import charts, draw, page, pictures

    sizes = {charts: figures} | (dict.fromkeys((page, pictures), pages) if pages else {})
    for module, few in sizes.items():
        patch(module, "render", lambda *a, few=few, **o: draw.render(*a, **o | {"size": few}))


def small_charts(patch):
    """Let charts be rendered with few pixels."""
    from matplotlib.backend_bases import FigureCanvasBase

    whole = FigureCanvasBase.print_figure
    few = lambda *what, dpi=None, **options: whole(*what, dpi=24, **options)  # noqa: E731
    patch(FigureCanvasBase, "print_figure", few)


def small_searches(patch):
    """Let partial shapes be matched by fewer points, and shapes be compared with fewer others."""
    from s4a.input import plausibility
    from s4a_morphometrics import completion, part

    patch(plausibility.pick_references, "__defaults__", (2,))
    patch(part.distinct, "__defaults__", (5,))
    patch(completion, "N_AGAIN", 12)
    for name, value in {"N_POINTS": 300, "N_ANCHORS": 3, "N_ROUGH": 80}.items():
        patch(part, name, value)


def small_brains(patch, most_shapes, most_vertices):
    """Let simulated collections have at most so many shapes and vertices."""
    from s4a import synthetic

    brains = synthetic.brains
    few = lambda m, n, **o: brains(min(m, most_shapes), min(n, most_vertices), **o)  # noqa: E731
    patch(synthetic, "brains", few)


def small_analyses(patch, n_coarse):
    """Let low resolutions have at most so many vertices."""
    import s4a

    def limited(function):
        def call(*args, **options):
            least = (
                {"n_coarse": min(options["n_coarse"], n_coarse)} if "n_coarse" in options else {}
            )
            return function(*args, **options | least)

        return call

    for name in ("analyse", "match_pair", "register_pairs"):
        patch(s4a, name, limited(getattr(s4a, name)))


def launch(argv):
    """Run a kernel in which pictures, collections and searches are small."""
    from ipykernel.kernelapp import launch_new_instance

    small_pictures(setattr, pages=(40, 32))
    small_charts(setattr)
    small_searches(setattr)
    small_brains(setattr, 6, 1000)
    small_analyses(setattr, 200)
    launch_new_instance(argv)
