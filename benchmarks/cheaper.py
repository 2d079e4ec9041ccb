"""What cheaper options, and a dearer one, cost in seconds and in error, against the truth.

``cheaper.py 6 12000`` analyses six brains of 12,000 vertices with each of :data:`OPTIONS`, in one
process: CPU seconds, and the mean error of the matches and of the registered surfaces in % of
sqrt(area).  The template is the same for all.  ``cheaper.py skulls`` does so for two pairs
of mouse skulls, one that was tuned on and one that was not: mm at 51 landmarks.
"""

import logging
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import peers

import s4a
from s4a import synthetic
from s4a.evaluation import accuracy

OPTIONS = {
    "default": {},
    "n_coarse=3000": {"n_coarse": 3000},
    "dense_iterations=0, n_samples=500": {"dense_iterations": 0, "n_samples": 500},
    'preset="fast"': {"preset": "fast"},
    'refine="spectral_icp"': {"refine": "spectral_icp"},
    'refine="spectral_icp", dense_iterations=0, n_samples=500': {
        "refine": "spectral_icp",
        "dense_iterations": 0,
        "n_samples": 500,
    },
    "n_coarse=9000, k=150": {"n_coarse": 9000, "k": 150},
    "k=60": {"k": 60},
    "refined_eigenfunctions=True": {"refined_eigenfunctions": True},
    "n_samples=0": {"n_samples": 0},
}


def skulls():
    folder = Path(tempfile.mkdtemp())
    subprocess.run([sys.executable, peers.DATA / "unpack.py", folder], check=True)
    pairs = [pair for chosen in (peers.TUNED, peers.REPORTED) for pair in chosen["skulls"][:1]]
    for title, template, shape, measure in peers.skulls(folder, pairs):
        sys.stdout.write(f"{title}\n")
        for options in ({}, {"n_coarse": 3000}, {"n_coarse": 10_000}, {"k": 60}, {"k": 150}):
            begin = time.process_time()
            image = peers.image_of(s4a.match_pair(shape, template, **options), template)
            spent, error = time.process_time() - begin, measure(image)[0]
            sys.stdout.write(f"{options or 'default'!s:36} {spent:7.1f} {error:8.3f}\n")
    shutil.rmtree(folder)


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
        study = s4a.analyse(brains, template="brain_01", include_flagged=True, n_jobs=1, **options)
        spent = time.process_time() - begin
        error = 100 * accuracy.accuracy(study, image)["error"].mean(["shape"])
        match, surface = (float(error.sel(algorithm=w)) for w in (accuracy.MATCH, accuracy.SURFACE))
        sys.stdout.write(f"{name:36} {spent:7.1f} {match:8.3f} {surface:9.3f}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    skulls() if sys.argv[1:] == ["skulls"] else main(*sys.argv[1:])
