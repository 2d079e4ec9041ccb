"""What cheaper options, and a dearer one, cost in seconds and in error, against the truth.

``cheaper.py 6 12000`` analyses six brains of 12,000 vertices with each of :data:`OPTIONS`, in one
process: CPU seconds, and the mean error of the matches and of the registered surfaces in % of
sqrt(area).  The template is the same for all.
"""

import logging
import sys
import time

import s4a
from s4a import synthetic
from s4a.evaluation import accuracy

OPTIONS = {
    "default": {},
    "n_coarse=3000": {"n_coarse": 3000},
    "wide=0, n_spread=500": {"wide": 0, "n_spread": 500},
    "n_coarse=3000, wide=0, n_spread=500": {"n_coarse": 3000, "wide": 0, "n_spread": 500},
    'refine="joint"': {"refine": "joint"},
    'refine="joint", wide=0, n_spread=500': {"refine": "joint", "wide": 0, "n_spread": 500},
    "the same, n_coarse=3000": {
        "refine": "joint",
        "wide": 0,
        "n_spread": 500,
        "n_coarse": 3000,
    },
    "n_coarse=9000, k=150": {"n_coarse": 9000, "k": 150},
    "k=60": {"k": 60},
    "lift=True": {"lift": True},
    "n_spread=0": {"n_spread": 0},
}


def main(n=6, n_vertices=12_000):
    brains = synthetic.brains(int(n), int(n_vertices), seed=3)
    truth = brains["truth"]
    logging.getLogger("s4a.study.runner").setLevel(logging.INFO)  # no bars

    def image(shape, template):
        return synthetic.position(truth, shape, truth[template]["reference_point"].values)

    sys.stdout.write(f"{n} brains of {n_vertices} vertices\n")
    sys.stdout.write(f"{'options':36} {'CPU s':>7} {'match %':>8} {'surface %':>9}\n")
    for name, options in OPTIONS.items():
        begin = time.process_time()
        study = s4a.analyse(brains, template="brain_01", keep_doubtful=True, n_jobs=1, **options)
        spent = time.process_time() - begin
        error = 100 * accuracy.accuracy(study, image)["error"].mean(["shape"])
        match, surface = (float(error.sel(way=w)) for w in (accuracy.MATCH, accuracy.SURFACE))
        sys.stdout.write(f"{name:36} {spent:7.1f} {match:8.3f} {surface:9.3f}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
