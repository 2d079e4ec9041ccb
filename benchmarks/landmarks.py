"""Landmarks that guide registration: what those that were not given gain or lose by it.

``landmarks.py [--tuned]``: pairs of mouse skulls of the shared data with 51 landmarks each.  Five
times every fifth is given (ten or eleven), and the distance of all to where they were marked is
told in mm, apart for the given and the others, beside a registration without any.  Their weight
was chosen on the pair that ``--tuned`` shows.  Large pose differences are in ``poses.py
--landmarks``.
"""

import argparse
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from peers import DATA, REPORTED, TUNED, ours

import s4a
from s4a.geometry.closest import closest_point, interpolate
from s4a.geometry.mesh import as_arrays
from s4a.input.annotations import read_landmarks

EVERY = 5


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--tuned", action="store_true")
    pairs = (TUNED if parser.parse_args().tuned else REPORTED)["skulls"]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, DATA / "unpack.py", folder, "skulls"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        files = sorted((Path(folder) / "skulls").glob("*.ply"))
        for a, b in pairs:
            report(files[a], files[b])


def report(file, other):
    """A line for a template and a shape without landmarks, and one for each fifth of them."""
    template, shape = (s4a.read_shape(f) for f in (file, other))
    marks = [read_landmarks(f.with_suffix(".mrk.json")) for f in (file, other)]
    without = distances(template, shape, marks)
    sys.stdout.write(f"{file.stem} to {other.stem}: without {without.mean():.3f} mm\n")
    fifth = np.arange(len(without)) % EVERY
    held = []
    for i in range(EVERY):
        given = np.flatnonzero(fifth == i)
        pair = [
            s4a.with_landmarks(mesh, mark.isel(landmark=given))
            for mesh, mark in zip((template, shape), marks, strict=True)
        ]
        error = distances(*pair, marks)
        held.append(error[fifth != i].mean())
        sys.stdout.write(
            f"  {len(given)} given: {without[given].mean():.3f} -> {error[given].mean():.3f}, "
            f"others {without[fifth != i].mean():.3f} -> {held[-1]:.3f}\n"
        )
    sys.stdout.write(f"  others in the mean {without.mean():.3f} -> {np.mean(held):.3f}\n")


def distances(template, shape, marks):
    """Of the landmarks of the template, transferred to the shape, to those marked there, in mm."""
    (X, T), (Y, S) = as_arrays(template), as_arrays(shape)
    there, true = (mark["landmark_position"].values.astype(float) for mark in marks)
    at = interpolate(ours(template, shape, None, "elastic"), T, *closest_point(there, X, T))
    return np.linalg.norm(interpolate(Y, S, *closest_point(at, Y, S)) - true, axis=1)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
