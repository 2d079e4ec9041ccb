"""Labels transferred from the template to every shape, as volumes in the grid of its scan (6.2).

A voxel whose centre is inside a shape gets the label of its nearest vertex.
"""

import logging
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from s4a.analysis.inputs import registration_of
from s4a.analysis.transfer import transfer_labels
from s4a.geometry.compiled import igl
from s4a.geometry.mesh import as_arrays
from s4a.input.chirality import map_to_file
from s4a.input.coordinates import CoordinateSystem, file_system, map_between, moved, turned
from s4a.input.labels import read_grid, voxels_marked
from s4a.input.raw import new_folder
from s4a.schema import Array

log = logging.getLogger(__name__)

VOLUMES = ("NIfTI", "MGH", "NRRD")


def write_label_volumes(
    study: xr.DataTree,
    folder: Path | str,
    *,
    label: Array | None = None,
    grid: Path | str | None = None,
    coordinate_system: str | None = None,
    unit: str | None = None,
) -> list[Path]:
    """Transfer labels of the template to every shape and write them as NIfTI volumes.

    Parameters
    ----------
    study : DataTree
    folder : path
        Folder for ``<shape>.nii.gz``: integers, 0 outside the shape, with the affine map of the
        grid, in millimetres, RAS.
    label : int array_like (vertex,), optional
        Labels of the template's vertices, not 0; by default those of its file.
    grid : path, optional
        NIfTI, MGH or NRRD volume that defines the voxel grid of every shape; by default the label
        volume from which each shape was extracted, with its labelled voxels.
    coordinate_system, unit : str, optional
        For files that state none (:mod:`s4a.input.coordinates`).

    Returns
    -------
    list of Path

    Raises
    ------
    ValueError
        If labels are missing or not integers, a shape was not extracted from a volume and `grid` is
        not given, its coordinates cannot be converted to those of the volume, or no voxel is inside
        a shape.

    See Also
    --------
    s4a.transfer_labels : Labels at vertices.

    Examples
    --------
    In a study of six small brains, in the voxels of a scan of 4 mm:

    >>> import tempfile
    >>> from pathlib import Path
    >>> import nibabel
    >>> import numpy as np
    >>> import s4a
    >>> import s4a_morphometrics
    >>> study, folder = s4a.synthetic.example_study(), Path(tempfile.mkdtemp())
    >>> affine = np.array([[4, 0, 0, -120], [0, 4, 0, -120], [0, 0, 4, -120], [0, 0, 0, 1.0]])
    >>> scan = nibabel.Nifti1Image(np.zeros((60, 60, 60), np.uint8), affine)
    >>> nibabel.save(scan, folder / "scan.nii")
    >>> label, grid = np.ones(200, int), folder / "scan.nii"
    >>> paths = s4a_morphometrics.write_label_volumes(study, folder, label=label, grid=grid)
    >>> paths[0].name
    'brain_01.nii.gz'
    """
    registration = registration_of(study)
    names, template = registration["shape"].values.tolist(), registration.attrs["template"]
    if label is None:
        mesh = study["original"][template].to_dataset()
        if "label" not in mesh:
            raise ValueError(
                f"labels of the template {template!r} are needed; its file has none: give label= "
                "(--labels FILE)"
            )
        label = mesh["label"].values
    label = np.asarray(label)
    if label.dtype.kind not in "iu" or abs(label).max(initial=0) >= 2**31:
        raise ValueError(
            f"a label volume needs integers under {2**31}; found {label.dtype}: number the labels "
            "first"
        )
    # before any file is written
    grids = {name: _grid_of(study, name, grid) for name in names}
    given = CoordinateSystem.of({"coordinate_system": coordinate_system, "unit": unit})
    maps = {}
    for name, (volume, _) in grids.items():
        attrs = study["original"][name].attrs
        file, system = file_system(attrs).filled(given), read_grid(volume)[2]
        what = f"{name}, to be written in {volume},"
        maps[name] = map_between(file, system, what) @ map_to_file(attrs)
    transferred = transfer_labels(study, label, targets=names)
    folder = new_folder(folder)
    paths = []
    for name in names:
        mesh = study["original"][name].to_dataset()
        volume = _volume(mesh, maps[name], name, transferred[name]["label"].values, *grids[name])
        paths.append(folder / f"{name}.nii.gz")
        _save(paths[-1], *volume)
    return paths


def _grid_of(study, name, grid):
    """Volume that defines the grid, and the label from which the shape was extracted, if any."""
    attrs = study["original"][name].attrs
    if grid is not None:
        return grid, None
    if attrs.get("format") not in VOLUMES:
        raise ValueError(
            f"{name} was read from {attrs.get('format') or 'arrays'}, not from a volume: give a "
            "scan that defines the grid, grid= (--grid FILE)"
        )
    if not Path(attrs.get("path", "")).is_file():
        raise ValueError(
            f"{name} was read from {attrs.get('path')}, which no longer exists: give grid= "
            "(--grid FILE)"
        )
    return attrs["path"], attrs["label"]


def _volume(mesh, M, name, label, grid, source_label):
    """Labels at the voxels of a grid ``(x, y, z)``, and the affine map."""
    Y, S = as_arrays(mesh)
    Y, S = moved(Y, M), turned(S, M)
    if source_label is not None:
        inside, affine = voxels_marked(grid, source_label)
        voxel = np.argwhere(inside)
        centre = voxel @ affine[:3, :3].T + affine[:3, 3]
        shape = inside.shape
    else:
        shape, affine, _ = read_grid(grid)
        voxel, centre = _voxels_within(Y, S, shape, affine)
        if not len(voxel):
            raise ValueError(
                f"no voxel of {grid} is inside {name}, whose surface extends from "
                f"{_as_text(Y.min(0))} to {_as_text(Y.max(0))} mm (RAS): give the scan of this "
                "shape"
            )
        index = (Y - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T
        outside = ((index < -0.5) | (index > np.array(shape) - 0.5)).any(axis=1).mean()
        if outside:
            log.warning("%s is cut off: %.1f %% lie outside of %s", name, 100 * outside, grid)
    values = np.zeros(shape, np.int32)
    values[tuple(voxel.T)] = label[cKDTree(Y).query(centre)[1]]
    return values, affine


def _voxels_within(Y, S, shape, affine):
    """Indices ``(v, 3)`` and centres of the voxels inside a surface."""
    inverse = np.linalg.inv(affine)
    corners = Y @ inverse[:3, :3].T + inverse[:3, 3]
    low = np.maximum(np.ceil(corners.min(0)).astype(int), 0)
    high = np.minimum(np.floor(corners.max(0)).astype(int) + 1, shape)
    if (high <= low).any():
        return np.empty((0, 3), int), np.empty((0, 3))
    axes = [np.arange(a, b) for a, b in zip(low, high, strict=True)]
    voxel = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    centre = voxel @ affine[:3, :3].T + affine[:3, 3]
    winding = igl.fast_winding_number(Y, S.astype(np.int64), centre)
    inside = winding > 0.5
    return voxel[inside], centre[inside]


def _as_text(point):
    return "(" + ", ".join(f"{x:.1f}" for x in point.tolist()) + ")"


def _save(path, values, affine):
    """Write a NIfTI volume in millimetres."""
    import nibabel

    small = np.int16 if abs(values).max() < 2**15 else np.int32
    image = nibabel.Nifti1Image(values.astype(small), affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)
