"""A study as one tree: opened from its folder, or put together from the registrations of shapes."""

import logging
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.options import kept_options
from s4a.schema import INPUT, in_unit, unit_of, variable
from s4a.study.contents import check_contents, check_fit
from s4a.study.netcdf import DamagedError, damage_named, open_file, read, read_tree, stacked
from s4a.study.store import check_is_study, write

log = logging.getLogger(__name__)

STACKED = (
    "registered_match",
    "displacement",
    "displacement_raw",
    "registered_match_low",
    "displacement_low",
    "displacement_coefficient",
    "rotation",
    "translation",
    "scale",
    "icp_rotation",
    "icp_translation",
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
    template: xr.Dataset, files: dict[str, xr.Dataset], names: list[str], *, lazily: bool = False
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
    lazily : bool
        Whether a variable is read from its files when it is used, only those of the shapes that are
        asked for, or is in memory now.
    """
    shapes = [files[name] for name in names]
    mesh = template[[v for v in ("position", "corner_vertex", "vertex_area") if v in template]]
    kept = ("template", "excluded")
    attrs = {key: template.attrs[key] for key in kept if key in template.attrs}
    data = mesh.assign_attrs(attrs)
    for name in STACKED:
        if all(name in shape for shape in shapes):
            each = [shape[name].variable for shape in shapes]
            if lazily:
                like = variable(name, np.broadcast_to(0, (len(each), *each[0].shape)))
                data[name] = xr.Variable(like.dims, stacked(each), like.attrs)
            else:
                data[name] = variable(name, np.stack([one.values for one in each]))
    data["initialisation"] = variable(
        "initialisation", [shape.attrs.get("initialisation", "") for shape in shapes]
    )
    data["registration_error"] = variable(
        "registration_error", [shape.attrs.get("score", np.nan) for shape in shapes]
    )
    units = {unit_of(shape["displacement"]) for shape in shapes}
    data = in_unit(data, units.pop() if len(units) == 1 else INPUT).assign_coords(shape=names)
    nodes = {"registration": data}
    for name in names:
        closest_on_template = files[name][["template_triangle", "template_barycentric"]]
        nodes[f"registration/{name}"] = closest_on_template.assign_attrs(files[name].attrs)
    return nodes


class Reader:
    """Reads the files of a folder that belong together, and says which ones it leaves out.

    Parameters
    ----------
    folder : Path
    reported : set of str, optional
        Shapes of the last run.  A damaged file of another shape is left out, as one that an earlier
        run has left; any other is an error.
    """

    def __init__(self, folder: Path, reported: set[str] | None = None):
        self.folder, self.reported = folder, reported
        # of the files that were read; None where that is not to be asked
        self.keys: set[str] | None = set()
        self.files: dict[str, xr.Dataset] = {}

    def read(
        self, names: Iterable[str], open_with: Callable[..., xr.Dataset] = open_file
    ) -> dict[str, xr.Dataset]:
        """The files of these names that are there and made from files read before.

        Raises
        ------
        DamagedError
            Where one is not what a run wrote, or does not fit to the others.
        """
        files = {}
        for name in names:
            try:
                data, fault = self.open(name, open_with)
            except FileNotFoundError:
                continue
            except DamagedError as error:
                shape = name.partition("/")[2]
                if not shape or self.reported is None or shape in self.reported:
                    raise
                log.warning("%s; it is left out", error)
                continue
            if fault:
                log.warning("%s %s", self.path(name), fault)
            else:
                files[name] = data
        return files

    def path(self, name: str) -> Path:
        """The file of that name, as ``coarse/brain_01``."""
        return self.folder / f"{name}.nc"

    def open(self, name: str, open_with: Callable[..., xr.Dataset]) -> tuple[xr.Dataset, str]:
        """A file, whose contents are checked, and why it has no place in the study if so."""
        path = self.path(name)
        others = {}  # the way back points into the triangles of the template
        if name.startswith("registration/") and "registration" in self.files:
            others["triangle"] = self.files["registration"].sizes["triangle"]
        data = open_with(path, others)
        with damage_named(path):
            check_contents(name, data)
        fault = self.fault(data)
        if not fault:
            with damage_named(path):
                check_fit(name, data, self.files)
            if self.keys is not None:
                self.keys.add(data.attrs.get("task_key", ""))
            self.files[name] = data
        return data, fault

    def fault(self, data: xr.Dataset) -> str:
        """Why a file has no place in the study; empty where it has."""
        made_from = data.attrs.get("made_from", "").split()
        if self.keys is not None and not self.keys.issuperset(made_from):
            return "belongs to an earlier run and is left out; run the analysis again"
        return ""


def open_study(folder: Path | str) -> xr.DataTree:
    """Open a study folder, finished or not.

    Variables are read when they are used, of ``/registration`` those of the shapes that are asked
    for; no file is held open.  The stages that are there are in the tree, those
    that are not yet computed are absent, as are files that were made from others than those now in
    the folder (that is said in a warning of the log).

    Every file is checked: its bytes by their checksums, see :mod:`s4a.study.netcdf`, its variables
    by what a file of its name holds, see :mod:`s4a.study.contents`.  Nothing leads out of the
    folder: links in it, and what HDF5 would take from other files, are refused.

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
    DamagedError
        An OSError, when a file is not what a run wrote; it is named, with what mends it.  So is one
        of a larger variable that is read later.

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
    check_is_study(folder)
    reader = Reader(folder, reported(folder))
    names = sorted(path.stem for path in (folder / "original").glob("[!.]*.nc"))
    nodes = reader.read(f"{stage}/{name}" for stage in ("original", "coarse") for name in names)
    nodes |= reader.read(["network", "latent"])
    nodes |= reader.read(
        f"iterations/{path.stem}" for path in sorted(folder.glob("iterations/k_*.nc"))
    )
    template = reader.read(["registration"], read)
    if template and "latent" in nodes:
        apart = excluded_of(template["registration"])
        nodes |= reader.read(f"latent/{name}" for name in apart)
        names = sorted([*nodes["latent"]["shape"].values.tolist(), *apart])
        files = reader.read(f"registration/{name}" for name in names)
        files = {path.removeprefix("registration/"): data for path, data in files.items()}
        if files:
            nodes |= stack_registration(template["registration"], files, list(files), lazily=True)
    fields = sorted(path.stem for path in (folder / "fields").glob("[!.]*.nc"))
    nodes |= reader.read(f"fields/{name}" for name in fields)
    nodes |= reader.read(["pca", "subjects", "report"])
    if "report" in nodes:
        nodes = as_reported(nodes)
    return xr.DataTree.from_dict(nodes, name=folder.name)


def excluded_of(registration: xr.Dataset) -> list[str]:
    """The shapes that are registered and stand apart from the network, as they are flagged."""
    return str(registration.attrs.get("excluded", "")).split()


def seconds_of(report: xr.Dataset) -> str:
    """Seconds of all stages together, in the words of the command line and of the page.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a.study.tree import seconds_of
    >>> seconds_of(dataset(seconds=[20.2, 48.6]))
    '69 s of computing'
    """
    return f"{report['seconds'].sum().item():.0f} s of computing"


def left_out(study: xr.DataTree) -> list[str]:
    """The flagged shapes of a study, which modes and statistics are made without.

    None where ``include_flagged`` was given; a template that was named is trusted.
    """
    if "report" not in study.children or "registration" not in study.children:
        return []
    report = study["report"].dataset
    if "status" not in report or kept_options(report).get("include_flagged"):
        return []
    template = study["registration"].attrs.get("template")
    flagged = report["shape"].values[report["status"].values == "flagged"].tolist()
    return [name for name in flagged if name != template]


def reported(folder: Path) -> set[str] | None:
    """The shapes of the last run; None where it has no report."""
    path = folder / "report.nc"
    if not path.exists():
        return None
    report = open_file(path)
    with damage_named(path):
        check_contents("report", report)
    return set(report["shape"].values.tolist())


def as_reported(nodes: dict[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """The nodes of the shapes that the last run used, with the paths that it read them from."""
    report = nodes["report"]
    used = report.sel(shape=report["status"].values != "excluded")
    paths = dict(zip(used["shape"].values.tolist(), used["path"].values.tolist(), strict=True))
    reported = {}
    for node, data in nodes.items():
        stage, _, name = node.rpartition("/")
        if stage in ("original", "coarse", "registration") and name not in paths:
            continue
        if stage == "original" and paths[name]:  # the file may have moved since it was read
            data = data.assign_attrs(path=paths[name])
        reported[node] = data
    return reported


def write_inserted(inserted: xr.DataTree, folder: Path | str) -> Path:
    """Write what :func:`s4a.insert` gives, for :func:`open_inserted`; its file in the folder."""
    path = Path(folder) / "inserted.nc"
    write(inserted, path)
    return path


def open_inserted(file: Path | str) -> xr.DataTree:
    """What ``s4a insert`` wrote: its folder, or ``inserted.nc`` in it.

    Raises
    ------
    ValueError
        When there is none.
    """
    path = Path(file)
    path = path / "inserted.nc" if path.is_dir() else path
    if not path.exists():
        raise ValueError(
            f"{path}: there is no such file; s4a insert STUDY SHAPES --out DIR writes "
            "DIR/inserted.nc"
        )
    return read_tree(path)
