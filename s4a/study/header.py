"""The header of a study's file (4): its variables and attributes as one line of JSON, in its seal.

HDF5 needs milliseconds to say what a file holds, in a hundred answers; a study of a thousand shapes
has three thousand files to open.  The header says the same in one line, written when the file is
sealed, from what HDF5 says then.  Values are taken from the bytes of the file itself.
"""

import json
import math
from io import BufferedIOBase
from typing import Any

import h5py
import numpy as np

from s4a.study.hdf5 import LARGEST_TEXT, PACKINGS, Place, StudyFile

TEXT = "text"


def header_of(file: StudyFile) -> str:
    """The header of an open file."""
    variables = {}
    for name, (begin, end, shape, dtype, filters) in file.places.items():
        is_text = file.places[name].is_text
        variables[name] = {
            "dims": file.dims(name),
            "place": [begin, end, list(shape), TEXT if is_text else dtype.str, list(filters)],
            "attrs": _encoded(file.attributes(name)),
        }
        if is_text:
            variables[name]["texts"] = file.values(name).tolist()
    return json.dumps({"variables": variables, "attrs": _encoded(file.attributes())})


def _encoded(attrs):
    """Attributes for JSON: texts as they are, numbers and arrays with their type before them."""
    found: dict[str, str | list[Any]] = {}
    for name, value in attrs.items():
        if isinstance(value, str):
            found[name] = value
        else:
            values = np.asarray(value)
            found[name] = [
                values.dtype.str if values.dtype.kind in "iufb" else TEXT,
                values.tolist(),
            ]
    return found


class Header:
    """What a header says of a file, as :class:`s4a.study.hdf5.StudyFile` does.

    OSError where that cannot be.

    Parameters
    ----------
    text : str
        Of :func:`header_of`.
    raw : binary file
        The file itself.
    """

    def __init__(self, text: str, raw: BufferedIOBase):
        self.raw = raw
        size = raw.seek(0, 2)
        said = json.loads(text)
        self._attrs = said["attrs"]
        self._variables = said["variables"]
        self.places = {name: _place(name, one, size) for name, one in self._variables.items()}

    def attributes(self, name: str = "") -> dict[str, Any]:
        """The attributes of a variable, or of the file."""
        attrs = self._variables[name]["attrs"] if name else self._attrs
        return {key: _decoded(key, value) for key, value in attrs.items()}

    def dims(self, name: str) -> list[str]:
        """Names of the dims of a variable."""
        return list(self._variables[name]["dims"])

    def values(self, name: str) -> np.ndarray:
        """The values of a variable."""
        place = self.places[name]
        if place.is_text:
            return _texts(name, self._variables[name]["texts"]).reshape(place.shape)
        return place.values(place.stored(self.raw))


def _place(name, variable, size):
    """The place of a variable; OSError where it is not within a file of `size` bytes."""
    begin, end, shape, kind, filters = variable["place"]
    shape, filters = tuple(shape), tuple(filters)
    numbers = (begin, end, *shape, *filters)
    if any(type(one) is not int or one < 0 for one in numbers) or not begin <= end <= size:
        raise OSError(f"{name} is not within its file")
    if len(variable["dims"]) != len(shape):
        raise OSError(f"{name} has no list of its dims")
    if kind == TEXT:
        return Place(begin, end, shape, h5py.string_dtype())
    dtype = np.dtype(kind)
    n_bytes = dtype.itemsize * math.prod(shape)
    if dtype.kind not in "iuf" or (filters and filters not in PACKINGS):
        raise OSError(f"{name} needs numbers or text, found {dtype}")
    if n_bytes > 1032 * (end - begin) if filters else n_bytes != end - begin:
        raise OSError(f"{name} has not all values that it should have")
    return Place(begin, end, shape, dtype, filters)


def _decoded(name, value):
    """An attribute, from what :func:`_encoded` gave; of a single number that number."""
    if isinstance(value, str):
        return value
    kind, values = value
    if kind == TEXT:
        return np.array(_texts(name, values), dtype=object)
    found = np.array(values, np.dtype(kind))
    if found.dtype.kind not in "iufb":
        raise OSError(f"the attribute {name} needs a number, a text or a list of them")
    return found if found.ndim else found[()]


def _texts(name, values):
    """Texts as an array, each as long as the longest; OSError where that needs too much memory."""
    flat = np.array(values, dtype=object)
    if not all(isinstance(one, str) for one in flat.flat):
        raise OSError(f"{name} needs texts")
    longest = max(map(len, flat.flat), default=0)
    if 4 * longest * flat.size > LARGEST_TEXT:
        raise OSError(f"{name} has more text than its file")
    return flat.astype(str)
