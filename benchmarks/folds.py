"""How often a registered brain lies on a fold beside the right one.

``folds.py SEED ...``: all ordered pairs of five synthetic brains of each seed, 20,000 vertices, as
they are matched alone by default, and without the iterations that begin less stiff where the
template is torn.  ``folds.py --studies SEED ...``: the same in studies of sixteen brains of 2,500
vertices, 600 of low resolution and 50 functions, where folds are as wide as a few edges.  Errors
are mean distances of the registered template's vertices from the truth, % of sqrt(area).
"""

import sys
import time
from itertools import permutations
from unittest import mock

import numpy as np
from joblib import Parallel, delayed
from peers import image_of
from threadpoolctl import threadpool_limits

import s4a
from s4a import synthetic
from s4a.method import register

FAR = 0.9  # %: about the width of a fold over a tenth of the surface
WAYS = {"default": register.MAX_STRAIN, "without": np.inf}


def errors(tree, a, b, match):
    """Of both ways: mean error of the template `a` registered to `b`, and CPU seconds."""
    template, shape = (tree["original"][name].to_dataset() for name in (a, b))
    at = tree["truth"][a]["reference_point"].values
    true = synthetic.position(tree["truth"], b, at)
    found = {}
    for way, torn in WAYS.items():
        begin = time.process_time()
        with threadpool_limits(1), mock.patch.object(register, "MAX_STRAIN", torn):
            image = image_of(match(a, b), template)
        gap = np.linalg.norm(image - true, axis=1).mean() / np.sqrt(shape.attrs["area"])
        found[way] = 100 * gap, time.process_time() - begin
    return found


def pairs_alone(seed):
    """The errors of all ordered pairs of five brains."""
    tree = synthetic.brains(5, 20_000, seed)

    def match(a, b):
        return s4a.match_pair(*(tree["original"][name].to_dataset() for name in (b, a)))

    pairs = permutations(tree["original"].children, 2)
    return Parallel(n_jobs=-1)(delayed(errors)(tree, *pair, match) for pair in pairs)


def study(seed):
    """The errors of the registrations of one study."""
    tree = synthetic.brains(16, 2500, seed)
    found = s4a.analyse(tree, n_coarse=600, k=50, n_jobs=-1)
    median = found["latent"].attrs["median"]

    def match(_, name):
        return s4a.register_shape(found, name)

    others = [name for name in tree["original"].children if name != median]
    return Parallel(n_jobs=-1)(delayed(errors)(tree, median, name, match) for name in others)


def main(*words):
    measured = study if "--studies" in words else pairs_alone
    sys.stdout.write(f"{'seed':6} {'':8} {'mean':>7} {'median':>7} {f'> {FAR}':>7} {'CPU s':>7}\n")
    for seed in (word for word in words if word != "--studies"):
        found = measured(int(seed))
        for way in WAYS:
            error, seconds = np.array([one[way] for one in found]).T
            sys.stdout.write(
                f"{seed:6} {way:8} {error.mean():7.3f} {np.median(error):7.3f} "
                f"{(error > FAR).sum():4} of {len(error)} {seconds.mean():4.1f}\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
