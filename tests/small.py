"""The options of the small study that tests share, as of Python and of the command line."""

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
