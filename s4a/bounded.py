"""Decompression that cannot fill the memory: a small file may unpack to anything (5, the data)."""

import base64
import lzma
import re
import zlib

LARGEST = 2**30  # bytes that a file may unpack to: 30 million vertices and their triangles
LEAST, RATIO = 2**26, 200  # unpacked size that is never refused, and how many times the size of the file beyond it
GZIP, DEFLATE_RATIO = b"\x1f\x8b", 1032  # no stream of deflate unpacks to more than so many times its size


def limit_of(size):
    """Most bytes that a file of `size` bytes may unpack to.

    Examples
    --------
    >>> limit_of(1000) == LEAST, limit_of(10**6), limit_of(10**9) == LARGEST
    (True, 200000000, True)
    """
    return min(LARGEST, max(LEAST, RATIO * size))


def check(unpacked, size):
    """ValueError when `unpacked` bytes are more than a file of `size` bytes may hold."""
    if unpacked > limit_of(size):
        raise ValueError(
            f"at most {limit_of(size) / 2**20:.0f} MiB expected in {size} compressed bytes, found more: "
            "unpack the file yourself if you trust it"
        )


def gunzip(data):
    """The bytes of a gzip file (several members too), or ValueError where they are too many or end early.

    Examples
    --------
    >>> import gzip
    >>> gunzip(gzip.compress(b"ply") + gzip.compress(b" format"))
    b'ply format'
    """
    parts, found, rest = [], 0, data
    while rest.startswith(GZIP):
        stream = zlib.decompressobj(wbits=31)
        try:
            part = stream.decompress(rest, limit_of(len(data)) + 1 - found)
        except zlib.error as error:
            raise ValueError(f"damaged gzip data ({error})") from error
        found += len(part)
        check(found, len(data))
        if not stream.eof:
            raise ValueError(f"the gzip data ends early: found {len(data)} bytes, which unpack to {found} so far")
        parts.append(part)
        rest = stream.unused_data
    return b"".join(parts)


def unpack(data, compressor, limit):
    """The bytes of one stream, `limit` at most: of ``"zlib"`` or ``"lzma"``."""
    makers = {"zlib": zlib.decompressobj, "lzma": lzma.LZMADecompressor}
    found = makers[compressor]().decompress(data, max(limit, 0) + 1)
    if len(found) > limit:
        raise ValueError(f"at most {limit} bytes expected in a compressed block, found more")
    return found


def check_zlib_blocks(data):
    """ValueError when the base64 blocks of zlib in an XML file unpack to more than it may hold."""
    size, found = len(data), 0
    if size * DEFLATE_RATIO <= limit_of(size):
        return
    for block in re.finditer(rb"<Data>\s*([A-Za-z0-9+/=\s]+?)\s*</Data>", data):
        stream, rest = zlib.decompressobj(), _decoded(block[1])
        while rest:
            try:
                found += len(stream.decompress(rest, 2**20))
            except zlib.error:  # its reader will say so
                break
            check(found, size)
            rest = stream.unconsumed_tail


def _decoded(text):
    try:
        return base64.b64decode(text)
    except ValueError:
        return b""
