"""What is read of a study's file (4), and what is refused: the one place where HDF5 is asked.

HDF5 follows links into other files, takes values from them (external storage, virtual datasets),
unpacks what was stored small, and repeats a text as often as it is told.  A study may be of a
stranger: its files have variables alone, and the values of each are some of the file's own bytes.
That is asked before anything else is, with the low-level functions of h5py, which take a third of
the time.
"""

import zlib
from io import BufferedIOBase
from typing import Any, NamedTuple

import h5py
import numpy as np
from h5py import h5a, h5d, h5l, h5o, h5r, h5t, h5z

# how numbers may be packed: by zlib, or shuffled before it
PACKINGS = {(h5z.FILTER_DEFLATE,), (h5z.FILTER_SHUFFLE, h5z.FILTER_DEFLATE)}
LARGEST_TEXT = 2**31  # bytes of memory that the texts of a variable or an attribute may need
# attributes with which HDF5 and netCDF keep account of dimensions
DIMS, SCALE = "DIMENSION_LIST", "CLASS"
ACCOUNTS = {
    DIMS,
    SCALE,
    "NAME",
    "REFERENCE_LIST",
    "_NCProperties",
    "_Netcdf4Coordinates",
    "_Netcdf4Dimid",
}


class Place(NamedTuple):
    """Where the values of a variable are: in the bytes of its file from `begin` to `end`."""

    begin: int
    end: int
    shape: tuple[int, ...]
    dtype: np.dtype
    filters: tuple[int, ...] = ()  # by which they were packed, as one whole

    @property
    def is_text(self) -> bool:
        """Whether there are texts, of which the bytes only say where they are."""
        return h5py.check_string_dtype(self.dtype) is not None

    def stored(self, raw: BufferedIOBase) -> bytearray:
        """The bytes of the file."""
        data = bytearray(self.end - self.begin)
        raw.seek(self.begin)
        if raw.readinto(data) != len(data):
            raise OSError("it is shorter than it was")
        return data

    def values(self, data: bytearray) -> np.ndarray:
        """The values of these bytes; they have to be numbers."""
        if h5z.FILTER_DEFLATE in self.filters:
            n_bytes = self.dtype.itemsize * int(np.prod(self.shape))
            data = bytearray(zlib.decompressobj().decompress(data, n_bytes + 1))
            if len(data) != n_bytes:
                raise OSError("it unpacks to another size than it should")
        if h5z.FILTER_SHUFFLE in self.filters:  # all first bytes, then all second ones, ...
            data = bytearray(np.frombuffer(data, np.uint8).reshape(self.dtype.itemsize, -1).T)
        return np.frombuffer(data, self.dtype).reshape(self.shape)


class StudyFile:
    """The variables of an HDF5 file, each of which is within its bytes; OSError if one is not.

    Parameters
    ----------
    file : h5py.File
    raw : binary file
        The same, for its bytes.

    Attributes
    ----------
    places : dict of str to Place
        Of every variable.
    """

    def __init__(self, file: h5py.File, raw: BufferedIOBase):
        self.file, self.raw = file, raw
        size = raw.seek(0, 2)
        self._stored: dict[str, h5d.DatasetID] = {}
        self.places: dict[str, Place] = {}
        for encoded in file.id:
            name = encoded.decode()
            if file.id.links.get_info(encoded).type != h5l.TYPE_HARD:
                raise OSError(f"{name} is a link, and links are not followed")
            stored = h5o.open(file.id, encoded)
            if not isinstance(stored, h5d.DatasetID):
                raise OSError(f"{name} is no variable")
            place = place_of(name, stored, size)
            if place:
                self._stored[name], self.places[name] = stored, place
        # bytes that are left for texts and attributes
        self.room = size - sum(place.end - place.begin for place in self.places.values())

    def attributes(self, name: str = "") -> dict[str, Any]:
        """The attributes of a variable, or of the file."""
        stored = self._stored[name] if name else self.file.id
        attrs = {}
        for i in range(h5a.get_num_attrs(stored)):
            attribute = h5a.open(stored, index=i)
            key = attribute.name.decode()
            if key not in ACCOUNTS:
                attrs[key] = value_of(attribute, self.room)
        return attrs

    def dims(self, name: str) -> list[str]:
        """Names of the dims of a variable."""
        stored = self._stored[name]
        if not h5a.exists(stored, DIMS.encode()):
            return [name] if h5a.exists(stored, SCALE.encode()) else []
        attribute = h5a.open(stored, DIMS.encode())
        each = h5py.check_vlen_dtype(attribute.dtype)  # references, one list for each axis
        is_list = h5py.check_ref_dtype(each) is h5py.Reference
        if not is_list or attribute.shape != (len(self.places[name].shape),):
            raise OSError(f"{name} has no list of its dims")
        lists = np.empty(attribute.shape, attribute.dtype)
        attribute.read(lists, mtype=h5t.py_create(attribute.dtype))
        found = [h5r.get_name(refs[0], self.file.id) for refs in lists]
        if None in found:
            raise OSError(f"{name} has a dim that is not in its file")
        return [dim.decode().lstrip("/") for dim in found]

    def values(self, name: str) -> np.ndarray:
        """The values of a variable."""
        place = self.places[name]
        if not place.is_text:
            return place.values(place.stored(self.raw))
        self._check_texts(name, place)
        return np.array(h5py.Dataset(self._stored[name]).asstr()[()], str)

    def _check_texts(self, name, place):
        # of each text a length of 4 bytes, and a place of 12 that others may have too
        self.raw.seek(place.begin)
        pointers = np.frombuffer(self.raw.read(place.end - place.begin), "<u4")
        lengths = pointers[::4] if place.dtype.hasobject else np.array([place.dtype.itemsize])
        longest, n = int(lengths.max(initial=0)), int(np.prod(place.shape))
        # NumPy gives each the length of the longest, 4 bytes a letter
        if int(lengths.sum(dtype=np.int64)) > self.room or 4 * longest * n > LARGEST_TEXT:
            raise OSError(f"{name} has more text than its file")


def place_of(name: str, stored: h5d.DatasetID, size: int) -> Place | None:
    """Where the values of a variable are in a file of `size` bytes.

    None for a dimension without a coordinate, which has no values.
    """
    plan, dtype = stored.get_create_plist(), stored.dtype
    if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
        raise OSError(f"{name} takes its values from other files, which are not read")
    text = h5py.check_string_dtype(dtype)
    if not text and dtype.kind not in "iuf":
        raise OSError(f"{name} needs numbers or text, found {dtype}")
    if plan.get_layout() != h5d.CONTIGUOUS or plan.get_nfilters():
        return packed_place_of(name, stored, size)
    begin, n_bytes = stored.get_offset(), stored.get_storage_size()
    if n_bytes == 0 and h5a.exists(stored, SCALE.encode()):
        return None
    shape = stored.shape
    width = 16 if text and text.length is None else dtype.itemsize
    expected = -1 if shape is None else width * int(np.prod(shape, dtype=object))
    if n_bytes != expected or (begin or 0) + n_bytes > size:
        raise OSError(f"{name} has not all values that it should have")
    return Place(begin or 0, (begin or 0) + n_bytes, shape, dtype)


def packed_place_of(name: str, stored: h5d.DatasetID, size: int) -> Place:
    """:func:`place_of` for numbers that were packed as one whole, by zlib or shuffled before it.

    Deflate packs at most 1032 to 1: a file that says more is refused before memory is asked for.
    """
    plan, shape, dtype = stored.get_create_plist(), stored.shape, stored.dtype
    filters = tuple(plan.get_filter(i)[0] for i in range(plan.get_nfilters()))
    whole = plan.get_layout() == h5d.CHUNKED and plan.get_chunk() == shape
    if (
        dtype.kind not in "iuf"
        or not whole
        or filters not in PACKINGS
        or stored.get_num_chunks() != 1
    ):
        raise OSError(f"{name} is packed in another way than variables of a study are")
    chunk = stored.get_chunk_info(0)
    begin, end = chunk.byte_offset, chunk.byte_offset + chunk.size
    n_bytes = dtype.itemsize * int(np.prod(shape, dtype=object))
    if chunk.filter_mask or end > size or n_bytes > 1032 * chunk.size:
        raise OSError(f"{name} has not all values that it should have")
    return Place(begin, end, shape, dtype, filters)


def value_of(attribute: h5a.AttrID, room: int) -> Any:
    """The value of an attribute: a number, a text, or an array of them.

    HDF5 makes arrays of single numbers; here they are numbers again.
    """
    name, shape, dtype = attribute.name.decode(), attribute.shape, attribute.dtype
    text = h5py.check_string_dtype(dtype)
    if shape is None or len(shape) > 1 or (not text and dtype.kind not in "iufb"):
        raise OSError(f"the attribute {name} needs a number, a text or a list of them")
    n = int(np.prod(shape, dtype=object))
    # each of its texts may be as long as all there is
    if n * dtype.itemsize > room or (text and n > 1 and n * room > LARGEST_TEXT):
        raise OSError(f"the attribute {name} is larger than its file")
    values = np.empty(shape, dtype)
    attribute.read(values, mtype=h5t.py_create(dtype))
    if dtype.hasobject:
        texts = [value.decode("utf-8", "surrogateescape") for value in values.flat]
        values = np.array(texts, dtype=object).reshape(shape)
    if n != 1:
        return values
    return values.item() if text else values.reshape(-1)[0]
