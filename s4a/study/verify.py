"""Verify a study (4): checksums and provenance of every file."""

from collections.abc import Iterator
from pathlib import Path

import xarray as xr

from s4a.schema import HOLDS, dataset
from s4a.study.contents import kind_of
from s4a.study.netcdf import GROUP, damage_named, open_file, open_hdf5, open_plain
from s4a.study.store import STAGES, check_is_study
from s4a.study.tree import Reader, excluded_of

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
