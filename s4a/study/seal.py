"""The seal of a study's files (4): checksums of all their bytes.

Behind its HDF5, which ends where it says and is read by any program, a file has lines of text::

    s4a seal, CRC-32 of bytes from, to:
    "" 0 6021205 5d41402a
    "position" 9522 2409522 0b7c1f3e
    {"variables": {"position": {"dims": ["vertex", "xyz"], ...}}, "attrs": {"unit": "mm", ...}}
    00000101 8c2f90aa s4a seal

The line without a name is for all bytes that no other line names: what HDF5 says of the variables,
attributes and small variables.  They are checked when the file is opened, before HDF5 sees them; a
larger variable is checked whenever it is read.  The line in braces is the header, see
:mod:`s4a.study.header`.  The last line has the length of those before it, and their own checksum.
"""

import json
import math
import os
import stat
import zlib
from collections.abc import Iterable, Iterator
from io import BufferedIOBase, BufferedReader
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from s4a.study.hdf5 import Place, StudyFile
from s4a.study.header import header_of

HEAD = b"\ns4a seal, CRC-32 of bytes from, to:\n"
FOOT = b"s4a seal\n"
LAST = len(b"00000101 8c2f90aa ") + len(FOOT)
# attribute of a sealed file: where it stands and the seal does not, that was cut off
SEALED = "checksums"
BEHIND = "behind the HDF5 of this file"
SMALL = 1000  # numbers up to which a variable is read when its file is opened


class Part(NamedTuple):
    """Bytes of a file from `begin` to `end`, and their checksum."""

    begin: int
    end: int
    checksum: int


class Seal(NamedTuple):
    """The seal of a file: of its larger variables by name, and of all other bytes; its header.

    The header is empty where the file was written before there were any.
    """

    rest: Part
    parts: dict[str, Part]
    header: str = ""


def open_regular(path: Path | str) -> BufferedReader:
    """Open a file of a study to read its bytes; OSError for links, pipes, devices and folders.

    A study may be of a stranger: a link in it could lead to any file of this machine, and a pipe
    is never read to its end.
    """
    if os.path.islink(path):
        raise OSError("a symbolic link, which is not followed within a study")
    flags = os.O_RDONLY
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"):
        flags |= getattr(os, name, 0)
    number = os.open(path, flags)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError("not a regular file")
    return open(number, "rb")


# ---- seals


def is_larger(place: Place) -> bool:
    """Whether a variable is read only when it is used, and has a line of its own in the seal."""
    return not place.is_text and math.prod(place.shape) > SMALL


def add_seal(whole: BufferedIOBase) -> None:
    """Write the seal behind an HDF5 file in a buffer."""
    with h5py.File(whole, "r") as file:
        found = StudyFile(file, whole)
        places, header = found.places, header_of(found)
    ends = {name: (place.begin, place.end) for name, place in places.items() if is_larger(place)}
    parts = {name: Part(own[0], own[1], checksum(whole, [own])) for name, own in ends.items()}
    end = whole.seek(0, os.SEEK_END)
    rest = Part(0, end, checksum(whole, gaps(parts, end)))
    lines = [
        f"{json.dumps(name)} {begin} {end} {found:08x}\n"
        for name, (begin, end, found) in {"": rest, **parts}.items()
    ]
    text = HEAD + "".join([*lines, header, "\n"]).encode()
    whole.seek(0, os.SEEK_END)
    whole.write(text + f"{len(text):08d} {zlib.crc32(text):08x} ".encode() + FOOT)


def gaps(parts: dict[str, Part], end: int) -> Iterator[tuple[int, int]]:
    """From and to which byte a file of `end` bytes belongs to none of its parts."""
    at = 0
    for part in sorted(parts.values()):
        yield at, part.begin
        at = part.end
    yield at, end


def checksum(file: BufferedIOBase, stretches: Iterable[tuple[int, int]]) -> int:
    """The CRC-32 of stretches of a file, one after the other."""
    found = 0
    for begin, end in stretches:
        file.seek(begin)
        while begin < end:
            data = file.read(min(end - begin, 2**22))
            if not data:
                raise OSError("it is shorter than it was")
            found = zlib.crc32(data, found)
            begin += len(data)
    return found


def read_seal(file: BufferedIOBase) -> Seal | None:
    """The seal of a file; None where it has none.  OSError where the seal itself is damaged."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - LAST, 0))
    last = file.read()
    if not last.endswith(FOOT):
        return None
    length, expected, _ = last.split(maxsplit=2)
    begin = size - LAST - int(length)
    file.seek(max(begin, 0))
    text = file.read(int(length))
    if begin < 0 or f"{zlib.crc32(text):08x}" != expected.decode() or not text.startswith(HEAD):
        raise OSError("its seal is damaged")
    parts, header = {}, ""
    for line in text.removeprefix(HEAD).decode().splitlines():
        if line.startswith("{"):
            header = line
            continue
        name, *ends, found = line.rsplit(" ", 3)
        parts[json.loads(name)] = Part(int(ends[0]), int(ends[1]), int(found, 16))
    rest = parts.pop("")
    if rest.end != begin or any(not 0 <= a <= b <= begin for a, b, _ in parts.values()):
        raise OSError("its seal is of another file")
    return Seal(rest, parts, header)


def check_rest(file: BufferedIOBase, seal: Seal) -> None:
    """OSError where a byte has changed that belongs to no larger variable."""
    if checksum(file, gaps(seal.parts, seal.rest.end)) != seal.rest.checksum:
        raise OSError("its bytes are not those that were written")


def check_parts(file: BufferedIOBase, seal: Seal, names: Iterable[str]) -> None:
    """OSError where a byte has changed in a larger variable of these names."""
    for name in names:
        part = seal.parts.get(name)
        if part and checksum(file, [part[:2]]) != part.checksum:
            raise OSError(f"the bytes of {name} are not those that were written")


def read_part(file: BufferedIOBase, seal: Seal | None, name: str, place: Place) -> np.ndarray:
    """Read a larger variable; OSError where its bytes have changed, if the file has a seal."""
    data = place.stored(file)
    if seal and zlib.crc32(data) != seal.parts[name].checksum:
        raise OSError(f"the bytes of {name} are not those that were written")
    return place.values(data)
