"""A study: one xarray DataTree in memory, one folder of netCDF files on disk, one file per task.

Every file is written under a temporary name and renamed, so that a killed run leaves only whole files; the key of
its task (content, parameters, version) stands in its attributes and says whether it is still valid.
"""

import hashlib
import json
import os
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
import xarray as xr

ENGINE = "h5netcdf"
VERSION = version("s4a")
STACKED = (
    "registered_match",
    "displacement",
    "displacement_raw",
    "rotation",
    "translation",
    "scale",
    "confidence",
)


def task_key(*parts):
    """A hash of all that a result depends on: strings, numbers, lists, dicts, arrays, bytes; and the version of S4A."""
    digest = hashlib.sha256(f"s4a {VERSION}".encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            kind, data = f"{part.dtype.str}{part.shape}", np.ascontiguousarray(part).tobytes()
        elif isinstance(part, bytes):
            kind, data = "bytes", part
        else:
            kind, data = "json", json.dumps(part, sort_keys=True, default=lambda number: number.item()).encode()
        digest.update(f"{kind} {len(data)}:".encode() + data)
    return digest.hexdigest()[:32]


def write(data, path, key=""):
    """Write a Dataset to `path` at once: under a temporary name in the same folder, then renamed."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        data.assign_attrs(task_key=key).to_netcdf(temporary, engine=ENGINE)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read(path):
    """The Dataset of one file, in memory."""
    with xr.open_dataset(path, engine=ENGINE) as data:
        return data.load()


def attributes(path):
    """The attributes of one file."""
    with xr.open_dataset(path, engine=ENGINE) as data:
        return dict(data.attrs)


def is_done(path, key):
    """Whether the file of a task is there, whole, and of this key."""
    try:
        return attributes(path).get("task_key") == key
    except (OSError, ValueError, KeyError, RuntimeError):  # absent, truncated, foreign: computed again
        return False


@contextmanager
def lock(folder):
    """Hold a study folder against a second run; released by the system when the process ends in whatever way.

    Temporary files of a run that was killed are removed.

    Raises
    ------
    ValueError
        When another process holds the folder; its number is named.
    """
    import fcntl

    Path(folder).mkdir(parents=True, exist_ok=True)
    with open(Path(folder) / ".lock", "a+") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            handle.seek(0)
            raise ValueError(
                f"another run (process {handle.read().strip() or 'unknown'}) is working on {folder}; "
                "wait for it to end or give another folder"
            ) from None
        handle.truncate(0)
        handle.write(str(os.getpid()))
        handle.flush()
        for left in Path(folder).rglob(".*.tmp"):
            left.unlink(missing_ok=True)
        yield


def stack_registration(template, files, names):
    """The rectangular ``/registration`` from the files of its shapes, and the nodes of the way back."""
    parts = [files[name] for name in names]
    data = template[["position", "corner_vertex"]].assign_attrs(template=template.attrs["template"])
    stacked = {
        name: xr.Variable(
            ("shape", *parts[0][name].dims), np.stack([p[name].values for p in parts]), parts[0][name].attrs
        )
        for name in STACKED
    }
    methods = xr.Variable("shape", [p.attrs.get("method", "") for p in parts], {"long_name": "candidate kept"})
    score = xr.Variable("shape", [p.attrs.get("score", np.nan) for p in parts], {"long_name": "badness of the match"})
    data = data.assign(stacked).assign(method=methods, badness=score).assign_coords(shape=list(names))
    nodes = {
        f"registration/{name}": files[name][["template_triangle", "template_barycentric"]].assign_attrs(
            files[name].attrs
        )
        for name in names
    }
    return {"registration": data, **nodes}


def open_study(folder):
    """Open a study folder, finished or not.

    Per-shape nodes are read when they are used; the stages that are there are in the tree, those that are not yet
    computed are absent.  ``/registration`` is put together in memory.

    Parameters
    ----------
    folder : path
        As given to ``store=`` or ``s4a run --out``.

    Returns
    -------
    xarray.DataTree

    Raises
    ------
    ValueError
        When the folder is not a study.
    """
    folder = Path(folder)
    if not (folder / "original").is_dir():
        raise ValueError(
            f"{folder} is not a study folder: it has no folder 'original'; run `s4a run ... --out {folder}`"
        )
    report = read(folder / "report.nc") if (folder / "report.nc").exists() else None
    kept = None if report is None else set(report["shape"].values[report["status"].values != "excluded"].tolist())
    nodes = {}
    for stage in ("original", "coarse"):
        for path in sorted((folder / stage).glob("[!.]*.nc")):
            if kept is None or path.stem in kept:
                nodes[f"{stage}/{path.stem}"] = xr.open_dataset(path, engine=ENGINE)
    for stage in ("network", "latent", "pca", "report"):
        if (folder / f"{stage}.nc").exists():
            nodes[stage] = xr.open_dataset(folder / f"{stage}.nc", engine=ENGINE)
    if (folder / "latent.nc").exists() and (folder / "registration.nc").exists():
        template = read(folder / "registration.nc")
        names = [n for n in nodes["latent"]["shape"].values.tolist() if kept is None or n in kept]
        names = [n for n in names if (folder / "registration" / f"{n}.nc").exists()]
        if names:
            files = {n: read(folder / "registration" / f"{n}.nc") for n in names}
            nodes |= stack_registration(template, files, names)
    return xr.DataTree.from_dict(nodes, name=folder.name)
