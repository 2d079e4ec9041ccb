"""What each file of a study holds (4): its variables, their dims and kinds, its attributes.

A file may be of a stranger, of another version or by hand.  What the steps and the pictures take
from it is asked when it is opened, from what HDF5 says of it; no larger variable is read for that.
"""

from collections.abc import Iterable, Mapping

import numpy as np
import xarray as xr

from s4a.input.files import slug
from s4a.schema import POINTS_INTO, TABLE

# what s4a.input.plausibility says of a shape
SEEN = "surface compactness chirality open_boundary lattice self_intersections intersecting".split()
# variables, and attributes with what they are
REQUIRED: dict[str, tuple[str, dict[str, type]]] = {
    "original": ("position corner_vertex file_vertex", {"status": str, "reason": str, "area": int}),
    "coarse": (
        "position corner_vertex vertex_area sample_vertex coarse_vertex coarse_weight eigenvalue "
        "eigenfunction",
        {"wrapped": int, "kept_whole": int, "laplacian": str},
    ),
    "coarse/scalable": (
        "position corner_vertex vertex_area sample_vertex edge_vertex cotan_weight edge_mass "
        "sample_cell local_vertex local_sample local_weight eigenvalue eigenfunction",
        {"method": str, "wrapped": int, "kept_whole": int, "laplacian": str},
    ),
    "network/sketch": (
        "sketch_position sketch_area sketch_normal sketch_asymmetry moment",
        dict.fromkeys(SEEN, int),
    ),
    "network/look": ("moment fit fit_mirrored hand", dict.fromkeys(SEEN, int)),
    "network/hands": ("shape handedness reflected", {"told": str}),
    "network/motion": ("rotation translation", {"reference": str}),
    "network/first": ("source target fmap_initial", {}),
    "network": ("source target fmap_initial fmap weight cycle_error", {}),
    "latent": (
        "shape latent_basis latent_eigenvalue area_difference conformal_difference "
        "distance_to_median",
        {"median": str},
    ),
    "latent/shape": (
        "latent_basis area_difference conformal_difference distance_to_median",
        {},
    ),
    "rounds": ("shape fmap latent_basis latent_eigenvalue", {}),
    "registration": ("position corner_vertex vertex_area", {"template": str}),
    "registration/shape": (
        "registered_match displacement rotation translation scale confidence "
        "template_triangle template_barycentric",
        {"method": str, "score": int},
    ),
    "pca": (
        "shape mean_displacement deformation standard_deviation score explained_variance_ratio",
        {},
    ),
    "fields": ("shape carried_field", {}),
    "subjects": ("shape", {}),
    "report": (
        "shape stage status reason warning path area seconds",
        {"template": str, "remarks": str, "no_modes": str},
    ),
}
TEXTS = set("source target status reason warning path shape stage".split())
SIZES = {"xyz": 3, "xyz_2": 3, "corner": 3, "end": 2}


def kind_of(name: str) -> str:
    """The row of :data:`REQUIRED` for a file of this name.

    Examples
    --------
    >>> from s4a.study.contents import kind_of
    >>> kind_of("network/look_brain_01"), kind_of("registration/a"), kind_of("pca")
    ('network/look', 'registration/shape', 'pca')
    """
    stage, _, shape = name.partition("/")
    if not shape:
        return stage
    if stage == "network":
        return f"network/{shape.partition('_')[0]}"
    return f"{stage}/shape" if stage in ("latent", "registration") else stage


def check_contents(name: str, data: xr.Dataset) -> None:
    """ValueError unless a file has the variables and attributes that a file of its name has.

    Parameters
    ----------
    name : str
        As ``coarse/brain_01``: its path in the folder of the study, without the suffix.
    data : Dataset
        Of :func:`s4a.study.store.open_file`.

    Examples
    --------
    >>> from s4a.schema import dataset
    >>> from s4a.study.contents import check_contents
    >>> check_contents("pca", dataset(score=[[1.0]]))
    Traceback (most recent call last):
    ...
    ValueError: it lacks shape, mean_displacement, deformation, ...
    """
    kind = kind_of(name)
    if kind not in REQUIRED:
        raise ValueError("no file of a study has this name")
    if kind == "coarse" and data.attrs.get("method") == "scalable":
        kind = "coarse/scalable"
    words, attrs = REQUIRED[kind]
    needed = words.split()
    missing = [one for one in needed if one not in data.variables]
    check_names(data.coords["shape"].values.astype(str).tolist() if "shape" in data.coords else [])
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    for attr, kind_of_value in attrs.items():
        check_attribute(attr, data.attrs.get(attr), kind_of_value)
    check_names(data.attrs[attr] for attr in ("template", "median") if attr in attrs)
    if kind == "registration":
        check_names(str(data.attrs.get("apart", "")).split())
    for one, values in data.variables.items():
        if kind != "subjects":
            check_variable(str(one), values, str(one) in needed)
        elif values.dims != ("shape",):
            raise ValueError(f"the column {one} needs the dim shape, found {values.dims}")
    for dim, size in data.sizes.items():
        if SIZES.get(str(dim), size) != size:
            raise ValueError(f"{dim} needs {SIZES[str(dim)]} entries, found {size}")


def check_attribute(name: str, value: object, kind: type) -> None:
    """ValueError unless an attribute is a text (`kind` str), or a number (any other)."""
    kinds = str if kind is str else (int, float, np.number)
    if not isinstance(value, kinds):
        found = "nothing" if value is None else repr(value)[:40]
        raise ValueError(
            f"the attribute {name} needs a {'text' if kind is str else 'number'}, found {found}"
        )


def check_variable(name: str, values: xr.Variable, needed: bool) -> None:
    """ValueError unless a variable has the dims of the table and, where needed, is of its kind."""
    is_coordinate = name in values.dims
    if not is_coordinate and name not in TABLE:
        raise ValueError(f"no variable of a study is called {name}")
    dims = (name,) if is_coordinate else TABLE[name][0]
    of_one = dims[1:] if dims[:1] in (("shape",), ("pair",)) and not is_coordinate else dims
    if values.dims not in (dims, of_one):
        raise ValueError(f"{name} needs the dims {dims}, found {values.dims}")
    if name in TEXTS:
        kinds, what = "U", "text"
    elif name in POINTS_INTO:
        kinds, what = "iu", "integers"
    else:
        kinds, what = "iuf", "numbers"
    if (needed or name in POINTS_INTO) and values.dtype.kind not in kinds:
        raise ValueError(f"{name} needs {what}, found {values.dtype}")
    if name in ("shape", "stage"):
        names, counts = np.unique(values.values, return_counts=True)
        twice = names[counts > 1].tolist()
        if twice:
            raise ValueError(f"{name} needs names that differ, found {twice} more than once")


def check_names(names: Iterable[str]) -> None:
    """ValueError where a shape has a name that could lead out of the folder as that of a file."""
    wrong = [name for name in names if slug(name) != name]
    if wrong:
        raise ValueError(f"shapes need names of letters, digits, _ and -; found {wrong}")


# ---- what files have in common


def check_fit(
    name: str, data: xr.Dataset, others: Mapping[str, xr.Dataset], damaged: Iterable[str] = ()
) -> None:
    """ValueError where a file does not fit to those of the study that it was made from.

    Parameters
    ----------
    name : str
        As in :func:`check_contents`.
    data : Dataset
    others : dict of str to Dataset
        By name, those that were read before.
    damaged : iterable of str
        Names of those that could not be read: what was made from them may be right.
    """
    stage, _, shape = name.partition("/")
    original = others.get(f"original/{shape}")
    if stage in ("coarse", "registration") and shape and original is not None:
        check_size(data, "original_vertex", original.sizes["vertex"], f"original/{shape}")
    if stage == "registration" and shape:
        if "registration" in others:
            fit_registration(data, others)
    elif stage == "registration":
        template = data.attrs["template"]
        mesh = others.get(f"original/{template}")
        if "latent" in others:
            check_among("template", [template], others["latent"]["shape"].values.tolist())
        if mesh is not None:
            for dim in ("vertex", "triangle"):
                check_size(data, dim, mesh.sizes[dim], f"original/{template}")
    elif stage == "latent" and not shape:
        fit_latent(data, others)
    elif stage in ("pca", "fields") and "registration" in others:
        names = [
            one.partition("/")[2] for one in (*others, *damaged) if one.startswith("registration/")
        ]
        check_among("scores" if stage == "pca" else "fields", data["shape"].values.tolist(), names)
        check_size(data, "vertex", others["registration"].sizes["vertex"], "registration")


def fit_latent(data: xr.Dataset, others: Mapping[str, xr.Dataset]) -> None:
    """:func:`check_fit` of the latent bases."""
    names = data["shape"].values.tolist()
    check_among("median", [data.attrs["median"]], names)
    if "network" in others:
        ends = others["network"][["source", "target"]].to_array().values.ravel().tolist()
        check_among("source and target of network", ends, names)
    for one in names:
        coarse = others.get(f"coarse/{one}")
        if coarse is not None and coarse.sizes["mode"] < data.sizes["mode"]:
            raise ValueError(
                f"{data.sizes['mode']} modes need as many eigenfunctions of {one}, "
                f"found {coarse.sizes['mode']} in coarse/{one}"
            )


def fit_registration(data: xr.Dataset, others: Mapping[str, xr.Dataset]) -> None:
    """:func:`check_fit` of the registration of one shape."""
    mesh = others["registration"]
    check_size(data, "vertex", mesh.sizes["vertex"], "registration")
    template = others.get(f"coarse/{mesh.attrs['template']}")
    if "low_vertex" in data.sizes and template is not None:
        name = f"coarse/{mesh.attrs['template']}"
        check_size(data, "low_vertex", template.sizes["vertex"], name)


def check_size(data: xr.Dataset, dim: str, size: int, name: str) -> None:
    """ValueError unless a dim has as many entries as the file of that name says."""
    if data.sizes.get(dim) != size:
        raise ValueError(f"{dim} needs {size} entries as in {name}, found {data.sizes.get(dim)}")


def check_among(what: str, names: Iterable[str], shapes: Iterable[str]) -> None:
    """ValueError unless all names are of these shapes."""
    unknown = sorted(set(names) - set(shapes))
    if unknown:
        raise ValueError(f"{what} needs shapes of the study, found {', '.join(unknown)}")
