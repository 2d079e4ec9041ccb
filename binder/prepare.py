"""The study of 51 synthetic brains that the notebook of the sliders opens.

Reduced to what the panels show.

``python binder/prepare.py`` makes it where it is not there yet; Binder does so when its image is
built.
"""

import argparse
import shutil
import tempfile
from pathlib import Path

import numpy as np

import s4a
from s4a.study import netcdf, store

FOLDER = Path(__file__).resolve().parent / "study_51"
LIMIT = 15e6  # bytes
BITS = 12
NOT_SHOWN = (
    *(
        "displacement_raw",
        "displacement_low",
        "round_trip",
        "distortion",
        "vertex_of_file",
    ),
    *("edge_vertex", "cotan_weight"),
)


def reduced(data):
    """A Dataset of a study without what no panel shows.

    It is rounded to about four digits, so it compresses well.
    """
    data = data.drop_vars(NOT_SHOWN, errors="ignore")
    for name, values in data.data_vars.items():
        if values.dtype.kind == "f":
            data[name] = values.copy(data=rounded(values.values))
        elif values.dtype == np.int64:
            data[name] = values.astype(np.int32)
    return data


def rounded(values, bits=BITS):
    """The values in single precision, their last binary digits 0: `bits` of the 23 are kept.

    >>> float(rounded(1 / 3, 2))
    0.3125
    """
    drop = 23 - bits
    whole = np.asarray(values, np.float32).view(np.uint32)
    found = (whole + np.uint32(1 << drop - 1)) & np.uint32(~((1 << drop) - 1) & 0xFFFFFFFF)
    return np.where(np.isfinite(values), found, whole).astype(np.uint32).view(np.float32)


def reduce(whole, small):
    """Write the study in the folder `whole`, reduced, into the folder `small`."""
    for path in sorted(Path(whole).rglob("*.nc")):
        name = path.relative_to(whole)
        if name.parent.name != "network":  # initial maps and transforms are not shown
            data = netcdf.read(path)
            key, made_from = data.attrs["task_key"], data.attrs["made_from"].split()
            store.write(reduced(data), Path(small) / name, key, made_from, compression=4)


def collection(folder=FOLDER, *, n=51, n_vertices=2000, n_coarse=600, n_pairs=150, k=30):
    """The study's folder, which is computed where it is not there yet.

    Raises
    ------
    ValueError
        When it would be larger than 15 MB.
    """
    folder = Path(folder)
    if folder.is_dir():
        return folder
    brains = s4a.synthetic.brains(n, n_vertices)
    with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
        whole, small = Path(temporary) / "whole", Path(temporary) / "small"
        s4a.analyse(brains, n_coarse=n_coarse, n_pairs=n_pairs, k=k, store=whole)
        reduce(whole, small)
        if (size := size_of(small)) > LIMIT:
            raise ValueError(
                f"the study needs at most {LIMIT / 1e6:.0f} MB, found {size / 1e6:.1f}; "
                "lower n_vertices"
            )
        shutil.move(small, folder)
    return folder


def size_of(folder):
    """Bytes of all files of a folder."""
    return sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    for name, default in collection.__kwdefaults__.items():
        options.add_argument("--" + name.replace("_", "-"), type=int, default=default)
    collection(**vars(options.parse_args()))
