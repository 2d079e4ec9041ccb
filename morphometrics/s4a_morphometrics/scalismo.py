"""Statistical shape models of Scalismo and statismo (6.1): write modes, read models.

A model is a Gaussian: x = mean + sum_i a_i sqrt(lambda_i) u_i with a_i standard normal and u_i
orthonormal over the 3 n coordinates.  Modes of S4A are orthonormal under the vertex areas instead.
They are rotated when written: the Gaussian is unchanged, its components are those of equal weights.
"""

import os
from pathlib import Path

import h5py
import numpy as np
import xarray as xr

from s4a.analysis.inputs import registration_of
from s4a.geometry.mesh import as_arrays, as_dataset, vertex_areas
from s4a.input.raw import check_there, shown
from s4a.method.pca import synthesize
from s4a.schema import check_count, dataset, unit_of
from s4a.study.netcdf import open_hdf5, stored_in, values_of

MODEL = ("model/mean", "model/pcaBasis", "model/pcaVariance")
REPRESENTER = ("representer/points", "representer/cells")
NOISE = "model/noiseVariance"


def write_scalismo(
    study: xr.DataTree, folder: Path | str, *, n_modes: int | None = None
) -> list[Path]:
    """Write the modes as a statistical shape model of Scalismo (statismo 0.9), ``model.h5``.

    Parameters
    ----------
    study : DataTree
        With ``/registration`` and ``/pca``.
    folder : path
        Created if missing.
    n_modes : int, optional
        Number of modes, the first ones; all by default.

    Returns
    -------
    list of Path
        ``model.h5``: in the frame of the template, the unit of the input and single precision.

    Raises
    ------
    ValueError
        If the study has no modes.

    See Also
    --------
    read_scalismo : reads the file.

    References
    ----------
    M. Luethi, R. Blanc, T. Albrecht et al. (2012), Statismo: a framework for PCA based statistical
    models, The Insight Journal.
    """
    registration = registration_of(study)
    X, T = as_arrays(registration)
    mean = synthesize(study, np.zeros(1))["position"].values
    modes = study["pca"].to_dataset()
    D = modes["deformation"].values.astype(float)  # (c, n, 3), for one standard deviation
    if n_modes is not None:
        check_count("n_modes", n_modes, 1)
        D = D[:n_modes]
    U, S, _ = np.linalg.svd(D.reshape(len(D), -1).T, full_matrices=False)  # (3 n, c)
    largest = U[np.abs(U).argmax(0), np.arange(len(S))]
    basis = U * np.where(largest < 0, -1.0, 1.0)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "model.h5"
    with h5py.File(path, "w") as file:
        file["model/mean"] = mean.ravel().astype(np.float32)
        file["model/pcaBasis"] = basis.astype(np.float32)
        file["model/pcaVariance"] = (S**2).astype(np.float32)
        file["model/noiseVariance"] = np.zeros(1, np.float32)
        file["representer/points"] = np.ascontiguousarray(X.T, np.float32)
        file["representer/cells"] = np.ascontiguousarray(T.T, np.int32)
        attributes = {
            "name": "itkStandardMeshRepresenter",
            "version/majorVersion": "0",
            "version/minorVersion": "9",
            "datasetType": "POLYGON_MESH",
        }
        for name, value in attributes.items():
            file["representer"].attrs[name] = value
        file["version/majorVersion"], file["version/minorVersion"] = np.int32(0), np.int32(9)
        file["modelinfo/build-time"] = ""
        builder = file.create_group("modelinfo/modelBuilder-0")
        builder["builderName"], builder["buildTime"] = "S4A", ""
        builder.create_group("parameters")["unit"] = unit_of(registration["displacement"])
        builder.create_group("dataInfo")
    return [path]


def read_scalismo(path: Path | str) -> xr.DataTree:
    """Read a statistical shape model of Scalismo or statismo.

    Parameters
    ----------
    path : str or Path
        HDF5 file of a triangle mesh model, version 0.8, 0.9 or 1.x.

    Returns
    -------
    DataTree
        ``/registration`` with the reference as template, and ``/pca`` with ``mean_displacement``,
        ``deformation``, ``standard_deviation`` (for areas of sum 1) and
        ``explained_variance_ratio``; its attribute ``noise_variance``.

    Raises
    ------
    ValueError
        If the file is missing or not such a model; the message names the file and the missing part.

    See Also
    --------
    s4a.synthesize : synthesises shapes of the model.

    Examples
    --------
    With the ``study`` of six small brains; the model is written and read:

    >>> import tempfile
    >>> import s4a
    >>> import s4a_morphometrics
    >>> from s4a_morphometrics.scalismo import read_scalismo, write_scalismo
    >>> study = s4a.synthetic.example_study()
    >>> model = read_scalismo(*write_scalismo(study, tempfile.mkdtemp()))
    >>> mean, again = (s4a.synthesize(tree, [0.0])["position"].values for tree in (study, model))
    >>> bool(abs(mean - again).max() < 1e-4)
    True
    """
    check_there(path)
    try:
        with open_hdf5(os.path.realpath(path)) as file:
            mean, basis, variance, X, T = (_array(file, name) for name in MODEL + REPRESENTER)
            noise = _array(file, NOISE) if file.links.exists(NOISE.encode()) else [0.0]
            is_scaled = _version(file) == (0, 8)  # columns have the length of one deviation
    except Exception as error:  # the message must name the file
        raise ValueError(
            f"{shown(path)} cannot be read as a statistical shape model: "
            f"{shown(error) or type(error).__name__}"
        ) from error
    n = X.shape[1] if X.ndim == 2 else 0
    fits = X.shape == (3, n) and T.shape[:1] == (3,) and T.ndim == 2 and mean.shape == (3 * n,)
    fits = fits and basis.shape == (3 * n, len(variance)) and variance.ndim == 1 and n > 0
    if not fits or T.dtype.kind not in "iu" or not (0 <= T.min(initial=0) <= T.max() < n):
        raise ValueError(
            f"{shown(path)} cannot be read as a statistical shape model: points (3, n), triangles "
            "(3, m) of them, mean (3 n) and basis (3 n, c) with c variances needed; found "
            f"{X.shape}, {T.shape}, {mean.shape}, {basis.shape} and {variance.shape}"
        )
    X, T = np.ascontiguousarray(X.T, float), np.ascontiguousarray(T.T, np.int32)
    width = 1.0 if is_scaled else np.sqrt(np.maximum(variance, 0))
    D = (basis.astype(float) * width).T.reshape(-1, n, 3)
    area = vertex_areas(X, T)
    variances = np.einsum("cnx,n->c", D**2, area / area.sum())
    modes = dataset(
        mean_displacement=mean.reshape(n, 3) - X,
        deformation=D,
        standard_deviation=np.sqrt(variances),
        explained_variance_ratio=variances / variances.sum(),
    )
    registration = as_dataset(X, T, {"template": "reference"}, vertex_area=area)
    modes.attrs["noise_variance"] = float(np.ravel(noise)[0])
    return xr.DataTree.from_dict({"/registration": registration, "/pca": modes})


def _array(file: h5py.h5f.FileID, name: str) -> np.ndarray:
    """Return the numbers of a dataset stored in the file itself."""
    try:
        values = values_of(file, name)
    except KeyError as error:
        found = ", ".join(key.decode() for key in file)
        raise ValueError(f"{name} needed, found {found or 'nothing'}") from error
    if not np.isfinite(values).all():
        raise ValueError(f"{name} needs finite numbers")
    return values


def _version(file):
    """Return major and minor version; the first statismo files have only a name."""
    if file.links.exists(b"version"):
        return tuple(int(_array(file, f"version/{part}Version")) for part in ("major", "minor"))
    name = h5py.Group(stored_in(file, "representer")).attrs.get("name", "")
    if name in ("vtkPolyDataRepresenter", "itkMeshRepresenter"):
        return (0, 8)
    raise ValueError("version/majorVersion needed, found none")
