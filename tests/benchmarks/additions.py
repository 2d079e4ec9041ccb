"""What each addition to the paper is worth: the paper, one addition at a time, all of them.

Mean distances to the truth in % of sqrt(area), of the matched vertices and of the registered
surface, and CPU seconds of the analysis.  ``additions.py brains`` or ``additions.py faces`` (with
the shared data beside the checkout) runs one set.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import s4a
from s4a import synthetic
from s4a.study.options import DEFAULTS, PAPER

DATA = Path(__file__).parents[3] / "shared" / "data"
# of a study; the others are of pairs that are matched on their own
ROWS = {
    "the paper, eq. 7": PAPER,
    "the paper, eq. 3 and 4": PAPER | {"how": "standard"},
    "paper, lift": PAPER | {"lift": True},
    "paper, init dense": PAPER | {"init": DEFAULTS["init"]},
    "paper, no step ahead": PAPER | {"ahead": "never"},
    "paper, 1000 spread vertices": PAPER | {"n_spread": DEFAULTS["n_spread"]},
    "the same and wide rounds": PAPER | {name: DEFAULTS[name] for name in ("n_spread", "wide")},
    "paper, alignment fitted": PAPER | {"alignment": DEFAULTS["alignment"]},
    "paper, area weighted": PAPER | {"area_weighted": DEFAULTS["area_weighted"]},
    "paper, 25,000 projected": PAPER | {"n_projected": DEFAULTS["n_projected"]},
    "paper, equal weights": PAPER | {"weights": "equal"},
    "paper, joint": PAPER | {"refine": DEFAULTS["refine"]},
    "all additions, the default": {},
}


def brains():
    """Six brains of 10,000 vertices, and where every template vertex is on each."""
    tree = synthetic.brains(6, 10_000, 3)
    truth = tree["truth"]

    def image(shape, template):
        return synthetic.position(truth, shape, truth[template]["reference_point"].values)

    return tree, image


def faces():
    """Six registered faces; vertex i is vertex i."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, DATA / "unpack.py", folder, "faces"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        tree = s4a.read_shapes(sorted(map(str, (Path(folder) / "faces").iterdir()))[:6])
    position = {name: node["position"].values for name, node in tree["original"].children.items()}
    return tree, lambda shape, template: position[shape]


def errors(study, image):
    """Mean errors of the matched vertices and of the registered surface, in % of sqrt(area)."""
    registration = study["registration"].to_dataset()
    template = registration.attrs["template"]
    size = np.sqrt(registration["vertex_area"].values.sum())
    found = []
    for name in registration["shape"].values.tolist():
        if name == template:
            continue
        one = registration.sel(shape=name)
        true = np.asarray(image(name, template))
        matched = study["original"][name]["position"].values[one["registered_match"].values]
        moved = one["position"].values + one["displacement"].values - one["translation"].values
        surface = moved @ one["rotation"].values / one["scale"].item()
        ends = np.stack([matched, surface])
        found.append(np.linalg.norm(ends - true, axis=2).mean(1))
    return 100 * np.mean(found, axis=0) / size


def table(name, tree, image):
    template = sorted(tree["original"].children)[0]  # the same for all
    sys.stdout.write(f"\n{name}: {'matched':>36} {'surface':>9} {'CPU s':>7}\n")
    for row, options in ROWS.items():
        begin = time.process_time()
        study = s4a.analyse(tree, n_coarse=2000, template=template, n_jobs=1, **options)
        spent = time.process_time() - begin
        match, surface = errors(study, image)
        sys.stdout.write(f"{row:36} {match:9.3f} {surface:9.3f} {spent:7.1f}\n")
        sys.stdout.flush()


SETS = {"brains": brains, "faces": faces}

if __name__ == "__main__":
    for which in sys.argv[1:] or SETS:
        table(which, *SETS[which]())
