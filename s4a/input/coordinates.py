"""Coordinate systems of files (5.1, the data): read, compare and convert.

A system has axes, an origin and a unit.  It is stored as the attributes ``coordinate_system``, a
text such as those of :data:`EXAMPLES`, and ``unit``.  Everything that combines files asks
:func:`transform`, which is None if what is needed is unknown.
"""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import xarray as xr

from s4a.input.formats import VtkXml, freesurfer_counts
from s4a.input.raw import xml
from s4a.options import MILLIMETRES
from s4a.schema import in_unit

EXAMPLES = (
    "RAS",  # world coordinates of an image, as 3D Slicer and most programs use them
    "LPS",
    "scanner RAS",
    "surface RAS, c_ras 1.5 -20 35",  # FreeSurfer's; adding c_ras gives scanner RAS
    "MNI152 RAS",  # any other word is the name of a template space
    "RAS, origin unknown",
)
OPPOSITE = dict(zip("RLAPSI", "LRPAIS", strict=True))
SURFACE, UNKNOWN = "surface", "unknown"
XFORMS = {1: "scanner", 3: "Talairach", 4: "MNI152", 5: "template"}  # codes of NIfTI; 2 is world
SPACES = {"SCANNER_ANAT": 1, "ALIGNED_ANAT": 2, "TALAIRACH": 3, "MNI_152": 4}  # of GIFTI
REMEDY = (
    "coordinate_system= and unit= say what a file does not; or save the files in one coordinate "
    "system"
)


@dataclass(frozen=True)
class CoordinateSystem:
    """Axes, origin and unit of the coordinates of a file.

    Parameters
    ----------
    axes : str
        Where x, y and z point, such as RAS (right, anterior, superior); empty if unknown.
    origin : str
        Empty for the world coordinates of an image, ``scanner``, ``surface`` for FreeSurfer's
        surface RAS, ``unknown``, or the name of a template space.
    unit : str
        A key of :data:`s4a.options.MILLIMETRES`; empty if unknown.
    to_world : tuple of 12 floats, optional
        The affine map (3, 4) of surface RAS to scanner RAS, in millimetres.
    """

    axes: str = ""
    origin: str = ""
    unit: str = ""
    to_world: tuple[float, ...] | None = None

    @classmethod
    def of(cls, attrs: Mapping[Any, Any], prefix: str = "") -> Self:
        """Return the system in the attributes of a mesh or of landmarks.

        Raises
        ------
        ValueError
            If the text is not that of a coordinate system.

        Examples
        --------
        >>> from s4a.input.coordinates import EXAMPLES, CoordinateSystem
        >>> systems = [CoordinateSystem.of({"coordinate_system": text}) for text in EXAMPLES]
        >>> [system.attrs["coordinate_system"] for system in systems] == list(EXAMPLES)
        True
        """
        text = str(attrs.get(f"{prefix}coordinate_system") or "")
        unit = str(attrs.get(f"{prefix}unit") or "")
        words = re.fullmatch(r"(?:(\S+) )?([A-Z]{3})(?:, (origin unknown|[\w ]+ [-+\d].*))?", text)
        if not text:
            return cls(unit=unit)
        if not words or {min(axis, OPPOSITE[axis]) for axis in words[2] if axis in OPPOSITE} != {
            *"LAI"
        }:
            raise ValueError(
                f"a coordinate system such as {'; '.join(EXAMPLES)} needed, found {text!r}"
            )
        origin, numbers = words[1] or "", None
        if words[3] == "origin unknown":
            origin = UNKNOWN
        elif words[3]:
            numbers = affine_of(words[3])
        return cls(words[2], origin, unit, numbers)

    @property
    def attrs(self) -> dict[str, str]:
        """Attributes of a mesh, without those that are unknown."""
        text = self.axes
        if self.origin == UNKNOWN:
            text += ", origin unknown"
        elif self.origin:
            text = f"{self.origin} {text}"
        if self.to_world:
            M = np.reshape(self.to_world, (3, 4))
            is_offset = np.array_equal(M[:, :3], np.eye(3))
            numbers = M[:, 3] if is_offset else M.ravel()
            text += ", c_ras " if is_offset else ", to scanner RAS "
            text += " ".join(f"{x:.9g}" for x in numbers)
        return {k: v for k, v in {"coordinate_system": text, "unit": self.unit}.items() if v}

    @property
    def title(self) -> str:
        """Title of a mesh file, from which 3D Slicer reads the axes; empty if they are unknown."""
        unit = f" UNIT={self.unit}" if self.unit else ""
        placed = " ORIGIN=unknown" if self.origin in (UNKNOWN, SURFACE) else ""
        return f"S4A SPACE={self.axes}{unit}{placed}" if self.axes else ""

    def __str__(self) -> str:
        return ", ".join(self.attrs.values()) if self.axes else f"unknown {self.unit}".strip()

    def filled(self, given: Self) -> Self:
        """Return the system with what it leaves open as in another one."""
        if not self.axes:
            return replace(given, unit=self.unit or given.unit)
        place = given if self.origin == UNKNOWN and given.axes else self
        if self.origin == SURFACE == given.origin and not self.to_world:
            place = given
        unit = self.unit or given.unit
        return replace(self, origin=place.origin, to_world=place.to_world, unit=unit)

    def in_world(self, axes: str = "", unit: str = "") -> Self:
        """Return the system of the scan, for files that cannot store c_ras.

        Axes and unit are those of the system, unless others are given and the system is known.
        """
        system = replace(self, origin="scanner", to_world=None) if self.to_world else self
        system = replace(system, axes=axes or system.axes) if system.axes else system
        return replace(system, unit=unit or system.unit) if system.unit in MILLIMETRES else system


def affine_of(text: str) -> tuple[float, ...]:
    """Return the twelve numbers of ``c_ras x y z`` or ``to scanner RAS``."""
    try:
        numbers = [float(word) for word in re.findall(r"[-+\d][-+.\deE]*(?= |$)", text)]
        M = np.reshape(numbers, (3, -1))
        M = np.column_stack([np.eye(3), M]) if M.shape == (3, 1) else M
        if M.shape != (3, 4) or abs(np.linalg.det(M[:, :3])) < 1e-12 or not np.isfinite(M).all():
            raise ValueError
    except ValueError as error:
        raise ValueError(
            f"c_ras and three numbers, or a map to scanner RAS and twelve, needed, found {text!r}"
        ) from error
    return tuple(M.ravel().tolist())


# conversion


def transform(
    source: CoordinateSystem, target: CoordinateSystem, *, origin: bool = True
) -> np.ndarray | None:
    """Return the affine map (4, 4) between two systems, None if it is unknown.

    Parameters
    ----------
    source, target : CoordinateSystem
    origin : bool
        False for axes and unit alone, for shapes that are aligned anyway.

    Examples
    --------
    >>> from s4a.input.coordinates import CoordinateSystem, transform
    >>> surface = CoordinateSystem.of({"coordinate_system": "surface RAS, c_ras 1 2 3"})
    >>> (transform(surface, CoordinateSystem("LPS")) @ [10, 20, 30, 1]).tolist()
    [-11.0, -22.0, 33.0, 1.0]
    >>> transform(CoordinateSystem("RAS", "unknown"), CoordinateSystem("LPS")) is None
    True
    """
    units = {source.unit, target.unit}
    if bool(source.axes) != bool(target.axes) or (len(units) > 1 and not units <= {*MILLIMETRES}):
        return None
    same = (source.origin, source.to_world) == (target.origin, target.to_world)
    A, B = (linear(system, len(units) > 1) for system in (source, target))
    if origin and not same:
        places = {"scanner" if s.to_world else s.origin for s in (source, target)}
        if places & {UNKNOWN, SURFACE} or len(places - {""}) > 1:
            return None
        A, B = (world(s, len(units) > 1) @ M for s, M in ((source, A), (target, B)))
    return np.linalg.solve(B, A)


def linear(system: CoordinateSystem, scaled: bool) -> np.ndarray:
    """Return the map (4, 4) of a system to the axes RAS and, if `scaled`, to millimetres."""
    M = np.eye(4)
    for row, positive in enumerate("RAS" if system.axes else ""):
        M[row, :3] = [(a == positive) - float(a == OPPOSITE[positive]) for a in system.axes]
    M[:3] *= MILLIMETRES[system.unit] if scaled else 1.0
    return M


def world(system: CoordinateSystem, scaled: bool) -> np.ndarray:
    """Return the map (4, 4) of surface RAS to scanner RAS; the identity for other systems."""
    M = np.eye(4)
    if system.to_world:
        M[:3] = np.reshape(system.to_world, (3, 4))
        M[:3, 3] /= 1.0 if scaled else MILLIMETRES.get(system.unit, 1.0)
    return M


def moved(X: np.ndarray, M: np.ndarray) -> np.ndarray:
    """Apply an affine map (4, 4) to points ``(n, 3)``; the identity leaves every bit."""
    return X if np.array_equal(M, np.eye(4)) else X @ M[:3, :3].T + M[:3, 3]


def map_between(source: CoordinateSystem, target: CoordinateSystem, what: str) -> np.ndarray:
    """Return the map (4, 4) of :func:`transform`, or ValueError with `what` if it is unknown."""
    M = transform(source, target)
    if M is None:
        raise ValueError(
            f"the coordinate system of {what} ({source}) cannot be converted to {target}: {REMEDY}"
        )
    return M


def common(systems: Mapping[str, CoordinateSystem], *, origin: bool = False) -> CoordinateSystem:
    """Return the system to convert files to: the most frequent one, the first on a tie.

    Parameters
    ----------
    systems : dict of str to CoordinateSystem
        By the name of a file or shape.
    origin : bool
        Positions are compared, not only shapes.

    Raises
    ------
    ValueError
        If a system cannot be converted to another; the message names both, with the shapes.
    """
    axes = {n: s if origin else CoordinateSystem(s.axes, "", s.unit) for n, s in systems.items()}
    groups = {s: [n for n in axes if axes[n] == s] for s in axes.values()}
    if any(transform(a, b) is None for a in groups for b in groups):
        texts = [f"{system}: {', '.join(names[:6])}" for system, names in groups.items()]
        raise ValueError(
            "coordinate systems that can be converted to each other needed, found "
            f"{'; '.join(texts)}: {REMEDY}"
        )
    return Counter(axes.values()).most_common(1)[0][0] if axes else CoordinateSystem()


def transformed(mesh: xr.Dataset, M: np.ndarray) -> xr.Dataset:
    """Apply an affine map (4, 4) to a mesh and its landmarks; normals stay outward."""
    image = mesh.copy()
    for name in ("position", "landmark_position", "guide_position"):
        if name in mesh:
            image[name] = mesh[name].copy(data=moved(mesh[name].values, M))
    if np.linalg.det(M) < 0:
        for name in ("corner_vertex", "landmark_barycentric", "guide_barycentric"):
            if name in mesh:
                image[name] = mesh[name].copy(data=np.ascontiguousarray(mesh[name].values[:, ::-1]))
    return image


def file_system(attrs: Mapping[Any, Any]) -> CoordinateSystem:
    """Return the coordinate system of the file that a mesh was read from."""
    prefix = "file_" if "file_coordinate_system" in attrs or "file_unit" in attrs else ""
    return CoordinateSystem.of(attrs, prefix)


def with_system(mesh: xr.Dataset, coordinate_system: str | None, unit: str | None) -> xr.Dataset:
    """Return a mesh with the given coordinate system and unit where its own are unknown."""
    if not (coordinate_system or unit):
        return mesh
    given = CoordinateSystem.of({"coordinate_system": coordinate_system, "unit": unit})
    return mesh.assign_attrs(CoordinateSystem.of(mesh.attrs).filled(given).attrs)


def in_axes(mesh: xr.Dataset, target: CoordinateSystem, what: str = "a mesh") -> xr.Dataset:
    """Convert axes and unit of a mesh; the attribute ``reason`` records it.

    Raises ValueError if axes or unit of the mesh, or of the target, are unknown.
    """
    system = CoordinateSystem.of(mesh.attrs)
    if (system.axes, system.unit) == (target.axes, target.unit):
        return mesh
    common({what: system, "the others": target})
    new = replace(system, axes=target.axes, unit=target.unit)
    M = transform(system, new)
    image = transformed(mesh, M) if M is not None else mesh
    factor = MILLIMETRES.get(system.unit, 1.0) / MILLIMETRES.get(new.unit, 1.0)
    image.attrs |= {f"file_{name}": text for name, text in system.attrs.items()} | new.attrs
    reasons = [mesh.attrs.get("reason", ""), f"converted from {system} to {new}"]
    image.attrs["reason"] = "; ".join(filter(None, reasons))
    if "area" in mesh.attrs:
        image.attrs["area"] *= factor**2
    return in_unit(image, new.unit, of=system.unit)


def in_one_system(meshes: Mapping[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """Return meshes in one system of axes and one unit, see :func:`common`."""
    target = common({name: CoordinateSystem.of(mesh.attrs) for name, mesh in meshes.items()})
    return {name: in_axes(mesh, target, name) for name, mesh in meshes.items()}


# the systems of files


def system_in(data: bytes, kind: str) -> CoordinateSystem:
    """Return the coordinate system that the content of a mesh file states.

    Parameters
    ----------
    data : bytes
    kind : str
        See :func:`s4a.input.formats.format_of`.
    """
    if kind == "FreeSurfer":
        return _of_freesurfer(data)
    if kind == "GIFTI":
        return _of_gifti(data)
    if kind == "MNI":
        return CoordinateSystem("RAS", "", "mm")
    # 3D Slicer writes this into the title or a comment of any file, and into fields of VTK files
    head = data[:1000]
    space = re.search(rb"SPACE=([RLAPSI]{3})\b", head)
    unit = re.search(rb"UNIT=(um|mm|cm|m|in)\b", head)
    axes = space[1].decode() if space else ""
    if kind == "VTK" and not space:
        field = re.search(rb"\nSPACE 1 1 string\r?\n[\xc3\s]*([RLAPSI]{3})\s", data)
        axes = field[1].decode() if field else ""
    if kind == "VTP" and not space and b"SPACE" in data:
        axes = next(iter(VtkXml(data).strings("SPACE")), "")
    origin = UNKNOWN if b" ORIGIN=unknown" in head else ""
    default = "mm" if axes and (not space or b"Slicer" in head) else ""
    return CoordinateSystem(axes, origin, unit[1].decode() if unit else default)


def _of_freesurfer(data):
    """Surface RAS, with the map to scanner RAS in the footer: ``cras``, ``xras`` and so on."""
    start, n, m = freesurfer_counts(data)
    footer = data[start + 12 * (n + m) :]
    if footer.startswith(b"\0\0\0\2\0\0\0\1"):  # useRealRAS
        return CoordinateSystem("RAS", "scanner", "mm")
    numbers = {
        name.decode(): [float(word) for word in words.split()]
        for name, words in re.findall(rb"\n([xyzc]ras)\s*=((?:\s*[-+.\deE]+){3})", footer)
    }
    if len(numbers) < 4 or not re.search(rb"valid = 1\b", footer):
        return CoordinateSystem("RAS", SURFACE, "mm")
    return surface_system(*(numbers[f"{axis}ras"] for axis in "xyzc"))


def surface_system(x: Any, y: Any, z: Any, c: Any) -> CoordinateSystem:
    """Return surface RAS of a volume with the directions x, y and z and the centre c."""
    # voxel axes of the conformed volume, which surface RAS follows: left, inferior, anterior
    R = np.column_stack([x, y, z]) @ np.array([[-1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3):
        raise ValueError("perpendicular directions of a volume needed in its geometry")
    numbers = tuple((np.column_stack([R, c]) + 0.0).ravel().tolist())
    return CoordinateSystem("RAS", SURFACE, "mm", numbers)


def _of_gifti(data):
    """RAS in mm; the space of the points, their map to scanner RAS, or FreeSurfer's VolGeom."""
    unknown = CoordinateSystem("RAS", UNKNOWN, "mm")
    points = [a for a in xml(data).iter("DataArray") if "POINTSET" in a.get("Intent", "")]
    if not points:
        return unknown
    codes = {}
    for node in points[0].iter("CoordinateSystemTransformMatrix"):
        texts = [node.findtext(tag) or "" for tag in ("DataSpace", "TransformedSpace")]
        here, there = (SPACES.get(t.strip().removeprefix("NIFTI_XFORM_"), 0) for t in texts)
        codes[here, there] = [float(word) for word in (node.findtext("MatrixData") or "").split()]
    known = [here for here, _ in codes if here]
    if known:
        return replace(unknown, origin=XFORMS.get(known[0], ""))
    meta = {m.findtext("Name"): m.findtext("Value") for m in points[0].iter("MD")}
    geometry = [[meta.get(f"VolGeom{a}_{b}") for b in "RAS"] for a in "XYZC"]
    if all(word for row in geometry for word in row):
        return surface_system(*np.array(geometry, float))
    for (_, there), numbers in codes.items():
        if there in (1, 2) and len(numbers) == 16:
            return replace(unknown, origin=SURFACE, to_world=tuple(numbers[:12]))
    return unknown


def nifti_system(code: int) -> CoordinateSystem:
    """Return the system of the affine map of a NIfTI or MGH volume, by NIfTI's code."""
    return CoordinateSystem("RAS", XFORMS.get(code, ""), "mm")
