"""A hash of every array that S4A computes on small inputs, to compare two versions of the code.

Run ``python tools/hashes.py --write before.txt``, change the code, and run
``python tools/hashes.py before.txt``: it prints every array that is no longer bit-identical and
then ends with 1.  With ``--keep FOLDER`` in both runs it also prints the largest difference,
relative to the largest value of the array.  A change of structure or of names changes no line; it
takes about a quarter of a minute on one core.
"""

import argparse
import hashlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

import s4a

SMALL = {"n_coarse": 300, "k": 30, "n_pairs": 8, "seed": 0}


def arrays_of(name: str, result: xr.Dataset | xr.DataTree) -> Iterator[tuple[str, np.ndarray]]:
    """Every variable of a Dataset or tree, but for times, under its path."""
    nodes = result.subtree if isinstance(result, xr.DataTree) else [result]
    for node in nodes:
        path = getattr(node, "path", "/")
        if path.startswith("/report"):  # seconds and memory
            continue
        for key in sorted(map(str, node.variables)):
            yield f"{name}{path.rstrip('/')}/{key}", np.asarray(node[key].values)


def results(folder: Path) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of four studies, a pair, an insertion and a transfer."""
    brains = s4a.synthetic.brains(6, 1500, seed=1)
    shapes, new = list(brains["original"])[:5], list(brains["original"])[5]
    first = xr.DataTree.from_dict(
        {f"/original/{name}": brains["original"][name].to_dataset() for name in shapes}
    )
    study = s4a.analyse(first, **SMALL, store=folder / "default")
    yield from arrays_of("default", study)
    yield from arrays_of("memory", s4a.analyse(first, **SMALL))
    yield from arrays_of("paper", s4a.analyse(first, **SMALL, preset="paper"))
    yield from arrays_of("scalable", s4a.analyse(first, **SMALL, method="scalable"))
    one, other = (brains["original"][name].to_dataset() for name in (shapes[0], new))
    yield from arrays_of("pair", s4a.match_pair(one, other, n_coarse=300, k=30))
    yield from arrays_of("insert", s4a.insert(study, {new: other}))
    template = study["original"][study["latent"].attrs["median"]]
    label = (template["position"].values[:, 2] > 0).astype(int)
    yield from arrays_of("transfer", s4a.transfer_labels(study, label))


def hash_of(values: np.ndarray) -> str:
    """Sixteen digits of what an array holds, its shape and kind."""
    data = repr(values.tolist()).encode() if values.dtype.hasobject else values.tobytes()
    return hashlib.sha256(f"{values.dtype}{values.shape}".encode() + data).hexdigest()[:16]


def difference(old: Path, values: np.ndarray) -> str:
    """The largest difference from the array in a file, relative to its largest value."""
    if not old.exists() or values.dtype.kind not in "iuf":
        return ""
    before = np.load(old)
    if before.shape != values.shape:
        return f"shape {before.shape} before, {values.shape} now"
    size = np.nanmax(np.abs(before), initial=0) or 1
    return f"{np.nanmax(np.abs(before - values.astype(float)), initial=0) / size:.1e}"


def main() -> int:
    """Write the hashes, or compare them with those of a file."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("before", nargs="?", type=Path, help="a file that --write wrote")
    options.add_argument("--write", type=Path, metavar="FILE")
    options.add_argument("--keep", type=Path, metavar="FOLDER", help="keep or compare the arrays")
    given = options.parse_args()
    before = dict(line.split() for line in given.before.open()) if given.before else {}
    found, differ = {}, 0
    with tempfile.TemporaryDirectory() as folder:
        for name, values in results(Path(folder)):
            found[name] = hash_of(values)
            file = given.keep / (name.replace("/", "_") + ".npy") if given.keep else Path("/none")
            if given.write and given.keep:
                given.keep.mkdir(exist_ok=True)
                np.save(file, values)
            if before and before.get(name) != found[name]:
                differ += 1
                sys.stdout.write(f"{name}: {difference(file, values) or 'differs'}\n")
    gone = before.keys() - found.keys()
    sys.stdout.write("".join(f"{name}: gone\n" for name in sorted(gone)))
    if given.write:
        given.write.write_text("".join(f"{name} {value}\n" for name, value in found.items()))
    sys.stdout.write(f"{len(found)} arrays, {differ + len(gone)} differ\n")
    return int(differ + len(gone) > 0)


if __name__ == "__main__":
    sys.exit(main())
