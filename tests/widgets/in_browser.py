"""S4A in a Python that lacks what a kernel in the browser (Pyodide) lacks.

``in_browser.py FOLDER STRUCTURES`` opens the studies of the folders, every panel and the cells of a
lesson, makes and analyses three brains, and says as JSON what was done.

Pyodide has NumPy, SciPy, h5py, xarray, scikit-image, matplotlib and scikit-learn. It has no libigl,
robust_laplacian, fpsample and psutil, and of Python itself no threads and some modules less.
``multiprocessing`` is there, as joblib and tqdm need it to be imported, but not its compiled part,
``_multiprocessing``: processes, pipes and locks cannot be made.
"""

import json
import re
import sys
import threading
from pathlib import Path

LACKING = "fpsample igl psutil robust_laplacian".split()
LACKING += "_multiprocessing fcntl grp pwd resource syslog termios".split()
LACKING += ["dask", "distributed"]  # xarray takes it where it finds it, and it needs processes
NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


class Without:
    """A finder of modules that does not find those that are lacking."""

    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in LACKING:
            return None
        return self.finder.find_spec(name, path, target)


def refuse(thread):
    """Raise the error of Pyodide."""
    raise RuntimeError("can't start new thread")


def block():
    """Hide the modules that Pyodide lacks, and forbid threads.

    scikit-learn is loaded before, as its newest version, unlike that of Pyodide, needs pipes; what
    it loaded of joblib and multiprocessing is loaded again without their compiled part.
    """
    import sklearn.decomposition  # noqa: F401

    for name in [*sys.modules]:
        if name.partition(".")[0] in ("joblib", "multiprocessing"):
            del sys.modules[name]
    sys.meta_path[:] = map(Without, sys.meta_path)
    for name in LACKING:
        sys.modules.pop(name, None)
    threading.Thread.start = refuse


def run_lesson(name, study):
    """Run the cells of a lesson on a ready study, with small brains and without the analysis."""
    (path,) = NOTEBOOKS.glob(f"{name}_*.ipynb")
    names = {"study": study, "display": lambda *shown: None}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = re.sub("^%.*", "", "".join(cell["source"]), flags=re.MULTILINE)
        text = re.sub(r"brains\(\d+, \d+", "brains(4, 200", text)
        if cell["cell_type"] == "code" and "s4a.analyse(" not in text:
            exec(text, names)
    return path.stem


def panels_of(study, several):
    """Every panel and its title; those of a comparison and a test are of small ones."""
    from s4a import compare, statistics, synthetic, widgets
    from s4a_morphometrics import Region, open_structures

    for title, kind in widgets.explore.PANELS.items():
        yield title, kind(study)
    yield "Region", Region(study)
    numbers = range(study["registration"].sizes["shape"])
    yield (
        "Maps",
        widgets.Maps(study, statistics.regression(study, numbers, of="normal", n_permutations=15)),
    )
    yield "Structures", widgets.Structures(open_structures(several).load())
    pair = [node.to_dataset() for node in synthetic.brains(2, 300)["original"].children.values()]
    options = {"n_coarse": 200, "k": 20, "k_init": 10, "n_geodesic": 50}
    compared = compare(*pair, methods=["kNN", "RE-MATCH"], keep=True, **options)
    yield "Comparison", widgets.Comparison(compared)


def refusals(shapes):
    """Return what cannot be done here, and its error message."""
    import numpy as np

    import s4a
    from s4a.method.remesh import laplacian

    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    for name, act in {
        "robust_laplacian": lambda: laplacian(line, np.array([[0, 1, 2]]), np.ones(3)),
        "processes": lambda: s4a.widgets.Progress(shapes, "somewhere"),
    }.items():
        try:
            act()
        except ImportError as error:
            yield name, str(error)


def main():
    """Do it all, and say what was done."""
    import s4a
    from s4a.widgets.panel import widgets_in

    done = {"panels": []}
    with s4a.open_study(sys.argv[1]) as study:
        for title, panel in panels_of(study, sys.argv[2]):
            for control in widgets_in(panel):
                if hasattr(control, "options"):  # the last of its list, which is computed then
                    control.index = len(control.options) - 1
            assert not panel.failed, f"{title}: {panel.message.value}"
            done["panels"].append(title)
        done["lesson"] = run_lesson("00", study)
    brains = s4a.synthetic.brains(3, 300)
    made = s4a.analyse(brains, n_coarse=100, k=10, k_init=6, include_flagged=True)
    done["modes"] = made["pca"].sizes["component"]
    done["refusals"] = dict(refusals(brains))
    sys.stdout.write(json.dumps(done))


if __name__ == "__main__":
    block()
    main()
