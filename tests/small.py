"""The small study that tests share, and small pictures, shapes and searches where any will do."""

from importlib.util import find_spec

import numpy as np

OPTIONS = {"n_coarse": 400, "k_init": 10, "k": 24, "n_jobs": 1}
FLAGS = [
    word for name, value in OPTIONS.items() for word in (f"--{name.replace('_', '-')}", str(value))
]


def without_pictures(patch):
    """Let pages have pictures of a few pixels."""
    from s4a.show import page, pictures

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


def small_searches(patch):
    """Let partial shapes be matched by fewer points, from fewer initialisations."""
    from s4a_morphometrics import part

    for name, value in {"N_POINTS": 300, "N_ANCHORS": 3, "N_ROUGH": 80}.items():
        patch(part, name, value)


def small_brains(patch, most_shapes, most_vertices):
    """Let simulated collections have at most so many shapes and vertices."""
    from s4a import synthetic

    brains = synthetic.brains
    few = lambda m, n, **o: brains(min(m, most_shapes), min(n, most_vertices), **o)  # noqa: E731
    patch(synthetic, "brains", few)


def launch(argv):
    """Run a kernel in which pictures, collections and searches are small."""
    from ipykernel.kernelapp import launch_new_instance

    small_pictures(setattr)
    small_searches(setattr)
    small_brains(setattr, 8, 2500)
    launch_new_instance(argv)
