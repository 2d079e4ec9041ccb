"""A study as one tree: opened from its folder, or put together from the registrations of shapes."""

import logging
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.input.files import slug
from s4a.schema import INPUT, in_unit, unit_of, variable
from s4a.study.store import open_file, read

log = logging.getLogger(__name__)

STACKED = (
    "registered_match",
    "displacement",
    "displacement_raw",
    "displacement_low",
    "rotation",
    "translation",
    "scale",
    "confidence",
    "round_trip",
    "distortion",
)


def template_mesh(original: xr.Dataset, name: str) -> xr.Dataset:
    """The mesh of ``/registration`` from the original mesh of the template of that name."""
    X, T = as_arrays(original)
    mesh = as_dataset(X, T, {"template": name}, vertex_area=vertex_areas(X, T))
    return in_unit(mesh, unit_of(original["position"]))


def stack_registration(
    template: xr.Dataset, files: dict[str, xr.Dataset], names: list[str]
) -> dict[str, xr.Dataset]:
    """``/registration``, rectangular, and below it the way back of each shape.

    Its lengths have a unit where all shapes say the same.

    Parameters
    ----------
    template : Dataset
        Of :func:`template_mesh`.
    files : dict of str to Dataset
        Registrations, see :func:`s4a.method.register.registration`.
    names : list of str
        The shapes in order.
    """
    shapes = [files[name] for name in names]
    mesh = template[[v for v in ("position", "corner_vertex", "vertex_area") if v in template]]
    data = mesh.assign_attrs(template=template.attrs["template"])
    for name in STACKED:
        if all(name in shape for shape in shapes):
            data[name] = variable(name, np.stack([shape[name].values for shape in shapes]))
    data["method"] = variable("method", [shape.attrs.get("method", "") for shape in shapes])
    data["badness"] = variable("badness", [shape.attrs.get("score", np.nan) for shape in shapes])
    units = {unit_of(shape["displacement"]) for shape in shapes}
    data = in_unit(data, units.pop() if len(units) == 1 else INPUT).assign_coords(shape=names)
    nodes = {"registration": data}
    for name in names:
        way_back = files[name][["template_triangle", "template_barycentric"]]
        nodes[f"registration/{name}"] = way_back.assign_attrs(files[name].attrs)
    return nodes


class Reader:
    """Reads the files of a folder that belong together, and says which ones it leaves out."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.keys: set[str] = set()  # of the files that were read

    def read(
        self, names: Iterable[str], open_with: Callable[[Path], xr.Dataset] = open_file
    ) -> dict[str, xr.Dataset]:
        """The files of these names that are there, whole and made from files read before."""
        files = {}
        for name in names:
            path = self.folder / f"{name}.nc"
            try:
                data = open_with(path)
            except FileNotFoundError:
                continue
            except OSError as error:
                log.warning("%s; it is left out", error)
                continue
            fault = self.fault(data)
            if fault:
                log.warning("%s %s", path, fault)
            else:
                self.keys.add(data.attrs.get("task_key", ""))
                files[name] = data
        return files

    def fault(self, data: xr.Dataset) -> str:
        """Why a file has no place in the study; empty where it has."""
        if not self.keys.issuperset(data.attrs.get("made_from", "").split()):
            return "belongs to an earlier run and is left out; run the analysis again"
        names = data["shape"].values.tolist() if "shape" in data.coords else []
        names += [data.attrs[attr] for attr in ("template", "median") if attr in data.attrs]
        wrong = [name for name in names if slug(str(name)) != name]
        if wrong:  # they become names of files
            return f"is left out: shapes need names of letters, digits, _ and -; found {wrong}"
        return ""


def open_study(folder: Path | str) -> xr.DataTree:
    """Open a study folder, finished or not.

    Per-shape nodes are read when they are used; the stages that are there are in the tree, those
    that are not yet computed are absent, as are files that cannot be read or were made from others
    than those now in the folder (both are said in a warning of the log).  ``/registration`` is put
    together in memory.

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

    Examples
    --------
    With ``store``, the folder of six small brains:

    >>> import tempfile
    >>> import s4a
    >>> store = tempfile.mkdtemp()
    >>> study = s4a.analyse(
    ...     s4a.synthetic.brains(3, 200), n_coarse=100, k=10, k_init=6, n_pairs=3, store=store
    ... )
    >>> sorted(s4a.open_study(store).children)
    ['coarse', 'latent', 'network', 'original', 'pca', 'registration', 'report']
    """
    folder = Path(folder)
    if not (folder / "original").is_dir():
        raise ValueError(
            f"{folder} is not a study folder: it has no folder 'original'; "
            f"run `s4a run ... --out {folder}`"
        )
    reader = Reader(folder)
    names = sorted(path.stem for path in (folder / "original").glob("[!.]*.nc"))
    nodes = reader.read(f"{stage}/{name}" for stage in ("original", "coarse") for name in names)
    nodes |= reader.read(["network", "latent"])
    template = reader.read(["registration"], read)
    if template and "latent" in nodes:
        names = nodes["latent"]["shape"].values.tolist()
        files = reader.read((f"registration/{name}" for name in names), read)
        files = {path.removeprefix("registration/"): data for path, data in files.items()}
        if files:
            nodes |= stack_registration(template["registration"], files, list(files))
    nodes |= reader.read(["pca", "subjects", "report"])
    if "report" in nodes:
        nodes = as_reported(nodes)
    return xr.DataTree.from_dict(nodes, name=folder.name)


def as_reported(nodes: dict[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """The nodes of the shapes that the last run used, with the paths that it read them from."""
    report = nodes["report"]
    used = report.sel(shape=report["status"].values != "excluded")
    paths = dict(zip(used["shape"].values.tolist(), used["path"].values.tolist(), strict=True))
    reported = {}
    for node, data in nodes.items():
        stage, _, name = node.rpartition("/")
        if stage and name not in paths:
            continue
        if stage == "original" and paths[name]:  # the file may have moved since it was read
            data = data.assign_attrs(path=paths[name])
        reported[node] = data
    return reported
