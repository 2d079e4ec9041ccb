"""Read untrusted files (5, the data): regular files and containers of bounded size.

Gzip, NPZ, NPY and XML are read without filling the memory or running code.
"""

import codecs
import gzip
import io
import lzma
import math
import os
import re
import stat
import warnings
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

LARGEST_FILE = 2**31  # bytes of a file: 50 million vertices and their triangles
CHUNK = 2**20  # bytes read at a time
_OTHER_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # Excel or LibreOffice, new and old

_AnyPath = str | os.PathLike[str]


@contextmanager
def regular_file(path: _AnyPath) -> Iterator[BinaryIO]:
    """Open a regular file for reading.

    Pipes, on which a run would wait, and devices, which could fill the memory, are refused.

    Raises
    ------
    ValueError
        If the path is not a regular file, or cannot be read; the message does not name the file.
    """
    try:
        _check_regular(os.stat(path))  # before opening, which can have effects on a device
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with open(os.open(path, flags), "rb") as file:
            _check_regular(os.fstat(file.fileno()))  # the path may have been replaced
            yield file
    except OSError as error:
        if isinstance(error, FileNotFoundError) and os.path.islink(path):
            raise ValueError(
                f"a file expected, found a broken link to {shown(os.readlink(path))}"
            ) from error
        raise ValueError(f"it cannot be opened or read: {error.strerror or error}") from error


def _check_regular(status):
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        raise ValueError(f"a regular file expected, found {_OTHER_KINDS.get(kind, 'another type')}")
    _check_size(status.st_size)


def _check_size(size):
    if size > LARGEST_FILE:
        raise ValueError(
            f"a file of at most {LARGEST_FILE / 2**30:.0f} GiB expected, found a larger one"
        )


def check_there(path: _AnyPath) -> None:
    """Raise ValueError if the path does not exist, not even as a broken link."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ValueError(f"no file {shown(path)}") from error
    except OSError:  # opening the file will raise the error
        pass


@contextmanager
def reading(path: _AnyPath, what: str) -> Iterator[None]:
    """Turn any error into a ValueError that names the file and `what` it was read as."""
    try:
        yield
    except Exception as error:  # no file may end the run over a collection
        missing = "expected, found none" if isinstance(error, KeyError) else ""
        why = f"{shown(error)} {missing}".strip() or type(error).__name__
        raise ValueError(f"{shown(path)} cannot be read as {what}: {why}") from error


def read_all(file: BinaryIO) -> bytes:
    """Read the bytes of an open file, at most :data:`LARGEST_FILE`.

    The size is checked while reading, as the file may grow or report a size of 0.
    """
    data = io.BytesIO()
    while part := file.read(CHUNK):
        data.write(part)
        _check_size(data.tell())
    return data.getvalue()


def read_bytes(path: _AnyPath) -> bytes:
    """Read the bytes of a regular file, or ValueError, see :func:`regular_file`."""
    with regular_file(path) as file:
        return read_all(file)


def new_folder(path: _AnyPath) -> Path:
    """Return a folder, which is made if it is missing."""
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def shown(text: object) -> str:
    r"""Escape unprintable characters of a path or a text.

    No file name can add a line, colour a terminal or change the direction of writing.

    Examples
    --------
    >>> from s4a.input.raw import shown
    >>> print(shown("a.ply\nb.ply: ok"))
    a.ply\nb.ply: ok
    """
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))
    return "".join(escaped)


def sentences(text: str, longest: int) -> str:
    """Return the sentences of a text, from the first, that fit in so many characters; one at least.

    A sentence ends with a full stop or a semicolon that is not in brackets.

    Examples
    --------
    >>> from s4a.input.raw import sentences
    >>> sentences("a is far (b; c); it was not moved. It is 3 mm away.", 35)
    'a is far (b; c); it was not moved.'
    >>> sentences("a is far (b; c); it was not moved", 9)
    'a is far (b; c)'
    """
    ends = [end.start() + 1 for end in re.finditer(r"[.;](?= (?![^(]*\)))", text)] + [len(text)]
    fitting = max([end for end in ends if end <= longest], default=ends[0])
    return text[:fitting].removesuffix(";")


def text_of(data: bytes) -> str:
    """Decode the text of a file in UTF-8, with or without a byte order mark.

    Raises
    ------
    ValueError
        If the file is not UTF-8; the message says what it seems to be, and the remedy.

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
    if is_utf_16(data):
        raise ValueError("text in UTF-8 expected, found UTF-16: save it as CSV UTF-8")
    if b"\0" in data:
        line = 1 + data[: data.index(b"\0")].count(b"\n")
        raise ValueError(
            f"text expected, found the byte 0 in line {line}: the file seems to be binary or "
            "damaged; export it again"
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


def is_utf_16(data: bytes) -> bool:
    """Return whether data seem to be UTF-16, without a mark if of mostly Latin letters."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return True
    head = data[:1000]
    shares = sorted(half.count(0) / max(len(half), 1) for half in (head[::2], head[1::2]))
    return len(head) > 1 and shares[0] < 0.1 and shares[1] > 0.6


LARGEST = 2**30  # bytes that a file may unpack to: 30 million vertices and their triangles
LEAST = 2**26  # unpacked size that is always accepted
_RATIO = 200  # largest ratio of unpacked to packed size beyond that
_GZIP = b"\x1f\x8b"


def limit_of(size: int, least: int = LEAST) -> int:
    """Largest unpacked size of a file of `size` bytes; `least` bytes are always accepted.

    Examples
    --------
    >>> from s4a.input.raw import LARGEST, LEAST, limit_of
    >>> limit_of(1000) == LEAST, limit_of(10**6), limit_of(10**9) == LARGEST
    (True, 200000000, True)
    """
    return min(LARGEST, max(least, _RATIO * size))


def check(unpacked: int, size: int, least: int = LEAST) -> None:
    """Raise ValueError if `unpacked` exceeds the :func:`limit_of` a file of `size` bytes."""
    limit = limit_of(size, least)
    if unpacked > limit:
        raise ValueError(
            f"at most {limit / 2**20:.0f} MiB expected in {size} compressed bytes, "
            "found more: unpack the file if you trust it"
        )


def gunzip(file: BinaryIO, least: int = LEAST) -> bytes:
    """Unpack a gzip file, with one or several members; ValueError if it is too large or truncated.

    The unpacked size is compared with the bytes read so far, to stop early.

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
        raise ValueError(f"the gzip data is truncated: found {file.tell()} bytes") from error
    except (OSError, zlib.error) as error:
        raise ValueError(f"damaged gzip data ({error})") from error
    return unpacked.getvalue()


def content(path: Path | str, least: int = LEAST) -> bytes:
    """Read the bytes of a regular file, and unpack them if they are gzip."""
    with regular_file(path) as file:
        is_packed = file.read(len(_GZIP)) == _GZIP
        file.seek(0)
        return gunzip(file, least) if is_packed else read_all(file)


def unpack(data: bytes, compressor: str, limit: int) -> bytes:
    """Unpack one stream of ``"zlib"`` or ``"lzma"``, at most `limit` bytes."""
    by_lzma = compressor == "lzma"
    stream: Any = lzma.LZMADecompressor(memlimit=2**28) if by_lzma else zlib.decompressobj()
    most = min(limit, limit_of(len(data)))
    unpacked = stream.decompress(data, most + 1)
    if len(unpacked) > most:
        raise ValueError(f"at most {most} bytes expected in a compressed block, found more")
    if not stream.eof:
        raise ValueError(f"a compressed block is truncated: found {len(data)} bytes")
    return unpacked


def xml(text: bytes | str) -> ElementTree.Element:
    """Parse XML and return the root; ValueError for entities, which can expand or read files.

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
    """Return a reader for each array of an NPZ archive by name; ValueError if too large."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
    check(sum(member.file_size for member in members.values()), len(data))
    return {name: partial(_read_member, archive, member) for name, member in members.items()}


def _read_member(archive, member):
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError("stored or deflated arrays expected, as NumPy writes them")
    with archive.open(member) as stream:
        return npy(stream.read(member.file_size))  # no more, even if the size is wrong


def npy(data: bytes) -> np.ndarray:
    """Read an NPY file of numbers or text, without evaluating or unpickling anything.

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
    file, npy_format = io.BytesIO(data), np.lib.format
    try:
        is_first = npy_format.read_magic(file) == (1, 0)
        read = npy_format.read_array_header_1_0 if is_first else npy_format.read_array_header_2_0
        with warnings.catch_warnings(action="ignore"):  # of headers that Python 2 wrote
            shape, by_column, dtype = read(file)
    except Exception as error:  # also MemoryError, and advice to programmers
        raise ValueError(
            f"an array as numpy.save writes it expected, found {data[:100]!r}; export it again"
        ) from error
    if dtype.kind not in "biufU":
        raise ValueError(
            "an array of numbers or text expected, found "
            + ("pickled Python objects, which are not read" if dtype.hasobject else f"{dtype}")
        )
    needed, left = math.prod(shape) * dtype.itemsize, len(data) - file.tell()
    if not dtype.itemsize or min(shape, default=0) < 0 or needed > left:
        raise ValueError(f"{needed} bytes of {dtype} expected for the shape {shape}, found {left}")
    values = np.frombuffer(data, dtype, math.prod(shape), file.tell())
    return values.reshape(shape, order="F" if by_column else "C").copy()
