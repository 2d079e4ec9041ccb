"""What holds of a study (4): each of its files read whole, and whether all belong together."""

from collections.abc import Iterator
from pathlib import Path

import xarray as xr

from s4a.schema import HOLDS, dataset
from s4a.study.contents import kind_of
from s4a.study.netcdf import GROUP, damage_named, open_file, open_hdf5
from s4a.study.store import STAGES, check_is_study
from s4a.study.tree import Reader, excluded_of

OF_SHAPE = (
    *("original/", "coarse/", "registration/"),
    *("network/descriptor_", "network/comparison_", "network/alignment_"),
)
OF_ALL = ("network", "latent", "registration", "report")
OWN = {*STAGES, ".lock", "study.html", "report.txt", "modes.png", "statistics"}


def verify(folder: Path | str) -> xr.Dataset:
    """Read every byte of a study, and say which of its files hold.

    Parameters
    ----------
    folder : path
        Of a study, see :func:`s4a.open_study`.  Nothing in it is changed.

    Returns
    -------
    Dataset
        ``state(file)`` and ``fault(file)``, what is wrong in words, of every file that is in the
        folder or should be.  States are

        - ``whole``: as it was written, with all that it needs, made from files of the study;
        - ``damaged``, ``missing``, or ``stale``: made from files that are no longer there, which is
          looked for where none is damaged;
        - ``left over`` from an earlier run, or ``foreign``: no part of the study.

    Raises
    ------
    ValueError
        When the folder is not a study.

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
    looks = {}
    for name in names_in_order(folder):
        looks[name] = look(reader, name)
        if looks[name][0] == "damaged":
            reader.keys = None  # what was made from it may be right
    if "report" in reader.files:
        needed = needed_files(reader.files["report"], reader.files.get("registration"))
        for name in looks:
            if name not in needed and name.startswith((*OF_SHAPE, "latent/")):
                looks[name] = "left over", "not of the last run"
    else:
        needed = ["report"]
    for name in needed:
        looks.setdefault(name, ("missing", "no run has made it, or it was removed"))
    rows = {f"{name}.nc": found for name, found in looks.items()}
    rows |= dict.fromkeys(foreign(folder), ("foreign", "not made by s4a"))
    states, faults = zip(*rows.values(), strict=True)
    return dataset(state=list(states), fault=list(faults)).assign_coords(file=list(rows))


def names_in_order(folder: Path) -> list[str]:
    """The files of the study that are there, those before that others are made from."""
    places = [p for p in (folder, *(folder / stage for stage in STAGES)) if p.is_dir()]
    paths = [path for place in places for path in place.glob("[!.]*.nc")]
    names = [path.relative_to(folder).with_suffix("").as_posix() for path in paths]
    order = list(HOLDS)
    known = [(order.index(kind_of(name)), name) for name in names if kind_of(name) in HOLDS]
    return [name for _, name in sorted(known)]


def look(reader: Reader, name: str) -> tuple[str, str]:
    """State and fault of a file, of which every byte is read."""
    path = reader.path(name)
    try:
        data, fault = reader.open(name, open_file)
        with damage_named(path):
            check_netcdf(path, data)
    except OSError as error:
        return "damaged", str(error.__cause__ or error)
    return ("stale", fault) if fault else ("whole", "")


def check_netcdf(path: Path, data: xr.Dataset) -> None:
    """OSError where other programs find something else in a file than its contents say."""
    data = data.load()  # as it is read, it is checked
    with open_hdf5(path) as file:
        names = {name.decode() for name in file} - {GROUP}
    if names != {*data.variables, *data.sizes}:
        raise OSError(f"it has other variables than its contents: {names ^ set(data.variables)}")
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as there:
        if not there.identical(data):
            raise OSError("its contents are not those of its HDF5")


def needed_files(report: xr.Dataset, registration: xr.Dataset | None) -> list[str]:
    """The files that a finished run with this report has made."""
    names = report["shape"].values[report["status"].values != "excluded"].tolist()
    of_shapes = [f"{prefix}{name}" for prefix in OF_SHAPE for name in names]
    apart = [] if registration is None else [f"latent/{name}" for name in excluded_of(registration)]
    return [*of_shapes, *apart, *OF_ALL, *([] if report.attrs["no_modes"] else ["pca"])]


def foreign(folder: Path) -> Iterator[str]:
    """What else lies in the folder of a study and in those of its stages, but for hidden files."""
    known = {*OWN, *(f"{name}.nc" for name in names_in_order(folder))}
    for pattern in ("[!.]*", *(f"{stage}/[!.]*" for stage in STAGES)):
        for path in sorted(folder.glob(pattern)):
            if (name := path.relative_to(folder).as_posix()) not in known:
                yield name
