"""Damaged files for every reader, 20,000 a format: ``python tests/fuzz.py --files 20000``.

Files are read, meshes cleaned and surfaces that are none remeshed, in a child process with a limit
of memory and of processor time.  A failure is: the process dies, a file takes over 5 s or more
memory than the limit, another exception than a ValueError that names the file leaves the reader, or
a warning does.  File i of a format is always the same: ``--only FORMAT --first i --files 1`` reads
it again, ``--keep FOLDER`` keeps the failing ones.
"""

import argparse
import base64
import functools
import gzip
import io
import json
import logging
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 5  # of processor time for one file
PATIENCE = 60  # of the clock, for a process that waits
MEMORY = 2 << 30  # above what the process has before it reads
WORDS = [
    b"nan", b"-nan", b"inf", b"-inf", b"-1", b"0", b"1e999", b"1e308", b"-1e308", b"1e-320",
    b"2147483647", b"2147483648", b"-2147483649", b"4294967296", b"9223372036854775807",
    b"-9223372036854775808", b"18446744073709551616", b"1e15", b"1000000000", b"0x10", b"1_0",
    b"1.5", b"", b"abc",
    b"7" * 400, b"1" * 5000, "٣".encode(), b"\0", b"3.", b"--1",
]  # fmt: skip
INTEGERS = [
    0, 1, -1, 2, 3, 127, 128, 255, 256, 32767, 65535, 10**6, 10**8, 2**31 - 1, -(2**31), 2**32 - 1,
    2**62, -(2**63),
]  # fmt: skip
TOKENS = [
    b"<", b">", b"&x;", b"&#0;", b"<![CDATA[", b"<!--", b"]]>", b"\"", b"'", b"\n", b"\r", b"\n\n",
    b"\\\n", b"#", b",", b"[", b"{", b"}", b":", b"null", b"\xff\xfe", b"\xef\xbb\xbf",
    b"PK\x03\x04", b"\x1f\x8b", b"solid ", b"\nf 1 2 3\n", b"\nend_header\n", b"<Data>",
    b"</DataArray>", b"\nPOLYGONS 1 4\n", b"\nMETADATA\n", b"\nFIELD a 1\n", b"=", b"==",
    b"object", b"(),",
]  # fmt: skip


# valid files


@functools.cache
def surface():
    """A small closed surface: 18 vertices, 32 triangles."""
    import numpy as np

    X = np.array(
        [
            [x, y, z]
            for x in (-1, 0, 1)
            for y in (-1, 0, 1)
            for z in (-1, 0, 1)
            if 0 < abs(x) + abs(y) + abs(z) < 3
        ]
    )
    X = X / np.linalg.norm(X, axis=1, keepdims=True) * [1.0, 1.5, 2.0]
    from scipy.spatial import ConvexHull

    return X, ConvexHull(X).simplices


def made(write, name="file"):
    """The bytes that a function writes to a path."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def packed(members):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(
                zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED
            )  # without the time of the day
    return out.getvalue()


def zipped(data):
    return gzip.compress(data, mtime=0)


def npy(array):
    import numpy as np

    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def whole(data):
    return data


def seeds():
    """format -> (suffix, reader, [(bytes to damage, what makes a file of them)])."""
    import nibabel
    import numpy as np

    from s4a.input.files import WRITERS

    X, T = surface()
    label = np.arange(len(X)) % 3

    def ply(order):
        head = (
            f"ply\nformat {order} 1.0\nelement vertex {len(X)}\nproperty float x\n"
            "property float y\nproperty float z\n"
        )
        head += (
            f"property uchar red\nelement face {len(T)}\nproperty list uchar int vertex_indices\n"
            "end_header\n"
        )
        if order == "ascii":
            rows = [
                *(f"{x} {y} {z} 7" for x, y, z in X),
                *("3 " + " ".join(map(str, t)) for t in T),
            ]
            return (head + "\n".join(rows) + "\n").encode()
        end = "<" if "little" in order else ">"
        vertex, face = (
            np.zeros(len(X), [("x", end + "f4", 3), ("red", "u1")]),
            np.zeros(len(T), [("n", "u1"), ("v", end + "i4", 3)]),
        )
        vertex["x"], face["n"], face["v"] = X, 3, T
        return head.encode() + vertex.tobytes() + face.tobytes()

    mz3 = b"MZ" + np.array([3], "<u2").tobytes() + np.array([len(T), len(X), 0], "<u4").tobytes()
    mz3 += T.astype("<i4").tobytes() + X.astype("<f4").tobytes()
    ends = " ".join(str(3 * i + 3) for i in range(len(T)))

    def vtk(kind, cells):
        return f"# vtk DataFile Version 3.0\na\n{kind}\nDATASET POLYDATA\n{cells}"

    numbers = "\n".join(" ".join(map(str, x)) for x in X)
    corners = "\n".join("3 " + " ".join(map(str, t)) for t in T)
    flat = " ".join(map(str, T.ravel()))
    offsets = " ".join(str(3 * i) for i in range(len(T) + 1))
    field = "METADATA\nINFORMATION 0\n\nFIELD a 1\nb 1 2 float\n1 2\n"
    vtk4 = vtk(
        "ASCII",
        f"{field}POINTS {len(X)} float\n{numbers}\nPOLYGONS {len(T)} {4 * len(T)}\n{corners}\n"
        f"POINT_DATA {len(X)}\n",
    )
    vtk5 = vtk(
        "ASCII",
        f"POINTS {len(X)} double\n{numbers}\nPOLYGONS {len(T) + 1} {T.size}\n"
        f"OFFSETS vtktypeint64\n{offsets}\nCONNECTIVITY vtktypeint64\n{flat}\n",
    )
    solid = "".join(
        " facet normal 0 0 0\n  outer loop\n"
        + "".join(f"   vertex {x} {y} {z}\n" for x, y, z in X[t])
        + "  endloop\n endfacet\n"
        for t in T
    )
    obj = (
        "".join(f"v {x} {y} {z}\n" for x, y, z in X)
        + "vt 0 0\n"
        + "".join(f"f {a}/1 {b}//2 {c}/1/1\n" for a, b, c in T[:-2] + 1)
    )
    mni = f"P 0.3 0.3 0.4 10 1 {len(X)}\n{numbers}\n\n{numbers}\n\n {len(T)}\n 0 1 1 1 1\n\n"
    mni += f"{ends}\n\n{flat}\n"
    obj += "".join(f"f {a} {b} {c}\n" for a, b, c in T[-2:] - len(X))

    def vtp(how, compressed=False, size="u4"):
        blob = b""

        def encoded(values):
            raw = values.tobytes()
            if not compressed:
                return [np.array([len(raw)], "<" + size).tobytes() + raw]
            blocks = [zlib.compress(raw[i : i + 256]) for i in range(0, len(raw), 256)]
            return [
                np.array(
                    [len(blocks), 256, len(raw) % 256, *map(len, blocks)], "<" + size
                ).tobytes(),
                b"".join(blocks),
            ]

        def array(name, values, kind):
            nonlocal blob
            tag = f'<DataArray type="{kind}" Name="{name}" format='
            if how == "ascii":
                return f'{tag}"ascii">{" ".join(map(str, values.ravel()))}</DataArray>'
            if how == "binary":
                content = b"".join(map(base64.b64encode, encoded(values))).decode()
                return f'{tag}"binary">{content}</DataArray>'
            offset = len(blob)
            blob += b"".join(
                encoded(values) if how == "raw" else map(base64.b64encode, encoded(values))
            )
            return f'{tag}"appended" offset="{offset}"/>'

        attributes = ' compressor="vtkZLibDataCompressor"' if compressed else ""
        attributes += ' header_type="UInt64"' if size == "u8" else ""
        text = (
            '<?xml version="1.0"?>\n'
            f'<VTKFile type="PolyData" byte_order="LittleEndian"{attributes}><PolyData>'
        )
        points, corners = X.astype("<f4"), T.astype("<i4")
        text += f'<Piece NumberOfPoints="{len(X)}" NumberOfPolys="{len(T)}">'
        text += (
            f"<Points>{array('Points', points, 'Float32')}</Points>"
            f"<Polys>{array('connectivity', corners, 'Int32')}"
        )
        text += array("offsets", np.arange(3, T.size + 1, 3, dtype="<i8"), "Int64")
        text += "</Polys></Piece></PolyData>"
        if blob:
            return (
                f'{text}<AppendedData encoding="{how}">\n_'.encode()
                + blob
                + b"\n</AppendedData></VTKFile>"
            )
        return (text + "</VTKFile>").encode()

    def gifti(encoding, *arrays):
        darrays = [
            nibabel.gifti.GiftiDataArray(values, f"NIFTI_INTENT_{intent}", encoding=encoding)
            for intent, values in arrays
        ]
        return nibabel.gifti.GiftiImage(darrays=darrays).to_xml()

    geometry = [("POINTSET", X.astype(np.float32)), ("TRIANGLE", T.astype(np.int32))]
    marked = [("LABEL", label.astype(np.int32))]
    raw = geometry[0][1].tobytes()
    text = gifti("GIFTI_ENCODING_B64GZ", *geometry)
    block = re.search(rb"<Data>([^<]*)</Data>", text)

    def in_gifti(data):
        return text[: block.start(1)] + base64.b64encode(zlib.compress(data)) + text[block.end(1) :]

    def in_vtp(data):
        head = np.array([1, len(data), 0, len(p := zlib.compress(data))], "<u4").tobytes()
        one = vtp("binary", True)
        found = re.search(rb'format="binary">([^<]*)<', one)
        return (
            one[: found.start(1)]
            + base64.b64encode(head)
            + base64.b64encode(p)
            + one[found.end(1) :]
        )

    encodings = [f"GIFTI_ENCODING_{kind}" for kind in ("ASCII", "B64BIN", "B64GZ")]
    freesurfer = made(
        lambda path: nibabel.freesurfer.write_geometry(path, X, T, create_stamp="by hand")
    )
    colours = np.array([[10, 20, 30, 0, 0], [40, 50, 60, 0, 0], [70, 80, 90, 0, 0]])
    annot = made(
        lambda path: nibabel.freesurfer.write_annot(
            path, label, colours, ["a", "b", "c"], fill_ctab=True
        )
    )
    old = np.array(
        [len(X), *np.stack([np.arange(len(X)), np.full(len(X), 10 + 256 * 20)]).T.ravel(), 1, 1, 2],
        ">i4",
    ).tobytes()
    old += (
        b"x\0" + np.array([2], ">i4").tobytes() + b"a\0" + np.array([10, 20, 0, 0], ">i4").tobytes()
    )
    clicked = [
        {"label": f"p{i}", "position": X[i].tolist(), "positionStatus": "defined"} for i in range(3)
    ]
    slicer = {
        "markups": [
            {"type": kind, "name": kind, "coordinateSystem": "LPS", "controlPoints": clicked}
            for kind in ("Fiducial", "ClosedCurve")
        ]
    }
    picked = "<!DOCTYPE PickedPoints>\n<PickedPoints>\n <DocumentData/>\n"
    picked += (
        "".join(f'<point x="{x}" y="{y}" z="{z}" active="1" name="n{x}"/>\n' for x, y, z in X[:4])
        + "</PickedPoints>\n"
    )
    marks = "name,x,y,z,curve,closed\n" + "".join(
        f"p{i},{x},{y},{z},c,1\n" for i, (x, y, z) in enumerate(X[:4])
    )
    covariates = "shape,age,site,weight\nleft.ply,31,Bern,60.5\nright,40,,NA\nmiddle,55,Genf,7e1\n"
    V, F = npy(X), npy(T)
    bare = "\n".join(marks.replace(",c,1", "").splitlines()[1:]).encode()
    vtps = [vtp(how) for how in ("ascii", "binary", "raw", "base64")]
    vtps += [vtp("binary", True), vtp("raw", True, "u8"), (raw, in_vtp)]
    npzs = [packed({"V.npy": V, "F.npy": F}), (V, lambda data: packed({"V.npy": data, "F.npy": F}))]
    npzs += [(F, lambda data: packed({"V.npy": V, "F.npy": data}))]
    orders = ["ascii", "binary_little_endian", "binary_big_endian"]
    binary_stl, off = WRITERS[".stl"](X, T, {}), WRITERS[".off"](X, T, {})
    named = "\n".join(["vertex,label", *(f"{i},{'abc'[k]}" for i, k in enumerate(label))]).encode()
    table = {
        "PLY": (".ply", "mesh", map(ply, orders)),
        "OBJ": (".obj", "mesh", [obj.encode()]),
        "OFF": (".off", "mesh", [off, off.replace(b"OFF\n", b"OFF\n# made\n")]),
        "STL": (".stl", "mesh", [f"solid a\n{solid}endsolid a\n".encode(), binary_stl]),
        "VTK": (".vtk", "mesh", [vtk4.encode(), vtk5.encode(), WRITERS[".vtk"](X, T, {})]),
        "VTP": (".vtp", "mesh", vtps),
        "GIFTI": (".gii", "mesh", [*(gifti(how, *geometry) for how in encodings), (raw, in_gifti)]),
        "FreeSurfer": (".pial", "mesh", [freesurfer]),
        "NPZ": (".npz", "mesh", npzs),
        "MZ3": (".mz3", "mesh", [mz3]),
        "MNI": (".obj", "mesh", [mni.encode()]),
        "gzip": (".gz", "mesh", [zipped(off), (ply(orders[1]), zipped), (text, zipped)]),
        "GIFTI labels": (".gii", "labels", [gifti(how, *marked) for how in encodings]),
        "annot": (".annot", "labels", [annot, old, (annot, zipped)]),
        "NPY": (".npy", "labels", [npy(label), npy(np.array(list("abc"))[label])]),
        "NPZ labels": (
            ".npz", "labels",
            [packed({"a.npy": npy(label)}), (npy(label), lambda d: packed({"a.npy": d}))],
        ),
        "CSV labels": (".csv", "labels", [named, "\n".join(map(str, label)).encode()]),
        "Slicer": (".mrk.json", "landmarks", [json.dumps(slicer, indent=1).encode()]),
        "MeshLab": (".pp", "landmarks", [picked.encode()]),
        "CSV landmarks": (".csv", "landmarks", [marks.encode(), bare]),
        "surfaces": (".npz", "surface", []),  # whole files, of surfaces that are none
        "CSV subjects": (
            ".csv", "subjects", [covariates.encode(), covariates.replace(",", ";").encode()],
        ),
    }  # fmt: skip
    return {
        name: (suffix, reader, [one if isinstance(one, tuple) else (one, whole) for one in given])
        for name, (suffix, reader, given) in table.items()
    }


# surfaces that are none


def part(rng):
    """A sphere, torus, square, heap of triangles, hull or single triangle."""
    import numpy as np
    from scipy.spatial import ConvexHull

    from s4a import synthetic
    from s4a.geometry.mesh import as_arrays

    n = int(rng.choice([4, 5, 8, 20, 60]))
    X = rng.normal(size=(n, 3))
    k = int(rng.integers(2, 8))
    x, y = np.divmod(np.arange(k * k), k)
    a = np.flatnonzero((x < k - 1) & (y < k - 1))
    square = np.r_[np.stack([a, a + k, a + k + 1], axis=1), np.stack([a, a + k + 1, a + 1], axis=1)]
    makers = [
        lambda: as_arrays(synthetic.sphere(max(n, 8))),
        lambda: as_arrays(synthetic.torus(1, rng.uniform(0.05, 0.6), 3 + 2 * k, 2 + k)),
        lambda: (np.stack([x, y, 0 * x], axis=1) * 1.0, square),
        lambda: (X, rng.integers(0, n, (int(rng.integers(1, 3 * n)), 3))),
        lambda: (X, ConvexHull(X).simplices),
        lambda: (X[:3], np.array([[0, 1, 2]])),
    ]
    return makers[rng.integers(len(makers))]()


def spoilt(rng, X, T):
    """One thing done to a surface."""
    import numpy as np

    size = np.ptp(X, axis=0).max() or 1.0
    jitter = size * 10 ** rng.uniform(-9, -1)
    m = len(T)
    unconnected = X[T[:80]].reshape(-1, 3)
    ways = [
        lambda: (
            unconnected + jitter * rng.normal(size=unconnected.shape),
            np.arange(len(unconnected)).reshape(-1, 3),
        ),
        lambda: (X + jitter * rng.normal(size=X.shape), T),
        lambda: (X * 10 ** rng.uniform(-6, 6, 3), T),  # slivers
        lambda: (X, T[rng.permutation(m)[: max(1, int(m * rng.uniform(0.2, 1)))]]),
        lambda: (X, np.r_[T, rng.integers(0, len(X), (3, 3))]),
        lambda: (np.round(X / size * rng.choice([1, 3, 10])) * size, T),
        lambda: (X, np.where(rng.random((m, 1)) < 0.5, T[:, ::-1], T)),
        lambda: (np.r_[X[:-1], [[rng.choice([np.nan, np.inf, 1e8 * size, 0])] * 3]], T),
        lambda: (X[rng.integers(0, len(X), len(X))], T),
        lambda: (X * 10 ** rng.uniform(-18, 18), T),
        lambda: (X + size * 10 ** rng.uniform(0, 14), T),
    ]
    return ways[rng.integers(len(ways))]()


def surface_that_is_none(seed):
    """An archive of parts, each moved and scaled, to which a few things were done."""
    import numpy as np

    rng = np.random.default_rng(seed)
    X, T = part(rng)
    for _ in range(rng.choice([0, 0, 0, 1, 4])):
        Y, S = part(rng)
        T = np.r_[T, S + len(X)]
        X = np.r_[X, Y * 10 ** rng.uniform(-2, 2) + rng.choice([0, 1, 10]) * rng.normal(size=3)]
    with np.errstate(all="ignore"):
        for _ in range(rng.integers(4)):
            X, T = spoilt(rng, X, T)
    return packed({"V.npy": npy(X), "F.npy": npy(T.astype(np.int32))})


# damage


def flip(data, rng, _):
    for _ in range(rng.choice([1, 1, 2, 8])):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def overwrite(data, rng, _):
    at = rng.randrange(len(data))
    n = rng.choice([1, 2, 4, 16, len(data)])
    data[at : at + n] = rng.randbytes(min(n, len(data) - at))


def cut(data, rng, _):
    del data[rng.randrange(len(data)) :]


def number(data, rng, _):
    found = list(re.finditer(rb"[-+.\d][-+.\deE]*", data))
    if found:
        one = rng.choice(found)
        data[one.start() : one.end()] = rng.choice(WORDS)


def integer(data, rng, _):
    size, at = rng.choice([1, 2, 4, 4, 4, 8]), rng.randrange(len(data))
    value = rng.choice(INTEGERS) % 256**size
    data[at : at + size] = value.to_bytes(size, rng.choice(["little", "big"]))


def block(data, rng):
    at = rng.randrange(len(data))
    return at, at + rng.choice([1, 4, 12, 50, 300])


def delete(data, rng, _):
    a, b = block(data, rng)
    del data[a:b]


def duplicate(data, rng, _):
    a, b = block(data, rng)
    data[b:b] = data[a:b] * rng.choice([1, 1, 2, 30])


def swap(data, rng, _):
    (a, b), (c, d) = sorted([block(data, rng), block(data, rng)])
    if b <= c:
        data[a:d] = data[c:d] + data[b:c] + data[a:b]


def lines(data, rng, _):
    rows = data.split(b"\n")
    i, j = rng.randrange(len(rows)), rng.randrange(len(rows))
    rows[i], rows[j] = rows[j], rows[i]
    data[:] = b"\n".join(rows)


def token(data, rng, _):
    at = rng.randrange(len(data))
    data[at:at] = rng.choice(TOKENS) * rng.choice([1, 1, 1, 40])


def header(data, rng, others):
    other = rng.choice(others)
    data[: rng.randrange(len(data))] = other[: rng.randrange(len(other))]


def noise(data, rng, _):
    keep = rng.choice([0, 4, 40])
    data[keep:] = rng.randbytes(rng.choice([0, 1, 100, 1000]))


DAMAGES = [
    flip, flip, overwrite, cut, number, number, number, integer, integer, delete, duplicate, swap,
    lines, token, header, noise,
]  # fmt: skip


def damaged(seed, name, i, table):
    """File i of a format."""
    rng = random.Random(f"{seed}/{name}/{i}")
    if name == "surfaces":
        return surface_that_is_none(rng.getrandbits(64))
    given = table[name][2]
    content, finish = given[i % len(given)]
    data = bytearray(content)
    others = [one for _, _, more in table.values() for one, _ in more]
    for _ in range(rng.choice([1, 1, 2, 3])):
        if data:
            rng.choice(DAMAGES)(data, rng, others)
    return finish(bytes(data))


# the child


def read(path, kind):
    """Read a file as the library does, a mesh up to what comes after its cleaning.

    "parsed" or "refused".
    """
    from s4a.input.annotations import read_labels, read_landmarks
    from s4a.input.clean import clean_arrays
    from s4a.input.collection import read_shape
    from s4a.input.files import read_mesh
    from s4a.input.subjects import read_table

    readers = {"mesh": read_mesh, "labels": read_labels, "landmarks": read_landmarks}
    readers["subjects"] = lambda path: read_table(path, ["left", "middle", "right"])
    readers["surface"] = lambda path: read_shape(path, components="all", close_holes=odd(path))
    try:
        found = readers[kind](path)
    except ValueError as error:
        if str(path) not in str(error):
            raise AssertionError(f"the message does not name the file: {error}") from error
        while error is not None:
            if isinstance(error, MemoryError):
                raise AssertionError(f"more memory than the limit: {error!r}") from error
            error = error.__cause__
        return "refused"
    if kind == "surface":
        try:
            remeshed(found)
        except ValueError:
            return "parsed, not cleaned"
    if kind == "mesh":
        try:
            clean_arrays(*found[:2])
        except ValueError:
            return "parsed, not cleaned"
    return "parsed"


def odd(path):
    return bool(sum(path.read_bytes()) % 2)


def remeshed(mesh):
    """What comes after the cleaning of a shape; AssertionError where it is not finite."""
    import numpy as np

    from s4a.method.remesh import coarsen
    from s4a.method.spectral import spectrum

    low = spectrum(coarsen(mesh, n_coarse=30), k=8)
    for name, values in low.variables.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise AssertionError(f"{name} is not finite")


def memory(key):
    """MiB of this process, of a line of its status."""
    found = re.search(rf"{key}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) / 1024


def tell(line):
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def work(task):
    """Read files of some formats one after the other.

    What happens goes to standard output, line by line.
    """
    logging.disable(logging.WARNING)  # of tiny surfaces that have few eigenfunctions
    table = seeds()
    path = Path(task["folder"]) / "none"
    read_all = {"mesh": b"OFF", "labels": b"1", "landmarks": b"0 0 0", "subjects": b"shape"}
    for kind, data in read_all.items():  # so that nothing is imported under the limit
        path.write_bytes(data)
        try:
            read(path, kind)
        except ValueError:
            pass
    X, T = surface()
    from s4a.input.clean import clean_arrays

    clean_arrays(X, T)
    path.write_bytes(packed({"V.npy": npy(X), "F.npy": npy(T)}))
    read(path, "surface")  # these too
    most = int(memory("VmSize") * 2**20) + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    progress = os.open(task["progress"], os.O_RDWR | os.O_CREAT)
    for name, first, last in task["parts"]:
        suffix, kind, _ = table[name]
        path = Path(task["folder"]) / f"file{suffix}"
        counts, slowest, began = {}, 0.0, time.process_time()
        Path("/proc/self/clear_refs").write_text("5")
        before = memory("VmHWM")
        for i in range(first, last):
            os.pwrite(progress, json.dumps([name, i]).ljust(100).encode(), 0)
            path.write_bytes(damaged(task["seed"], name, i, table))
            signal.setitimer(signal.ITIMER_PROF, SECONDS)  # ends the process, in native code too
            start = time.process_time()
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                try:
                    outcome = read(path, kind)
                    if told:
                        raise AssertionError(f"a warning left the reader: {told[0].message}")
                except BaseException as error:
                    outcome = "failed"
                    at = traceback.extract_tb(error.__traceback__)[-1]
                    why = (
                        f"{type(error).__name__}: {str(error)[:200]} "
                        f"({Path(at.filename).name}:{at.lineno})"
                    )
                    tell({"failed": [name, i, why]})
            signal.setitimer(signal.ITIMER_PROF, 0)
            slowest = max(slowest, time.process_time() - start)
            counts[outcome] = counts.get(outcome, 0) + 1
        spent = time.process_time() - began
        tell({"done": [name, counts, slowest, memory("VmHWM") - before, spent]})


# the parent


def fuzz(formats, files, seed=0, first=0, keep=None):
    """Read `files` damaged files of every format.

    Returns
    -------
    totals : dict of format to dict
        How many were parsed, parsed but not cleaned, refused, and failed; the slowest in seconds of
        processor time; the most memory above the start in MiB; processor seconds in all.
    failures : list of (format, number, reason)
    """
    shared = Path("/dev/shm")
    totals = {name: {"slowest": 0.0, "memory": 0.0, "seconds": 0.0} for name in formats}
    failures, parts = [], [(name, first, first + files) for name in formats]
    with tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None) as folder:
        task = {"folder": folder, "progress": f"{folder}/progress", "seed": seed}
        while parts:
            code, lines, at = child(task | {"parts": parts}, folder)
            for line in lines:
                if "failed" in line:
                    failures.append(tuple(line["failed"]))
                else:
                    name, counts, slowest, most, spent = line["done"]
                    total = totals[name]
                    for key, count in counts.items():
                        total[key] = total.get(key, 0) + count
                    total["slowest"], total["memory"] = (
                        max(total["slowest"], slowest),
                        max(total["memory"], most),
                    )
                    total["seconds"] += spent
                    parts = parts[1:]
            if code:
                if at is None:
                    raise RuntimeError(
                        f"the child ended with code {code} before the first file:\n{lines}"
                    )
                name, i = at
                why = {-signal.SIGPROF: f"over {SECONDS} s", "waits": f"over {PATIENCE} s"}.get(
                    code, f"died: {code}"
                )
                failures.append((name, i, why))
                totals[name]["failed"] = totals[name].get("failed", 0) + 1
                # counts of the part that died are lost: it is said
                totals[name]["died before"] = totals[name].get("died before", 0) + i - parts[0][1]
                parts = [(name, i + 1, parts[0][2]), *parts[1:]]
        table = seeds()
        if keep:
            Path(keep).mkdir(parents=True, exist_ok=True)
            for name, i, _ in failures:
                file = Path(keep) / f"{name.replace(' ', '_')}_{i}{table[name][0]}"
                file.write_bytes(damaged(seed, name, i, table))
    return totals, failures


def child(task, folder):
    """Run a child until it ends: its code, the lines it wrote, and where it was."""
    progress = Path(task["progress"])
    progress.unlink(missing_ok=True)
    out = Path(folder) / "out"
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {
        **os.environ,
        "PYTHONPATH": paths,
        "OMP_NUM_THREADS": "1",
        "PYTHONWARNINGS": "ignore",
    }
    with open(out, "wb") as lines:
        process = subprocess.Popen(
            [sys.executable, __file__, "--work", json.dumps(task)], stdout=lines, env=environment
        )
        seen, since, code = "", time.monotonic(), None
        while code is None:
            try:
                code = process.wait(1)
            except subprocess.TimeoutExpired:
                now = progress.read_text() if progress.exists() else ""
                if now != seen:
                    seen, since = now, time.monotonic()
                elif seen and time.monotonic() - since > PATIENCE:
                    process.kill()
                    process.wait()
                    code = "waits"
    written = [json.loads(line) for line in out.read_text().splitlines()]
    return code, written, json.loads(progress.read_text()) if progress.exists() else None


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=20000, help="of every format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first file")
    parser.add_argument("--only", nargs="+", metavar="FORMAT")
    parser.add_argument("--keep", metavar="FOLDER", help="where failing files are kept")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        work(json.loads(args.work))
        return 0
    failed = 0
    keys = ["parsed", "parsed, not cleaned", "refused", "failed", "died before"]
    heads = [
        "parsed",
        "not cleaned",
        "refused",
        "failed",
        "not counted",
        "slowest s",
        "MiB",
        "CPU s",
    ]
    sys.stdout.write(f"{'format':16}" + "".join(f"{head:>13}" for head in heads) + "\n")
    for name in args.only or seeds():
        totals, failures = fuzz([name], args.files, args.seed, args.first, args.keep)
        row = totals[name]
        counts = [row.get(key, 0) for key in keys]
        sys.stdout.write(f"{name:16}" + "".join(f"{count:13}" for count in counts))
        sys.stdout.write(
            "".join(f"{row[key]:13.3g}" for key in ("slowest", "memory", "seconds")) + "\n"
        )
        for one, i, why in failures[:20]:
            sys.stdout.write(f"  {one} {i}: {why}\n")
        sys.stdout.flush()
        failed += len(failures)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
