"""Correspondence errors against the truth.

Beside nearest neighbour after ICP and pairwise ZoomOut on the same shapes.

The sample data, clean and dirty, and 25 registered faces where the shared data are beside
the checkout.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import s4a
from s4a import synthetic
from s4a.cli.tables import error_table
from s4a.evaluation.accuracy import accuracy

DATA = Path(__file__).parents[2] / "shared" / "data"


def report(name, study, image):
    errors = accuracy(study, image, n_geodesic=200, n_jobs=-1)
    sys.stdout.write(f"\n{name}: {errors.sizes['shape']} shapes\n{error_table(errors)}\n")
    sys.stdout.flush()


def embedded(dirty):
    collection = synthetic.brains(12, 40_000, 0, dirty=dirty)
    truth = collection["truth"]
    report(
        f"sample data, {'dirty' if dirty else 'clean'}",
        s4a.analyse(collection, n_jobs=-1),
        lambda shape, template: synthetic.position(
            truth, shape, truth[template]["reference_point"].values
        ),
    )


def faces():
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [sys.executable, DATA / "unpack.py", folder, "faces"],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        study = s4a.analyse(Path(folder) / "faces", n_jobs=-1)
    position = {name: node["position"].values for name, node in study["original"].children.items()}
    report("registered faces, vertex i is vertex i", study, lambda shape, template: position[shape])


if __name__ == "__main__":
    embedded(dirty=False)
    embedded(dirty=True)
    if DATA.is_dir():
        faces()
