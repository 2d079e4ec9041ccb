"""What holds of a study (4): each of its files read whole, and whether all belong together."""

from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

import h5py
import xarray as xr

from s4a.schema import dataset
from s4a.study.contents import REQUIRED, kind_of
from s4a.study.hdf5 import StudyFile
from s4a.study.header import header_of
from s4a.study.seal import open_regular, read_seal
from s4a.study.store import STAGES, check_is_study, damage_named, open_file
from s4a.study.tree import Reader, apart_of

# in the order in which they are made; "*" is for shapes and batches
ORDER = (
    "original/*",
    "coarse/*",
    "network/*",
    "network",
    "latent",
    "latent/*",
    "rounds/*",
    "registration",
    "registration/*",
    "fields/*",
    "pca",
    "subjects",
    "report",
)
OF_SHAPE = (
    "original/",
    "coarse/",
    "network/sketch_",
    "network/look_",
    "network/motion_",
    "registration/",
)
OF_ALL = ("network", "latent", "registration", "report")
OWN = {*STAGES, ".lock", ".costs.json", "study.html", "report.txt", "modes.png", "statistics"}


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
        - ``unsealed``: the same, but it was written before files had checksums;
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
            reader.damaged.add(name)
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


def names_in_order(folder: Path) -> Iterator[str]:
    """The files of the study that are there, those before that others are made from."""
    for pattern in ORDER:
        for path in sorted(folder.glob(f"{pattern}.nc")):
            name = path.relative_to(folder).with_suffix("").as_posix()
            if not path.name.startswith(".") and kind_of(name) in REQUIRED:
                yield name


def look(reader: Reader, name: str) -> tuple[str, str]:
    """State and fault of a file, of which every byte is read."""
    path = reader.path(name)
    try:
        data, fault = reader.open(name, open_file)
        for variable in data.variables.values():  # as it is read, it is checked
            variable.to_numpy()
        with damage_named(path), open_regular(path) as raw:
            seal = read_seal(raw)
            if seal and seal.header:
                check_header(raw, seal.header)
    except OSError as error:
        return "damaged", str(error.__cause__ or error)
    if fault:
        return "stale", fault
    return ("whole", "") if seal else ("unsealed", "")


def check_header(raw: BufferedReader, header: str) -> None:
    """OSError where a header says something else than HDF5, which other programs ask."""
    with h5py.File(raw) as file:
        if header_of(StudyFile(file, raw)) != header:
            raise OSError("its header is not that of its HDF5")


def needed_files(report: xr.Dataset, registration: xr.Dataset | None) -> list[str]:
    """The files that a finished run with this report has made."""
    names = report["shape"].values[report["status"].values != "excluded"].tolist()
    of_shapes = [f"{prefix}{name}" for prefix in OF_SHAPE for name in names]
    apart = [] if registration is None else [f"latent/{name}" for name in apart_of(registration)]
    return [*of_shapes, *apart, *OF_ALL, *([] if report.attrs["no_modes"] else ["pca"])]


def foreign(folder: Path) -> Iterator[str]:
    """What else lies in the folder of a study and in those of its stages, but for hidden files."""
    for place in (folder, *(folder / stage for stage in STAGES if (folder / stage).is_dir())):
        for path in sorted(place.iterdir()):
            name = path.relative_to(folder).as_posix()
            known = path.suffix == ".nc" and kind_of(name.removesuffix(".nc")) in REQUIRED
            if not known and name not in OWN and not path.name.startswith("."):
                yield name
