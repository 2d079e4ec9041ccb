"""Studies as trees: open a folder, or combine the registrations of shapes."""

import logging
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.options import kept_options
from s4a.schema import INPUT, POSE, in_unit, unit_of, variable
from s4a.study.contents import check_contents, check_fit, check_name
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
    """Make the mesh of ``/registration`` from the original mesh of the template."""
    X, T = as_arrays(original)
    mesh = as_dataset(X, T, {"template": name}, vertex_area=vertex_areas(X, T))
    return in_unit(mesh, unit_of(original["position"]))


def stack_registration(
    template: xr.Dataset, files: dict[str, xr.Dataset], names: list[str], *, lazily: bool = False
) -> dict[str, xr.Dataset]:
    """Stack registrations to ``/registration``, with the inverse match of each shape below it.

    Lengths have a unit if it is the same for all shapes.

    Parameters
    ----------
    template : Dataset
        See :func:`template_mesh`.
    files : dict of str to Dataset
        Registrations, see :func:`s4a.method.register.registration`.
    names : list of str
        The shapes in order.
    lazily : bool
        Read variables when they are used, only for the shapes selected; else now.
    """
    shapes = [files[name] for name in names]
    mesh = template[[v for v in ("position", "corner_vertex", "vertex_area") if v in template]]
    copied = ("template", "excluded")
    attrs = {key: template.attrs[key] for key in copied if key in template.attrs}
    data = mesh.assign_attrs(attrs)
    for name in STACKED:
        if all(name in shape for shape in shapes):
            values = [shape[name].variable for shape in shapes]
            if lazily:
                like = variable(name, np.broadcast_to(0, (len(values), *values[0].shape)))
                data[name] = xr.Variable(like.dims, stacked(values), like.attrs)
            else:
                data[name] = variable(name, np.stack([value.values for value in values]))
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
    """Reader of the matching files of a folder; files that it skips are logged.

    Parameters
    ----------
    folder : Path
    reported : set of str, optional
        Shapes of the last run.  A damaged file of another shape, left by an earlier run, is
        skipped; any other is an error.
    """

    def __init__(self, folder: Path, reported: set[str] | None = None):
        self.folder, self.reported = folder, reported
        # keys of the files that were read, by name; None if they are not checked
        self.keys: dict[str, str] | None = {}
        self.files: dict[str, xr.Dataset] = {}

    def read(
        self, names: Iterable[str], open_with: Callable[..., xr.Dataset] = open_file
    ) -> dict[str, xr.Dataset]:
        """Read the files of these names that exist and were made from files read before.

        Raises
        ------
        DamagedError
            If a file is damaged, or does not match the others.
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
                log.warning("%s; it is skipped", error)
                continue
            if fault:
                log.warning("%s %s", self.path(name), fault)
            else:
                files[name] = data
        return files

    def path(self, name: str) -> Path:
        """Path of a file, given its name as ``coarse/brain_01``."""
        return self.folder / f"{name}.nc"

    def open(self, name: str, open_with: Callable[..., xr.Dataset]) -> tuple[xr.Dataset, str]:
        """Open and check a file; return it, and the reason if it is not part of the study."""
        path = self.path(name)
        others = {}  # the inverse match refers to triangles of the template
        if name.startswith("registration/") and "registration" in self.files:
            others["triangle"] = self.files["registration"].sizes["triangle"]
        data = open_with(path, others)
        with damage_named(path):
            check_name(name, data)
            check_contents(name, data)
        fault = self.fault(data)
        if not fault:
            with damage_named(path):
                check_fit(name, data, self.files)
            if self.keys is not None:
                self.keys[name] = data.attrs.get("task_key", "")
            self.files[name] = data
        return data, fault

    def fault(self, data: xr.Dataset) -> str:
        """Reason why a file is not part of the study, or ""."""
        made_from = [source.split("=", 1) for source in data.attrs.get("made_from", "").split()]
        if self.keys is not None and any(self.keys.get(name) != key for name, key in made_from):
            return "belongs to an earlier run and is skipped; run the analysis again"
        return ""


def open_study(folder: Path | str) -> xr.DataTree:
    """Open a study folder, finished or not.

    Variables are read when they are used, and variables of ``/registration`` only for the selected
    shapes.  No file is kept open.  Stages that are not yet computed are absent.  Files that do not
    match the others in the folder are skipped with a warning.

    Every file is verified by its checksums (:mod:`s4a.study.netcdf`), its own name, and against the
    schema (:mod:`s4a.study.contents`).  Links in the folder, and references of HDF5 to other files,
    are refused.

    Parameters
    ----------
    folder : path
        Folder that was given as ``store=`` to :func:`s4a.analyse`, or as ``--out`` to ``s4a run``.

    Returns
    -------
    xarray.DataTree
        The study, with the nodes that :func:`s4a.analyse` returns, as far as they are computed.

    Raises
    ------
    ValueError
        If the folder is not a study.
    DamagedError
        If a file is damaged.  The message has the file and the remedy.  Larger variables are
        checked when they are read.  DamagedError is an OSError.

    See Also
    --------
    analyse : Compute a study.
    verify : Check all files of a study.

    Examples
    --------
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
        excluded = excluded_of(template["registration"])
        nodes |= reader.read(f"latent/{name}" for name in excluded)
        names = sorted([*nodes["latent"]["shape"].values.tolist(), *excluded])
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
    """Return the flagged shapes that are registered, but excluded from the network."""
    return str(registration.attrs.get("excluded", "")).split()


def seconds_of(report: xr.Dataset) -> str:
    """Format the total time of all stages, for the command line and the page.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a.study.tree import seconds_of
    >>> seconds_of(dataset(seconds=[20.2, 48.6]))
    '69 s of computing'
    """
    return f"{report['seconds'].sum().item():.0f} s of computing"


def left_out(study: xr.DataTree) -> list[str]:
    """Return the flagged shapes of a study, which are excluded from modes and statistics.

    The list is empty with ``include_flagged``, and never has the template.
    """
    if "report" not in study.children or "registration" not in study.children:
        return []
    report = study["report"].dataset
    if "status" not in report or kept_options(report).get("include_flagged"):
        return []
    template = study["registration"].attrs.get("template")
    is_flagged = report["status"].values == "flagged"
    if report.attrs.get("ambiguous_included"):
        is_flagged &= report["flag_kinds"].values != POSE
    flagged = report["shape"].values[is_flagged].tolist()
    return [name for name in flagged if name != template]


def reported(folder: Path) -> set[str] | None:
    """Return the shapes of the last run; None if there is no report."""
    path = folder / "report.nc"
    if not path.exists():
        return None
    report = open_file(path)
    with damage_named(path):
        check_contents("report", report)
    return set(report["shape"].values.tolist())


def as_reported(nodes: dict[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """Select the nodes of the shapes of the last run, with the paths of their files."""
    report = nodes["report"]
    used = report.sel(shape=report["status"].values != "excluded")
    paths = dict(zip(used["shape"].values.tolist(), used["path"].values.tolist(), strict=True))
    reported = {}
    for node, data in nodes.items():
        stage, _, name = node.rpartition("/")
        if stage in ("original", "coarse", "registration") and name not in paths:
            continue
        if stage == "original" and paths[name]:  # the file may have moved
            data = data.assign_attrs(path=paths[name])
        reported[node] = data
    return reported


def write_inserted(inserted: xr.DataTree, folder: Path | str) -> Path:
    """Write the result of :func:`s4a.insert` for :func:`open_inserted`; return the file."""
    path = Path(folder) / "inserted.nc"
    write(inserted, path)
    return path


def open_inserted(file: Path | str) -> xr.DataTree:
    """Open the result of ``s4a insert``, given its folder or ``inserted.nc`` in it.

    Raises
    ------
    ValueError
        If there is no such file.
    """
    path = Path(file)
    path = path / "inserted.nc" if path.is_dir() else path
    if not path.exists():
        raise ValueError(
            f"{path} does not exist; s4a insert STUDY SHAPES --out DIR writes DIR/inserted.nc"
        )
    return read_tree(path)
