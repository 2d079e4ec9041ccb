"""Files as bytes (5, the data): regular ones only, of bounded size; names and texts as shown."""

import codecs
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

LARGEST_FILE = 2**31  # bytes that are read of one file: 50 million vertices and their triangles
CHUNK = 2**20  # bytes that are read at a time
OTHER_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}
WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # of Excel or LibreOffice, new and old

AnyPath = str | os.PathLike[str]


@contextmanager
def regular_file(path: AnyPath) -> Iterator[BinaryIO]:
    """A regular file, open for reading.

    A pipe would let a run wait for ever, and a device fill the memory.

    Raises
    ------
    ValueError
        When it is something else, or cannot be opened or read; the file is not named.
    """
    try:
        _check_regular(os.stat(path))  # before it is opened, as that can set a device in motion
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
        raise ValueError(f"a regular file expected, found {OTHER_KINDS.get(kind, 'another kind')}")
    _check_size(status.st_size)


def _check_size(size):
    if size > LARGEST_FILE:
        raise ValueError(
            f"a file of at most {LARGEST_FILE / 2**30:.0f} GiB expected, found a larger one"
        )


def check_there(path: AnyPath) -> None:
    """ValueError where nothing has this name, not even a link that leads nowhere."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ValueError(f"no file {shown(path)}") from error
    except OSError:  # why it cannot be read is said when it is opened
        pass


def read_all(file: BinaryIO) -> bytes:
    """The bytes of an open file, :data:`LARGEST_FILE` at most.

    The size is looked at while it is read, as a file can grow, or say that it has no bytes.
    """
    data = io.BytesIO()
    while part := file.read(CHUNK):
        data.write(part)
        _check_size(data.tell())
    return data.getvalue()


def read_bytes(path: AnyPath) -> bytes:
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
    if data.startswith(WORKBOOKS):
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
