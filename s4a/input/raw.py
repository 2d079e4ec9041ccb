"""Files as bytes (5, the data): regular ones of bounded size, and containers that stay bounded.

Gzip, NPZ, NPY and XML that cannot fill the memory or run anything; names and texts as shown.
"""

import codecs
import gzip
import io
import lzma
import math
import os
import re
import stat
import xml.etree.ElementTree as ElementTree
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO
from xml.parsers import expat

import numpy as np

LARGEST_FILE = 2**31  # bytes that are read of one file: 50 million vertices and their triangles
CHUNK = 2**20  # bytes that are read at a time
_OTHER_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # of Excel or LibreOffice, new and old

_AnyPath = str | os.PathLike[str]


@contextmanager
def regular_file(path: _AnyPath) -> Iterator[BinaryIO]:
    """A regular file, open for reading.

    A pipe would let a run wait for ever, and a device fill the memory.

    Raises
    ------
    ValueError
        When it is something else, or cannot be opened or read; the file is not named.
    """
    try:
        _check_regular(os.stat(path))  # before it is opened, as that can set a device in transform
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with open(os.open(path, flags), "rb") as file:
            _check_regular(os.fstat(file.fileno()))  # something else may have come in its place
            yield file
    except OSError as error:
        if isinstance(error, FileNotFoundError) and os.path.islink(path):
            raise ValueError(
                f"a file expected, found a link to {shown(os.readlink(path))}, which is not there"
            ) from error
        raise ValueError(f"it cannot be opened or read: {error.strerror or error}") from error


def _check_regular(status):
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        raise ValueError(f"a regular file expected, found {_OTHER_KINDS.get(kind, 'another kind')}")
    _check_size(status.st_size)


def _check_size(size):
    if size > LARGEST_FILE:
        raise ValueError(
            f"a file of at most {LARGEST_FILE / 2**30:.0f} GiB expected, found a larger one"
        )


def check_there(path: _AnyPath) -> None:
    """ValueError where nothing has this name, not even a link that leads nowhere."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ValueError(f"no file {shown(path)}") from error
    except OSError:  # why it cannot be read is said when it is opened
        pass


@contextmanager
def reading(path: _AnyPath, what: str) -> Iterator[None]:
    """Whatever is wrong with a file, a ValueError that names it and `what` it was read as."""
    try:
        yield
    except Exception as error:  # whatever a file holds, it must not end the run over a collection
        why = shown(error) or type(error).__name__
        raise ValueError(f"{shown(path)} cannot be read as {what}: {why}") from error


def read_all(file: BinaryIO) -> bytes:
    """The bytes of an open file, :data:`LARGEST_FILE` at most.

    The size is looked at while it is read, as a file can grow, or say that it has no bytes.
    """
    data = io.BytesIO()
    while part := file.read(CHUNK):
        data.write(part)
        _check_size(data.tell())
    return data.getvalue()


def read_bytes(path: _AnyPath) -> bytes:
    """The bytes of a regular file; ValueError where there is none, see :func:`regular_file`."""
    with regular_file(path) as file:
        return read_all(file)


def shown(text: object) -> str:
    r"""A path or a text with what cannot be printed written as escapes.

    So that no name writes a line of its own, colours a terminal or turns the direction of writing.

    Examples
    --------
    >>> from s4a.input.raw import shown
    >>> print(shown("a.ply\nb.ply: ok"))
    a.ply\nb.ply: ok
    """
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))
    return "".join(escaped)


def text_of(data: bytes) -> str:
    """The text of a file in UTF-8, with or without a mark at its start.

    Raises
    ------
    ValueError
        When it is none; the message says what it seems to be, and what to do.

    Examples
    --------
    >>> from s4a.input.raw import text_of
    >>> text_of("shape,âge".encode("latin-1"))
    Traceback (most recent call last):
    ValueError: text in UTF-8 expected, found the byte 0xe2 in line 1: it seems to be Latin-1 or
    Windows-1252, where that is 'â'; save it as CSV UTF-8
    """
    if data.startswith(_WORKBOOKS):
        raise ValueError("text expected, found a workbook or an archive: export it as CSV UTF-8")
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or _every_other_is_nul(data):
        raise ValueError("text in UTF-8 expected, found UTF-16: save it as CSV UTF-8")
    if b"\0" in data:
        line = 1 + data[: data.index(b"\0")].count(b"\n")
        raise ValueError(
            f"text expected, found the byte 0 in line {line}: it seems to be a binary or a damaged "
            "file; export it again"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = 1 + data[: error.start].count(b"\n")
        byte = data[error.start : error.start + 1]
        raise ValueError(
            f"text in UTF-8 expected, found the byte 0x{byte.hex()} in line {line}: it seems to be "
            f"Latin-1 or Windows-1252, where that is {byte.decode('cp1252', 'replace')!r}; "
            "save it as CSV UTF-8"
        ) from error


def _every_other_is_nul(data):
    """Whether it looks like UTF-16 without a mark, of mostly Latin letters."""
    head = data[:1000]
    shares = sorted(half.count(0) / max(len(half), 1) for half in (head[::2], head[1::2]))
    return len(head) > 1 and shares[0] < 0.1 and shares[1] > 0.6


LARGEST = 2**30  # bytes that a file may unpack to: 30 million vertices and their triangles
LEAST = 2**26  # unpacked size that is never refused
_RATIO = 200  # times the size of the file that it may unpack to beyond that
_GZIP = b"\x1f\x8b"


def limit_of(size: int, least: int = LEAST) -> int:
    """Most bytes that a file of `size` bytes may unpack to; `least` are never refused.

    Examples
    --------
    >>> from s4a.input.raw import LARGEST, LEAST, limit_of
    >>> limit_of(1000) == LEAST, limit_of(10**6), limit_of(10**9) == LARGEST
    (True, 200000000, True)
    """
    return min(LARGEST, max(least, _RATIO * size))


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
    >>> from s4a.input.raw import gunzip
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
        is_packed = file.read(len(_GZIP)) == _GZIP
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
    >>> from s4a.input.raw import xml
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
    >>> from s4a.input.raw import npy
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
