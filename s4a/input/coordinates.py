"""Coordinate systems of files (5.1, the data): read, compare and convert.

A system has axes, an origin and a unit.  It is stored as the attributes ``coordinate_system``, a
text such as those in :data:`EXAMPLES`, and ``unit``.  Code that combines files calls
:func:`transform`, which returns None if the map is unknown.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any, Self

import numpy as np
import xarray as xr

from s4a.input.formats import VtkXml, freesurfer_counts
from s4a.input.raw import xml
from s4a.options import MILLIMETRES, check_unit
from s4a.schema import Array, in_unit

# RAS and LPS: world coordinates of an image, as 3D Slicer and most programs use them; surface RAS:
# FreeSurfer's, adding c_ras gives scanner RAS; any other word is the name of a template space
EXAMPLES = (
    "RAS, LPS, scanner RAS, 'surface RAS, c_ras 1.5 -20 35', MNI152 RAS, 'RAS, origin unknown'"
)
AXES = {"".join(axes) for one in product("RL", "AP", "SI") for axes in permutations(one)}
TEXT = re.compile(
    r"(?:(\S+) )?(...)(?:, (?:c_ras|to scanner RAS)((?: [-+.\de]+)+))?(, origin unknown)?"
)
SURFACE, UNKNOWN = "surface", "unknown"
XFORMS = {1: "scanner", 3: "Talairach", 4: "MNI152", 5: "template"}  # codes of NIfTI; 2 is world
SPACES = {"SCANNER_ANAT": 1, "ALIGNED_ANAT": 2, "TALAIRACH": 3, "MNI_152": 4}  # of GIFTI
REMEDY = (
    "set coordinate_system= and unit= for files that lack them, or save all files in one "
    "coordinate system"
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
    to_scanner : tuple of 12 floats, optional
        The affine map (3, 4) of surface RAS to scanner RAS, in millimetres.
    """

    axes: str = ""
    origin: str = ""
    unit: str = ""
    to_scanner: tuple[float, ...] | None = None

    @classmethod
    def of(cls, attrs: Mapping[Any, Any], prefix: str = "") -> Self:
        """Return the system in the attributes of a mesh or of landmarks.

        Raises
        ------
        ValueError
            If the text is not that of a coordinate system.

        Examples
        --------
        >>> from s4a.input.coordinates import CoordinateSystem
        >>> text = "surface RAS, c_ras 1.5 -20 35"
        >>> system = CoordinateSystem.of({"coordinate_system": text, "unit": "mm"})
        >>> system.axes, system.origin, str(system)
        ('RAS', 'surface', 'surface RAS, c_ras 1.5 -20 35, mm')
        """
        text, unit = (str(attrs.get(prefix + key) or "") for key in ("coordinate_system", "unit"))
        if not text:
            return cls(unit=unit)
        words = TEXT.fullmatch(text)
        numbers = words[3].split() if words and words[3] else []
        M = np.array(numbers, float).reshape(3, -1) if len(numbers) in (3, 12) else np.eye(3, 4)
        M = np.column_stack([np.eye(3), M]) if len(numbers) == 3 else M
        fits = len(numbers) in (0, 3, 12) and abs(np.linalg.det(M[:, :3])) > 1e-9
        if not words or words[2] not in AXES or not fits:
            raise ValueError(f"one coordinate system of {EXAMPLES} needed, found {text!r}")
        to_scanner = tuple(M.ravel().tolist()) if numbers else None
        return cls(words[2], UNKNOWN if words[4] else words[1] or "", unit, to_scanner)

    @property
    def attrs(self) -> dict[str, str]:
        """Attributes of a mesh, without those that are unknown."""
        text = f"{self.origin} {self.axes}".strip()
        if self.origin == UNKNOWN:
            text = f"{self.axes}, origin unknown"
        if self.to_scanner:
            M = np.reshape(self.to_scanner, (3, 4))
            is_offset = np.array_equal(M[:, :3], np.eye(3))
            numbers = " ".join(f"{x:.9g}" for x in (M[:, 3] if is_offset else M.ravel()))
            text += f", {'c_ras' if is_offset else 'to scanner RAS'} {numbers}"
        return {k: v for k, v in {"coordinate_system": text, "unit": self.unit}.items() if v}

    @property
    def title(self) -> str:
        """Title of a mesh file, from which 3D Slicer reads the axes; empty if they are unknown."""
        unit = f" UNIT={self.unit}" if self.unit else ""
        is_name = self.origin != SURFACE and re.fullmatch(r"\w+", self.origin)
        place = f" ORIGIN={self.origin if is_name else UNKNOWN}" if self.origin else ""
        return f"S4A SPACE={self.axes}{unit}{place}" if self.axes else ""

    def __str__(self) -> str:
        return ", ".join(self.attrs.values()) if self.axes else f"unknown {self.unit}".strip()

    def filled(self, given: Self) -> Self:
        """Return the system, with unknown parts taken from another one."""
        unit, both = self.unit or given.unit, self.axes and given.axes
        is_open = self.origin == UNKNOWN or (
            self.origin == SURFACE == given.origin and not self.to_scanner
        )
        place = given if not self.axes or (both and is_open) else self
        return replace(place, axes=self.axes or given.axes, unit=unit)

    def in_world(self, axes: str = "", unit: str = "") -> Self:
        """Return the system of the scan, for files that cannot store c_ras.

        Axes and unit are those of the system, unless others are given and the system is known.
        """
        axes, unit = self.axes and (axes or self.axes), self.unit and (unit or self.unit)
        place = "scanner" if self.to_scanner else self.origin
        return replace(self, axes=axes, origin=place, unit=unit, to_scanner=None)


def transform(
    source: CoordinateSystem, target: CoordinateSystem, *, origin: bool = True
) -> Array | None:
    """Return the affine map (4, 4) between two systems, None if it is unknown.

    Parameters
    ----------
    source, target : CoordinateSystem
    origin : bool
        False converts axes and unit only, for shapes that are aligned later.

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
    same = (source.origin, source.to_scanner) == (target.origin, target.to_scanner)
    if origin and not same:
        places = {"scanner" if s.to_scanner else s.origin for s in (source, target)}
        if places & {UNKNOWN, SURFACE} or len(places - {""}) > 1:
            return None
    A, B = (map_to_ras(system, placed=origin and not same) for system in (source, target))
    return np.linalg.solve(B, A)


def map_to_ras(system: CoordinateSystem, *, placed: bool) -> Array:
    """Return the map (4, 4) of a system to RAS in mm, or to scanner RAS if `placed`."""
    M = np.eye(4)
    for row, ends in enumerate(("RL", "AP", "SI") if system.axes else ()):
        M[row, :3] = [{ends[0]: 1.0, ends[1]: -1.0}.get(axis, 0.0) for axis in system.axes]
    M[:3] *= MILLIMETRES.get(system.unit, 1.0)
    if placed and system.to_scanner:
        return np.reshape([*system.to_scanner, 0, 0, 0, 1], (4, 4)) @ M
    return M


def map_between(source: CoordinateSystem, target: CoordinateSystem, what: str) -> Array:
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
        Whether the origin counts: positions are compared, not only shapes.

    Raises
    ------
    ValueError
        If a system cannot be converted to another; the message names both, with the shapes.
    """
    own = {n: s if origin else CoordinateSystem(s.axes, "", s.unit) for n, s in systems.items()}
    groups = {s: [n for n in own if own[n] == s] for s in own.values()}
    if any(transform(a, b) is None for a in groups for b in groups):
        texts = "; ".join(f"{system}: {', '.join(names[:6])}" for system, names in groups.items())
        raise ValueError(f"convertible coordinate systems needed, found {texts}: {REMEDY}")
    return max(groups, key=lambda system: len(groups[system]), default=CoordinateSystem())


def only(what: str, texts: Iterable[str]) -> str:
    """Return the text of all, apart from empty ones, or ValueError if there are several."""
    found = sorted({*texts} - {""})
    if len(found) > 1:
        raise ValueError(f"one {what} expected, found {' and '.join(found)}: correct the file")
    return "".join(found)


# meshes


def moved(X: Array, M: Array) -> Array:
    """Apply an affine map (4, 4) to points ``(n, 3)``; the identity returns X itself."""
    return X if np.array_equal(M, np.eye(4)) else X @ M[:3, :3].T + M[:3, 3]


def turned(T: Array, M: Array) -> Array:
    """Return triangles ``(m, 3)``, reversed if a map (4, 4) reflects, to face outward."""
    return np.ascontiguousarray(T[:, ::-1]) if np.linalg.det(M) < 0 else T


def transformed(mesh: xr.Dataset, M: Array) -> xr.Dataset:
    """Apply an affine map (4, 4) to a mesh and its landmarks; normals stay outward."""
    apply: dict[str, Any] = {f"{name}position": moved for name in ("", "landmark_", "guide_")}
    apply |= dict.fromkeys(("corner_vertex", "landmark_barycentric", "guide_barycentric"), turned)
    found = {name: mesh[name] for name in apply if name in mesh}
    return mesh.assign({n: v.copy(data=apply[n](v.values, M)) for n, v in found.items()})


def file_system(attrs: Mapping[Any, Any]) -> CoordinateSystem:
    """Return the coordinate system of the file that a mesh was read from."""
    prefix = "file_" if "file_coordinate_system" in attrs or "file_unit" in attrs else ""
    return CoordinateSystem.of(attrs, prefix)


def with_system(mesh: xr.Dataset, coordinate_system: str | None, unit: str | None) -> xr.Dataset:
    """Return a mesh with the given coordinate system and unit where its own are unknown."""
    if not (coordinate_system or unit):
        return mesh
    given = CoordinateSystem.of(
        {"coordinate_system": coordinate_system, "unit": check_unit(unit) if unit else ""}
    )
    return mesh.assign_attrs(CoordinateSystem.of(mesh.attrs).filled(given).attrs)


def says_nothing(mesh: xr.Dataset) -> bool:
    """Return whether a mesh in memory has neither axes nor unit; it is never converted."""
    system = CoordinateSystem.of(mesh.attrs)
    return not (system.axes or system.unit or mesh.attrs.get("path"))


def in_axes(mesh: xr.Dataset, target: CoordinateSystem, what: str = "a mesh") -> xr.Dataset:
    """Convert axes and unit of a mesh; the attribute ``reason`` records it.

    Raises ValueError if axes or unit of the mesh, or of the target, are unknown.
    """
    system = CoordinateSystem.of(mesh.attrs)
    if (system.axes, system.unit) == (target.axes, target.unit) or says_nothing(mesh):
        return mesh
    new = replace(system, axes=target.axes, unit=target.unit)
    M = map_between(system, new, what)
    image = transformed(mesh, M)
    reasons = filter(None, [mesh.attrs.get("reason"), f"converted from {system} to {new}"])
    file = file_system(mesh.attrs).attrs
    image.attrs |= {f"file_{name}": text for name, text in file.items()} | new.attrs
    image.attrs["reason"] = "; ".join(reasons)
    if "area" in mesh.attrs:
        image.attrs["area"] *= abs(np.linalg.det(M)) ** (2 / 3)
    return in_unit(image, new.unit, of=system.unit)


def in_one_system(meshes: Mapping[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """Return meshes in one system of axes and one unit, see :func:`common`."""
    said = {name: mesh for name, mesh in meshes.items() if not says_nothing(mesh)}
    target = common({name: CoordinateSystem.of(mesh.attrs) for name, mesh in said.items()})
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
    # 3D Slicer, whose unit is mm, writes SPACE into a title or comment, or into fields of VTK files
    head = data[:1000]
    found = re.findall(rb"\bSPACE=([RLAPSI]{3})\b", head)
    unit = re.search(rb"UNIT=(um|mm|cm|m|in)\b", head)
    if kind == "VTK":
        found += re.findall(rb"\nSPACE 1 1 string\r?\n[\xc3\s]*([RLAPSI]{3})\s", data)
    spaces = [space.decode() for space in found]
    if kind == "VTP" and b"SPACE" in data:
        spaces += VtkXml(data).strings("SPACE")
    axes = only("SPACE", (space for space in spaces if space in AXES))
    origin = re.search(rb" ORIGIN=(\w+)", head)
    default = "mm" if axes and b"S4A SPACE" not in head else ""
    place = origin[1].decode() if origin and axes else ""
    return CoordinateSystem(axes, place, unit[1].decode() if unit else default)


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
    return _of_volume(*(numbers[f"{axis}ras"] for axis in "xyzc"))


def surface_system(M: Any) -> CoordinateSystem:
    """Return surface RAS, or LAS if mirrored, with the map (3, 4) of its points to scanner RAS."""
    M = np.reshape(np.asarray(M, float), (3, 4))
    axes = "LAS" if np.linalg.det(M[:, :3]) < 0 else "RAS"  # of a left-handed volume: mirrored
    scale = abs(np.linalg.det(M[:, :3])) ** (1 / 3)  # 1000 for points in metres
    unit = next((unit for unit, mm in MILLIMETRES.items() if abs(scale / mm - 1) < 0.01), "mm")
    M = M / [*3 * [MILLIMETRES[unit]], 1] @ np.diag([-1 if axes == "LAS" else 1, 1, 1, 1]) + 0.0
    numbers = " ".join(map(repr, M.ravel().tolist()))
    return CoordinateSystem.of(
        {"coordinate_system": f"surface {axes}, to scanner RAS {numbers}", "unit": unit}
    )


def _of_volume(x, y, z, c):
    """Surface RAS of a volume with the directions x, y and z and the centre c."""
    # surface RAS has the axes of voxels, which it takes to be those of the conformed volume
    R = np.column_stack([x, y, z]) @ np.array([[-1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return surface_system(np.column_stack([R, c]))


def _of_gifti(data):
    """RAS in mm; the space of the points, their map to scanner RAS, or FreeSurfer's VolGeom."""
    root, maps, spaces = xml(data), {}, []
    points = root.find("DataArray[@Intent='NIFTI_INTENT_POINTSET']")
    points = root if points is None else points
    for node in points.iter("CoordinateSystemTransformMatrix"):
        texts = [node.findtext(tag) or "" for tag in ("DataSpace", "TransformedSpace")]
        here, there = (text.strip().removeprefix("NIFTI_XFORM_") for text in texts)
        spaces.append(here if here in SPACES else "")
        matrix = [float(word) for word in (node.findtext("MatrixData") or "").split()]
        maps.setdefault(SPACES.get(there), []).append(matrix)
    if space := SPACES.get(only("DataSpace", spaces)):
        # Connectome Workbench writes Talairach into every file, whatever its space
        return CoordinateSystem("RAS", UNKNOWN if space == 3 else XFORMS.get(space, ""), "mm")
    meta = {m.findtext("Name"): m.findtext("Value") for m in root.iter("MD")}
    geometry = [[meta.get(f"VolGeom{a}_{b}") for b in "RAS"] for a in "XYZC"]
    to_scanner = maps.get(1) or maps.get(2) or []
    found = [surface_system(M[:12]) for M in to_scanner if M[12:] == [0, 0, 0, 1]]
    if all(word for row in geometry for word in row):
        found.append(_of_volume(*np.array(geometry, float)))
    numbers = np.array([s.to_scanner for s in found], float)
    if len({s.axes for s in found}) == 1 and np.ptp(numbers, axis=0).max() < 1e-3:
        return found[-1]
    return CoordinateSystem("RAS", UNKNOWN, "mm")  # nothing, or several that differ
