"""GIFTI files, bytes to arrays: surfaces and labels of brains (5, the data)."""

import base64
import math

import numpy as np

from s4a.input import bounded

KINDS = {"INT": "i", "UINT": "u", "FLOAT": "f"}
INTENT, TYPE = "NIFTI_INTENT_", "NIFTI_TYPE_"


def parse_gifti(data):
    """The arrays of a GIFTI file and what they are for: a list of (intent, ndarray).

    nibabel reads these files too, and for a damaged one counts to two thousand million, unpacks
    without a limit and opens any other file that is named in it.

    Raises
    ------
    ValueError
        When an array is cut short, unpacks to too much, or lies in another file.
    """
    root, found, total = bounded.xml(data), [], 0
    if root.tag != "GIFTI":
        raise ValueError(f"GIFTI expected, found {root.tag[:40]}")
    promised = root.get("NumberOfDataArrays")
    for node in root.findall("DataArray"):
        values = _values(node, bounded.limit_of(len(data)) - total)
        total += values.nbytes
        found.append((node.get("Intent", "").removeprefix(INTENT), values))
    if promised is not None and promised.strip() != str(len(found)):
        raise ValueError(f"expected {promised[:40]} arrays, found {len(found)}")
    return found


def _values(node, limit):
    kind = node.get("DataType", "").removeprefix(TYPE)
    name = kind.rstrip("0123456789")
    if name not in KINDS or kind[len(name) :] not in ("8", "16", "32", "64"):
        raise ValueError(f"integers or floats expected, found {node.get('DataType')}")
    dtype = np.dtype(
        f"{'>' if node.get('Endian') == 'BigEndian' else '<'}{KINDS[name]}{int(kind[len(name) :]) // 8}"
    )
    shape = tuple(int(node.get(f"Dim{i}")) for i in range(6) if node.get(f"Dim{i}") is not None)
    if str(len(shape)) != node.get("Dimensionality") or not shape or min(shape) < 0:
        raise ValueError(
            f"{node.get('Dimensionality')} dimensions expected, found the sizes {shape}"
        )
    text, how = node.findtext("Data") or "", node.get("Encoding")
    if how == "ASCII":
        values = np.array(text.split(), dtype)
    elif how in ("Base64Binary", "GZipBase64Binary"):
        raw = base64.b64decode(text)
        raw = bounded.unpack(raw, "zlib", limit) if how == "GZipBase64Binary" else raw
        values = np.frombuffer(raw[: len(raw) // dtype.itemsize * dtype.itemsize], dtype)
    else:
        raise ValueError(
            f"data inside the file expected, found {how} {node.get('ExternalFileName') or ''}".rstrip()
        )
    if len(values) != math.prod(shape):
        raise ValueError(
            f"expected {math.prod(shape)} values of an array, found {len(values)}: the file is cut short"
        )
    return values.reshape(
        shape, order="F" if node.get("ArrayIndexingOrder") == "ColumnMajorOrder" else "C"
    )
