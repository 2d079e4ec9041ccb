"""How often a registered brain lies on a fold beside the right one, pairs matched alone.

``folds.py SEED ...``: all ordered pairs of five synthetic brains of each seed, as they are matched
by default, and without the rounds that begin less stiff where the template is torn.  Errors are
mean distances of the registered template's vertices from the truth, % of sqrt(area).
"""

import sys
import time
from itertools import permutations

import numpy as np
from joblib import Parallel, delayed
from peers import image_of
from threadpoolctl import threadpool_limits

import s4a
from s4a import synthetic
from s4a.method import register

N, N_VERTICES = 5, 20_000
FAR = 0.9  # %: about the width of a fold over a tenth of the surface
WAYS = {"default": register.TORN, "without": np.inf}


def errors(tree, a, b):
    """Of both ways: mean error of the template `a` registered to `b`, and CPU seconds."""
    template, shape = (tree["original"][name].to_dataset() for name in (a, b))
    at = tree["truth"][a]["reference_point"].values
    true = synthetic.position(tree["truth"], b, at)
    found = {}
    for way, register.TORN in WAYS.items():
        begin = time.process_time()
        with threadpool_limits(1):
            image = image_of(s4a.match_pair(shape, template), template)
        gap = np.linalg.norm(image - true, axis=1).mean() / np.sqrt(shape.attrs["area"])
        found[way] = 100 * gap, time.process_time() - begin
    return found


def main(*seeds):
    sys.stdout.write(f"{'seed':6} {'':8} {'mean':>7} {'median':>7} {f'> {FAR}':>7} {'CPU s':>7}\n")
    for seed in seeds:
        tree = synthetic.brains(N, N_VERTICES, int(seed))
        pairs = [*permutations(tree["original"].children, 2)]
        found = Parallel(n_jobs=-1)(delayed(errors)(tree, *pair) for pair in pairs)
        for way in WAYS:
            error, seconds = np.array([one[way] for one in found]).T
            sys.stdout.write(
                f"{seed:6} {way:8} {error.mean():7.3f} {np.median(error):7.3f} "
                f"{(error > FAR).sum():4} of {len(pairs)} {seconds.mean():4.1f}\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
