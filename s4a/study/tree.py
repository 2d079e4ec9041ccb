"""Studies as trees (4): open a folder, check and verify its files, stack the registrations.

Files may be untrusted, of another version or edited.  They are checked against the schema and
against each other when they are opened, without reading larger variables.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.input.files import slug
from s4a.options import kept_options
from s4a.schema import (
    HOLDS,
    INPUT,
    OMITTED,
    POINTS_INTO,
    POSE,
    TABLE,
    TEXTS,
    dataset,
    in_unit,
    unit_of,
    variable,
)
from s4a.study.netcdf import (
    GROUP,
    DamagedError,
    damage_named,
    open_file,
    open_hdf5,
    open_plain,
    read,
    read_tree,
    stacked,
)
from s4a.study.store import STAGES, check_is_study, write

log = logging.getLogger(__name__)

# variables of a registration that are stacked over the shapes
STACKED = [name for name, (dims, *_) in TABLE.items() if dims[:1] == ("shape",)]


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


# ---- the files of a study
SIZES = {"xyz": 3, "xyz_2": 3, "corner": 3, "end": 2}


def kind_of(name: str) -> str:
    """Return the key in :data:`s4a.schema.HOLDS` for the name of a file.

    Examples
    --------
    >>> from s4a.study.tree import kind_of
    >>> kind_of("network/comparison_brain_01"), kind_of("registration/a"), kind_of("pca")
    ('network/comparison', 'registration/shape', 'pca')
    """
    stage, _, shape = name.partition("/")
    if shape and stage == "network":
        return f"network/{shape.partition('_')[0]}"
    return f"{stage}/shape" if shape and f"{stage}/shape" in HOLDS else stage


def shape_of(name: str) -> str:
    """Return the shape of a file, or the name itself if the file is of all shapes.

    Examples
    --------
    >>> from s4a.study.tree import shape_of
    >>> shape_of("network/comparison_brain_01"), shape_of("registration/a"), shape_of("pca")
    ('brain_01', 'a', 'pca')
    """
    stage, _, shape = name.partition("/")
    return shape.partition("_")[2] or shape if stage == "network" and shape else shape or name


def check_name(name: str, data: xr.Dataset) -> None:
    """Raise ValueError unless a file has the name under which it was written.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a.study.tree import check_name
    >>> check_name("coarse/a", dataset({"file": "coarse/b"}))
    Traceback (most recent call last):
    ...
    ValueError: it holds b, is named a: files were exchanged or renamed
    """
    stored = data.attrs.get("file")
    if not isinstance(stored, str):
        raise ValueError("it has no name of its own: another version of s4a wrote it")
    if stored != name:
        of_kind = kind_of(stored) == kind_of(name)
        held, named = map(shape_of, (stored, name)) if of_kind else (stored, name)
        raise ValueError(f"it holds {held}, is named {named}: files were exchanged or renamed")


def check_contents(name: str, data: xr.Dataset) -> None:
    """Raise ValueError unless a file has the variables and attributes of its kind.

    Parameters
    ----------
    name : str
        Path in the folder of the study without the suffix, as ``coarse/brain_01``.
    data : Dataset
        See :func:`s4a.study.netcdf.open_file`.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a.study.tree import check_contents
    >>> check_contents("pca", dataset(score=[[1.0]]))
    Traceback (most recent call last):
    ...
    ValueError: missing variables shape, mean_displacement, deformation, ...
    """
    kind = kind_of(name)
    if kind not in HOLDS:
        raise ValueError("not the name of a file of a study")
    if kind == "coarse/shape" and data.attrs.get("method") == "scalable":
        kind = "coarse/scalable"
    needed, texts, numbers, _ = (words.split() for words in HOLDS[kind])
    check_names(data)
    missing = [variable for variable in needed if variable not in data.variables]
    if missing:
        raise ValueError(f"missing variables {', '.join(missing)}")
    for attrs, kinds, what in ((texts, str, "text"), (numbers, (int, float), "number")):
        wrong = [attr for attr in attrs if not isinstance(data.attrs.get(attr), kinds)]
        if wrong:
            raise ValueError(
                f"the attribute {wrong[0]} needs a {what}, found {data.attrs.get(wrong[0])!r:.40}"
            )
    for key, values in data.variables.items():
        if kind != "subjects":
            check_variable(str(key), values, str(key) in needed)
        elif values.dims != ("shape",):
            raise ValueError(f"the column {key} needs the dim shape, found {values.dims}")
    for dim, size in data.sizes.items():
        if SIZES.get(str(dim), size) != size:
            raise ValueError(f"{dim} needs {SIZES[str(dim)]} entries, found {size}")


def check_variable(name: str, values: xr.Variable, needed: bool) -> None:
    """Raise ValueError unless a variable has the dims and, if needed, the type of the schema."""
    is_coordinate = name in values.dims
    if not is_coordinate and name not in TABLE:
        raise ValueError(f"{name} is not a variable of a study")
    dims = (name,) if is_coordinate else TABLE[name][0]
    of_shape = dims[1:] if dims and dims[0] in OMITTED and not is_coordinate else dims
    if values.dims not in (dims, of_shape):
        raise ValueError(f"{name} needs the dims {dims}, found {values.dims}")
    kinds, what = "iuf", "numbers"
    if name in TEXTS:
        kinds, what = "U", "text"
    elif name in POINTS_INTO:
        kinds, what = "iu", "integers"
    if (needed or name in POINTS_INTO) and values.dtype.kind not in kinds:
        raise ValueError(f"{name} needs {what}, found {values.dtype}")


def check_names(data: xr.Dataset) -> None:
    """Raise ValueError if a shape or stage is repeated, or a name could leave the folder."""
    for name in ("shape", "stage"):
        if name in data.coords:
            unique, counts = np.unique(data.coords[name].values.astype(str), return_counts=True)
            if (counts > 1).any():
                repeated = unique[counts > 1].tolist()
                raise ValueError(f"{name} needs unique names, found {repeated} more than once")
    names = [str(data.attrs[attr]) for attr in ("template", "median") if attr in data.attrs]
    names += str(data.attrs.get("excluded", "")).split()
    names += data.coords["shape"].values.astype(str).tolist() if "shape" in data.coords else []
    wrong = [name for name in names if slug(name) != name]
    if wrong:
        raise ValueError(f"shapes need names of letters, digits, _ and -; found {wrong}")


def check_fit(name: str, data: xr.Dataset, others: Mapping[str, xr.Dataset]) -> None:
    """Raise ValueError if the sizes of a file do not match those of the files it was made from.

    Parameters
    ----------
    name : str
        As in :func:`check_contents`.
    data : Dataset
    others : dict of str to Dataset
        Files that were read before, by name.
    """
    template = others.get("registration", data).attrs.get("template", "")
    names = {"shape": name.partition("/")[2], "template": template}
    for fit in HOLDS[kind_of(name)][-1].split():
        dim, other, other_dim = fit.format(**names).split(":")
        if other in others and dim in data.sizes:
            expected, size = others[other].sizes[other_dim], data.sizes[dim]
            if expected != size:
                raise ValueError(f"{dim} needs {expected} entries as in {other}, found {size}")


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
    schema.  Links in the folder, and references of HDF5 to other files,
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


# ---- all files of a study
OF_SHAPE = (
    *("original/", "coarse/", "registration/"),
    *("network/descriptor_", "network/comparison_", "network/alignment_"),
)
OF_ALL = ("network", "latent", "registration", "report")
OWN = {*STAGES, ".lock", "study.html", "report.txt", "modes.png", "statistics"}


def verify(folder: Path | str) -> xr.Dataset:
    """Verify checksums and provenance of every file of a study.

    Parameters
    ----------
    folder : path
        Folder of a study, see :func:`s4a.open_study`; it is not changed.

    Returns
    -------
    Dataset
        ``state(file)`` and ``fault(file)``, a text, of every file that is in the folder or should
        be.  States are

        - ``whole``: undamaged, complete, and made from files of the study;
        - ``damaged``, ``missing``, or ``stale``: made from files that no longer exist, checked only
          if no file is damaged;
        - ``left over`` from an earlier run, or ``foreign``: not part of the study.

    Raises
    ------
    ValueError
        If the folder is not a study.

    See Also
    --------
    open_study : open a study.

    Examples
    --------
    >>> import tempfile
    >>> import s4a
    >>> store = tempfile.mkdtemp()
    >>> study = s4a.analyse(
    ...     s4a.synthetic.brains(3, 200), n_coarse=100, k=10, k_init=6, n_pairs=3, store=store
    ... )
    >>> set(s4a.verify(store)["state"].values.tolist())
    {'whole'}
    """
    folder = Path(folder)
    check_is_study(folder)
    reader = Reader(folder)
    states_and_faults = {}
    for name in names_in_order(folder):
        states_and_faults[name] = check_file(reader, name)
        if states_and_faults[name][0] == "damaged":
            reader.keys = None  # files made from it may be undamaged
    if "report" in reader.files:
        needed = needed_files(reader.files["report"], reader.files.get("registration"))
        for name in states_and_faults:
            if name not in needed and name.startswith((*OF_SHAPE, "latent/")):
                states_and_faults[name] = "left over", "not of the last run"
    else:
        needed = ["report"]
    for name in needed:
        states_and_faults.setdefault(name, ("missing", "not computed yet, or removed"))
    rows = {f"{name}.nc": row for name, row in states_and_faults.items()}
    rows |= dict.fromkeys(foreign(folder), ("foreign", "not made by s4a"))
    states, faults = zip(*rows.values(), strict=True)
    return dataset(state=list(states), fault=list(faults)).assign_coords(file=list(rows))


def names_in_order(folder: Path) -> list[str]:
    """Names of the files of a study, in the order of their dependencies."""
    folders = [p for p in (folder, *(folder / stage for stage in STAGES)) if p.is_dir()]
    paths = [path for parent in folders for path in parent.glob("[!.]*.nc")]
    names = [path.relative_to(folder).with_suffix("").as_posix() for path in paths]
    order = list(HOLDS)
    ranked = [(order.index(kind_of(name)), name) for name in names if kind_of(name) in HOLDS]
    return [name for _, name in sorted(ranked)]


def check_file(reader: Reader, name: str) -> tuple[str, str]:
    """Read every byte of a file; return state and fault."""
    path = reader.path(name)
    try:
        data, fault = reader.open(name, open_file)
        with damage_named(path):
            check_netcdf(path, data)
    except OSError as error:
        return "damaged", str(error.__cause__ or error)
    return ("stale", fault) if fault else ("whole", "")


def check_netcdf(path: Path, data: xr.Dataset) -> None:
    """Raise OSError if netCDF programs would read other data than the table of contents has."""
    data = data.load()  # reading verifies the checksums
    with open_hdf5(path) as file:
        names = {name.decode() for name in file} - {GROUP}
    if names != {*data.variables, *data.sizes}:
        raise OSError(f"variables and contents differ: {names ^ set(data.variables)}")
    with open_plain(path) as stored:
        if not stored.identical(data):
            raise OSError("the contents differ from the HDF5 data")


def needed_files(report: xr.Dataset, registration: xr.Dataset | None) -> list[str]:
    """Names of the files of a finished run with this report."""
    names = report["shape"].values[report["status"].values != "excluded"].tolist()
    of_shapes = [f"{prefix}{name}" for prefix in OF_SHAPE for name in names]
    excluded = [] if registration is None else excluded_of(registration)
    latent = [f"latent/{name}" for name in excluded]
    return [*of_shapes, *latent, *OF_ALL, *([] if report.attrs["no_modes"] else ["pca"])]


def foreign(folder: Path) -> Iterator[str]:
    """Yield other files in the folder of a study and its stages, except hidden ones."""
    known = {*OWN, *(f"{name}.nc" for name in names_in_order(folder))}
    for pattern in ("[!.]*", *(f"{stage}/[!.]*" for stage in STAGES)):
        for path in sorted(folder.glob(pattern)):
            if (name := path.relative_to(folder).as_posix()) not in known:
                yield name
