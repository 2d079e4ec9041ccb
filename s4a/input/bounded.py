"""Containers that cannot fill the memory or run anything: gzip, NPZ, NPY, XML (5, the data)."""

import gzip
import io
import lzma
import math
import re
import xml.etree.ElementTree as ElementTree
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO
from xml.parsers import expat

import numpy as np

from s4a.input.raw import CHUNK, read_all, regular_file

LARGEST = 2**30  # bytes that a file may unpack to: 30 million vertices and their triangles
LEAST = 2**26  # unpacked size that is never refused
RATIO = 200  # times the size of the file that it may unpack to beyond that
GZIP = b"\x1f\x8b"


def limit_of(size: int, least: int = LEAST) -> int:
    """Most bytes that a file of `size` bytes may unpack to; `least` are never refused.

    Examples
    --------
    >>> from s4a.input.bounded import LARGEST, LEAST, limit_of
    >>> limit_of(1000) == LEAST, limit_of(10**6), limit_of(10**9) == LARGEST
    (True, 200000000, True)
    """
    return min(LARGEST, max(least, RATIO * size))


def check(unpacked: int, size: int, least: int = LEAST) -> None:
    """ValueError when `unpacked` bytes are more than a file of `size` bytes may hold."""
    limit = limit_of(size, least)
    if unpacked > limit:
        raise ValueError(
            f"at most {limit / 2**20:.0f} MiB expected in {size} compressed bytes, "
            "found more: unpack the file yourself if you trust it"
        )


def gunzip(file: BinaryIO, least: int = LEAST) -> bytes:
    """The bytes of a gzip file (several members too); ValueError if too many, or it ends early.

    What was unpacked is held against what was read for it so far, so that little memory is taken
    before too much is refused.

    Examples
    --------
    >>> import gzip
    >>> import io
    >>> from s4a.input.bounded import gunzip
    >>> gunzip(io.BytesIO(gzip.compress(b"ply") + gzip.compress(b" format")))
    b'ply format'
    """
    unpacked = io.BytesIO()
    try:
        with gzip.GzipFile(fileobj=file) as stream:
            while part := stream.read(CHUNK):
                unpacked.write(part)
                check(unpacked.tell(), file.tell(), least)
    except EOFError as error:
        raise ValueError(f"the gzip data ends early: found {file.tell()} bytes") from error
    except (OSError, zlib.error) as error:
        raise ValueError(f"damaged gzip data ({error})") from error
    return unpacked.getvalue()


def content(path: Path | str, least: int = LEAST) -> bytes:
    """The bytes of a regular file, unpacked where it is compressed by gzip."""
    with regular_file(path) as file:
        is_packed = file.read(len(GZIP)) == GZIP
        file.seek(0)
        return gunzip(file, least) if is_packed else read_all(file)


def unpack(data: bytes, compressor: str, limit: int) -> bytes:
    """The bytes of one stream, `limit` at most: of ``"zlib"`` or ``"lzma"``."""
    by_lzma = compressor == "lzma"
    stream: Any = lzma.LZMADecompressor(memlimit=2**28) if by_lzma else zlib.decompressobj()
    unpacked = io.BytesIO()
    step = 2**16  # bytes that are taken in at a time
    for start in range(0, len(data), step):
        part, packed = b"", data[start : start + step]
        while packed or len(part) == CHUNK:  # there may be more of what was taken in
            part = stream.decompress(packed, CHUNK)
            packed = b"" if by_lzma else stream.unconsumed_tail
            unpacked.write(part)
            most = min(limit, limit_of(min(start + step, len(data))))
            if unpacked.tell() > most:
                raise ValueError(f"at most {most} bytes expected in a compressed block, found more")
            if stream.eof:
                return unpacked.getvalue()
    raise ValueError(f"a compressed block ends early: found {len(data)} bytes")


def xml(text: bytes | str) -> ElementTree.Element:
    """The root of an XML file; ValueError for entities, which could grow or name other files.

    Examples
    --------
    >>> from s4a.input.bounded import xml
    >>> xml('<!DOCTYPE a SYSTEM "a.dtd"><a b="1"/>').get("b")
    '1'
    >>> xml('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>')
    Traceback (most recent call last):
    ValueError: an XML file without entities expected, found a declaration of 'b'
    """

    def refuse(name, *_):
        raise ValueError(
            f"an XML file without entities expected, found a declaration of {name[:40]!r}"
        )

    parser = expat.ParserCreate()
    parser.EntityDeclHandler = refuse
    parser.Parse(text, True)
    return ElementTree.fromstring(text)


def npz(data: bytes) -> dict[str, Callable[[], np.ndarray]]:
    """The arrays of an NPZ archive: their names, and for each a function that reads it.

    ValueError where it holds too much.
    """
    archive = zipfile.ZipFile(io.BytesIO(data))
    members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
    check(sum(member.file_size for member in members.values()), len(data))
    return {name: partial(_read_member, archive, member) for name, member in members.items()}


def _read_member(archive, member):
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("arrays expected that are stored or deflated, as NumPy writes them")
    with archive.open(member) as stream:
        return npy(stream.read(member.file_size))  # no more, even where the archive lies about it


NPY = re.compile(
    rb"\{ *'descr': *'([<>|=]?[biufU]\d{1,9})', *'fortran_order': *(True|False), *"
    rb"'shape': *\(([\d, ]{0,400})\),? *\}\s*"
)


def npy(data: bytes) -> np.ndarray:
    """The array of a NPY file of numbers or text; nothing in the file is evaluated or unpickled.

    Examples
    --------
    >>> import io
    >>> import numpy as np
    >>> from s4a.input.bounded import npy
    >>> out = io.BytesIO()
    >>> np.save(out, np.array([[1, 2], [3, 4]], order="F"))
    >>> npy(out.getvalue()).tolist()
    [[1, 2], [3, 4]]
    """
    if not data.startswith(b"\x93NUMPY") or data[6:8] not in (b"\1\0", b"\2\0"):
        raise ValueError("an array of NumPy's format 1.0 or 2.0 expected, found something else")
    width = 2 * data[6]
    start = 8 + width + int.from_bytes(data[8 : 8 + width], "little")
    header = NPY.fullmatch(data, 8 + width, start)
    if not header:
        text = data[8 + width : start].strip()[:100]
        raise ValueError(
            "an array of numbers or text expected, and no pickled objects; "
            f"found the header {text!r}"
        )
    dtype = np.dtype(header[1].decode())
    shape = tuple(int(size) for size in header[3].split(b",") if size.strip())
    needed, left = math.prod(shape) * dtype.itemsize, len(data) - start
    if dtype.itemsize == 0 or needed > left:
        raise ValueError(f"{needed} bytes of {dtype} expected for the shape {shape}, found {left}")
    values = np.frombuffer(data, dtype, math.prod(shape), start)
    return values.reshape(shape, order="F" if header[2] == b"True" else "C").copy()
