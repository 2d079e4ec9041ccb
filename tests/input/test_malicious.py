"""Files made to do harm: nothing in them is run, they fill no memory and reach no other file."""

import base64
import gzip
import importlib
import inspect
import io
import itertools
import json
import os
import pkgutil
import re
import signal
import tracemalloc
import zipfile
import zlib

import fuzz
import h5py
import numpy as np
import pytest

import s4a
from s4a import synthetic
from s4a.input.annotations import read_labels, read_landmarks, write_landmarks
from s4a.input.files import WRITERS, find_meshes, read_mesh, stem_of, write_mesh

X, T = fuzz.surface()


def file(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


class Harm:
    """Unpickled, it makes a folder."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_pickles_are_never_executed(tmp_path):
    made, harm = tmp_path / "made", np.array([Harm(tmp_path / "made")], object)
    triangle = {"F": np.array([[0, 1, 2]])}
    np.save(tmp_path / "a.npy", harm, allow_pickle=True)
    np.savez(tmp_path / "b.npz", label=harm)
    np.savez(tmp_path / "c.npz", V=harm, **triangle)
    for read, name in ((read_labels, "a.npy"), (read_labels, "b.npz"), (read_mesh, "c.npz")):
        with pytest.raises(ValueError, match=rf"{name}.*pickled Python objects"):
            read(tmp_path / name)
        assert not made.exists()
    with np.load(tmp_path / "b.npz", allow_pickle=True) as arrays:  # that it would have done harm
        arrays["label"]
    assert made.is_dir()


def xml_files():
    """A valid file of every format in XML, the name of its root, and its reader."""
    table = fuzz.seeds()
    readers = {"mesh": read_mesh, "labels": read_labels, "landmarks": read_landmarks}
    for name, root in (
        ("VTP", b"VTKFile"),
        ("GIFTI", b"GIFTI"),
        ("GIFTI labels", b"GIFTI"),
        ("MeshLab", b"PickedPoints"),
    ):
        suffix, kind, given = table[name]
        body = given[0][0]
        yield suffix, root, body[body.index(b"<" + root) :], readers[kind]


BOMB = '<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {b} "{10 * f"&{a};"}">' for a, b in itertools.pairwise("abcdefghi")
)


@pytest.mark.parametrize(
    "entities",
    [BOMB, '<!ENTITY i SYSTEM "file:///etc/hostname">', '<!ENTITY % i SYSTEM "x.dtd"> %i;'],
)
def test_xml_with_entities_is_refused(tmp_path, entities):
    for suffix, root, body, read in xml_files():
        declared = b'<?xml version="1.0"?>\n<!DOCTYPE %s [%s]>\n' % (root, entities.encode())
        hurt = (
            body.replace(b"<Points>" if root == b"VTKFile" else b">", b">&i;", 1)
            if entities == BOMB
            else body
        )
        with pytest.raises(
            ValueError, match=r"without entities expected, found a declaration of '[ai]'"
        ):
            read(file(tmp_path / f"file{suffix}", declared + hurt))
        read(
            file(
                tmp_path / f"file{suffix}",
                declared.split(b" [")[0] + b' SYSTEM "http://a.b/c.dtd">' + body,
            )
        )


def npz(**members):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return out.getvalue()


def array(shape, data=b"", kind="<i4"):
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


GIFTI = (
    '<GIFTI Version="1.0"><DataArray Intent="NIFTI_INTENT_{}" DataType="NIFTI_TYPE_{}" '
    'Dimensionality="1" Dim0="{}" Encoding="{}" ArrayIndexingOrder="RowMajorOrder" '
    'Endian="LittleEndian" ExternalFileName="secret" ExternalFileOffset="0"><Data>{}</Data>'
    "</DataArray></GIFTI>"
)


def bombs():
    """Files of less than 400 kB that unpack to 80 MB, and what reads them."""
    zeros, n = bytes(80_000_000), 20_000_000
    block = zlib.compress(zeros)
    packed = base64.b64encode(block).decode()
    head = base64.b64encode(np.array([1, len(zeros), 0, len(block)], "<u4").tobytes()).decode()
    vtp = (
        '<VTKFile type="PolyData" compressor="vtkZLibDataCompressor"><PolyData>'
        '<Piece NumberOfPoints="9" NumberOfPolys="0"><Points>'
        f'<DataArray type="Float32" format="binary">{head}{packed}</DataArray>'
        "</Points></Piece></PolyData></VTKFile>"
    )
    points = GIFTI.format("POINTSET", "FLOAT32", n, "GZipBase64Binary", packed)
    label = GIFTI.format("LABEL", "INT32", n, "GZipBase64Binary", packed)
    zeros = array((n,), zeros)
    return [
        ("a.gz", gzip.compress(bytes(80_000_000)), read_mesh),
        ("a.vtp", vtp, read_mesh),
        ("a.gii", points, read_mesh),
        ("a.npz", npz(V=zeros, F=zeros), read_mesh),
        ("b.npz", npz(label=zeros), read_labels),
        ("b.gii", label, read_labels),
    ]


def test_what_unpacks_to_more_than_64_mib_and_200_times_its_size_is_refused(tmp_path):
    for name, data, read in bombs():
        assert len(data) < 400_000
        with pytest.raises(ValueError, match=rf"{name}.*at most .* in .*compressed .*found more"):
            read(file(tmp_path / name, data))


def test_a_gifti_file_opens_no_other_file(tmp_path):
    file(tmp_path / "secret", bytes(12))
    text = GIFTI.format("LABEL", "INT32", 3, "ExternalFileBinary", "")
    result = "data inside the file expected, found ExternalFileBinary secret"
    with pytest.raises(ValueError, match=result):
        read_labels(file(tmp_path / "a.gii", text))


@pytest.mark.parametrize("shape", ["f()", "-" * 9000 + "1", "(" * 9000, " " * 12_000])
def test_a_header_that_numpy_cannot_read_is_shown_and_not_evaluated(tmp_path, shape):
    expected = r"numpy\.save writes it expected, found b.{60,140}; export it again"
    for name, data in (("a.npy", array(shape)), ("b.npz", npz(label=array(shape)))):
        with pytest.raises(ValueError, match=rf"{name}.*{expected}"):
            read_labels(file(tmp_path / name, data))


def test_an_array_that_promises_more_than_its_file_is_refused_before_room_is_made_for_it(tmp_path):
    for shape, kind in (((10**12,), "<i4"), ((10**12,), "<U0"), ((10**6, 10**6, 10**6), "<f8")):
        for name, data in (
            ("a.npy", array(shape, bytes(12), kind)),
            ("b.npz", npz(label=array(shape, bytes(12), kind))),
        ):
            with pytest.raises(
                ValueError, match=rf"{name}.*bytes of .* expected for the shape .*, found 12"
            ):
                read_labels(file(tmp_path / name, data))


def test_arrays_that_share_bytes_of_a_file_count_each(tmp_path):
    raw = bytes(600_000)
    body = np.array([1, len(raw), 0, len(p := zlib.compress(raw))], "<u4").tobytes() + p
    piece = '<DataArray type="Float32" format="appended" offset="0"/>'
    piece = f'<Piece NumberOfPoints="50000"><Points>{piece}</Points></Piece>'
    text = '<VTKFile type="PolyData" compressor="vtkZLibDataCompressor"><PolyData>' + 400 * piece
    text += '</PolyData><AppendedData encoding="raw">_'
    with pytest.raises(
        ValueError, match=r"at most \d+ bytes expected in a compressed block, found more"
    ):
        read_mesh(file(tmp_path / "a.vtp", text.encode() + body + b"</AppendedData></VTKFile>"))


def test_offsets_of_polygons_whose_differences_overflow_are_refused(tmp_path):
    # in 64 bits each is above the one before by a positive number, and few in all
    offsets = f"{2**63 - 1} -2 9"
    arrays = {"connectivity": "0 1 2 0 1 2 0 1 2", "offsets": offsets}
    polys = "".join(
        f'<DataArray type="Int64" Name="{n}" format="ascii">{v}</DataArray>'
        for n, v in arrays.items()
    )
    points = '<DataArray type="Float32" format="ascii">0 0 0 1 0 0 0 1 0</DataArray>'
    xml = (
        f"<Piece NumberOfPoints='3' NumberOfPolys='3'><Points>{points}</Points>"
        f"<Polys>{polys}</Polys></Piece>"
    )
    legacy = (
        "# vtk DataFile Version 5.1\na\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n"
        "0 0 0 1 0 0 0 1 0\nPOLYGONS 4 9\n"
    )
    legacy += (
        f"OFFSETS vtktypeint64\n0 {offsets}\nCONNECTIVITY vtktypeint64\n{arrays['connectivity']}\n"
    )
    files = {
        "a.vtp": f'<VTKFile type="PolyData"><PolyData>{xml}</PolyData></VTKFile>',
        "a.vtk": legacy,
    }
    for name, content in files.items():
        with pytest.raises(ValueError, match=rf"{name}.*polygons of 9 corners expected, found 9"):
            read_mesh(file(tmp_path / name, content))


def test_one_long_word_does_not_widen_all_others(tmp_path):
    long = "1" * 100_000
    obj = "".join(f"v {i} 0 0\n" for i in range(20_000)) + f"v 0.{long} 1 0\nf 1 2 20001\n"
    assert (
        len(read_mesh(file(tmp_path / "a.obj", obj))[0]) == 20_001
    )  # in words of one width they are 6 GB
    rows = "label\n" + "x\n" * 100_000 + "y" * 100_000
    with pytest.raises(
        ValueError, match=r"names of at most 255 characters expected, found one of 100000"
    ):
        read_labels(file(tmp_path / "a.csv", rows))


@pytest.mark.parametrize(
    "content",
    [
        b"v" + b"\n" * 300_000,
        b"<VTKFile " + b"<AppendedData " * 50_000,
        b"<VTKFile " + b'<AppendedData encoding="' * 30_000,
        b"# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\n"
        + b"FIELD a 1\nb 1 1 int\n1\n" * 20_000,
        b"\x1f\x8b\x08\0\0\0\0\0\2\xff\3\0\0\0\0\0\0\0\0\0" * 20_000,
    ],
    ids=["empty lines", "tags", "attributes", "fields", "gzip members"],
)
def test_no_reader_takes_the_square_of_the_size(tmp_path, content):
    import time

    start = time.process_time()
    with pytest.raises(ValueError):
        read_mesh(file(tmp_path / "a.mesh", content))
    assert (
        time.process_time() - start < fuzz.SECONDS
    )  # the limit of the fuzzer; with the square it is minutes


def test_names_in_annotations_are_no_paths(tmp_path):
    names = ["../../a", "/b", "..\\c", "d/e", "nul\tf"]
    points = [{"label": name, "position": [i, 0, 0]} for i, name in enumerate(names)]
    given = {"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": points}]}
    path = file(tmp_path / "a.mrk.json", json.dumps(given))
    (tmp_path / "out").mkdir()
    write_landmarks(tmp_path / "out" / "l.csv", read_landmarks(path))
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["a.mrk.json", "l.csv", "out"]
    assert read_landmarks(tmp_path / "out" / "l.csv")["landmark_name"].values.tolist() == names
    for path in ("../../x.ply", "/x.ply", "a/../x.ply.gz"):
        assert stem_of(path) == "x"


# compressed files


def test_compressed_files_are_read_as_what_they_hold(tmp_path):
    for suffix in WRITERS:
        write_mesh(tmp_path / f"m{suffix}", X, T)
        packed = file(
            tmp_path / f"m{suffix}.gz", gzip.compress((tmp_path / f"m{suffix}").read_bytes())
        )
        (tmp_path / f"m{suffix}").unlink()
        points, triangles, attrs = read_mesh(packed)
        assert np.allclose(points[triangles], X[T])
        assert "note" not in attrs
    names = [name for _, name in find_meshes(tmp_path)]
    assert names == sorted(f"m_{suffix[1:]}_gz" for suffix in WRITERS)
    (tmp_path / "one").mkdir()
    (tmp_path / "m.ply.gz").rename(tmp_path / "one" / "brain.ply.gz")
    assert [name for _, name in find_meshes(tmp_path / "one", "brain")] == ["brain"]


def test_a_compressed_file_that_is_cut_or_damaged_is_refused(tmp_path):
    packed = gzip.compress(
        WRITERS[".obj"](np.random.default_rng(0).random((50, 3)), T, {}), mtime=0
    )
    with pytest.raises(ValueError, match="the gzip data is truncated: found 40 bytes"):
        read_mesh(file(tmp_path / "m.ply.gz", packed[:40]))
    with pytest.raises(ValueError, match="damaged gzip data"):
        read_mesh(file(tmp_path / "m.ply.gz", packed[:30] + b"\xff" * 30 + packed[60:]))


def memory_of_refusal(path, message):
    """Most memory (bytes) while a mesh is refused; now and then other threads take some, too."""
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=message):
            read_mesh(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_an_archive_that_lies_about_its_sizes_is_read_no_further_than_it_says(tmp_path):
    packed = io.BytesIO()
    np.savez_compressed(packed, V=np.zeros(10_000_000), F=np.array([[0, 1, 2]]))
    true = (80_000_128).to_bytes(4, "little")
    assert packed.getvalue().count(true) == 2
    lying = packed.getvalue().replace(true, (1000).to_bytes(4, "little"))
    path = file(tmp_path / "m.npz", lying)
    assert min(memory_of_refusal(path, "m.npz cannot be read as NPZ") for _ in range(3)) < 10e6


def test_what_unpacks_to_too_much_is_refused_before_it_fills_the_memory(tmp_path):
    part = gzip.compress(bytes(2**26), 9)
    path = file(tmp_path / "m.ply.gz", 200 * part)  # 12.5 GiB in 13 MB
    assert memory_of_refusal(path, r"at most 64 MiB expected in \d+ compressed bytes") < 2**27


# every public function that reads files

FILLED = {"names": ["a"], "name": "a", "label": 1, "what": "mesh", "path": "a.ply"}
# functions of this kind that write, or that keep a file or a folder open
NOT_READERS = re.compile("(write|remove|lock|note|at_work|analyse|register|insert|map_|folder_of)")


def readers(study):
    """Public functions of both packages that require a path, and what fills other parameters."""
    import s4a_morphometrics

    mesh = synthetic.sphere(50)
    filled = FILLED | {"mesh": mesh, "source": mesh, "target": mesh, "study": study}
    filled["sources"] = {"a": ("a.ply", "")}
    filled |= {"options": s4a.options.Options(), "key": "", "landmarks": None, "reference": "a"}
    filled |= {"claim": None, "intersections": False, "references": ["a"], "template": "a"}
    for package in (s4a, s4a_morphometrics):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if module.name.endswith(("__main__", "doctor")):
                continue
            for name, function in vars(importlib.import_module(module.name)).items():
                is_own = getattr(function, "__module__", "") == module.name
                if name.startswith("_") or not inspect.isfunction(function) or not is_own:
                    continue
                parameters = inspect.signature(function).parameters.values()
                kinds = {p.name: str(p.annotation) for p in parameters}
                paths = [n for n, kind in kinds.items() if re.match("[^[]*Path", kind)]
                needed = [p.name for p in parameters if p.default is p.empty and p.kind < 2]
                if not paths or NOT_READERS.match(name) or {*needed} - {*filled, *paths}:
                    continue
                for path in paths:
                    rest = {key: filled[key] for key in needed if key != path and key in filled}
                    if {*needed} <= {*rest, path}:
                        yield function, path, rest


def hdf5_files(folder):
    """HDF5 files of a few kB that reach other files, or need much memory."""
    secret, other = folder / "secret", folder / "other.h5"
    secret.write_bytes(b"the diary of somebody else " * 1000)
    with h5py.File(other, "w") as file:
        file["model/mean"] = file["s4a/contents_3"] = file["position"] = np.arange(9.0)
    layout = h5py.VirtualLayout(shape=(9,), dtype="f8")
    layout[:] = h5py.VirtualSource(str(other), "position", shape=(9,))
    zeros = np.zeros(2**24)

    def external(file, name):
        file.create_dataset(name, (27_000,), "u1", external=[(str(secret), 0, 27_000)])

    def packed(file, name):
        if "zeros" not in file:
            file.create_dataset("zeros", data=zeros, compression="gzip", chunks=(2**20,))
        file[name] = file["zeros"]

    kinds = {
        "storage": external,
        "link": lambda file, name: file.__setitem__(name, h5py.ExternalLink(str(other), name)),
        "virtual": lambda file, name: file.create_virtual_dataset(name, layout),
        "unwritten": lambda file, name: file.create_dataset(name, (2**30,), "f8", chunks=(2**20,)),
        "zeros": packed,
    }
    for kind, make in kinds.items():
        path = folder / f"{kind}.nc"
        with h5py.File(path, "w") as file:
            for name in ("model/mean", "s4a/contents_3", "position"):
                make(file, name)
        yield path
    with h5py.File(folder / "groups.nc", "w") as file:
        file["s4a"] = file["model"] = h5py.ExternalLink(str(other), "/model")
    yield folder / "groups.nc"


def special_files(folder):
    """A pipe, and links that lead to themselves or to a device without end."""
    os.mkfifo(folder / "pipe.nc")
    (folder / "loop.nc").symlink_to(folder / "loop.nc")
    (folder / "device.nc").symlink_to("/dev/zero")
    return [folder / f"{name}.nc" for name in ("pipe", "loop", "device")]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
def test_no_public_function_reads_beyond_a_hostile_file(tmp_path, example_study):
    def stop(*_):
        raise RuntimeError("it waits")

    found = list(readers(example_study))
    names = {function.__name__ for function, _, _ in found}
    known = "read_mesh read_shape read_shapes read_landmarks read_labels read_scalars read_volume "
    known += "read_table open_study open_inserted verify status read_scalismo open_structures"
    assert names >= {*known.split(), "match_pair"}
    folder = tmp_path / "study"
    (folder / "original").mkdir(parents=True)
    within = [folder / name for name in ("original/a.nc", "report.nc", "inserted.nc")]
    before = signal.signal(signal.SIGALRM, stop)
    tracemalloc.start()
    try:
        for hostile in [*hdf5_files(tmp_path), *special_files(tmp_path)]:
            for path in within:
                path.unlink(missing_ok=True)
                os.link(hostile, path, follow_symlinks=False)
            for function, name, rest in found:
                for target in (hostile, folder):
                    what = f"{function.__module__}.{function.__name__}({name}={target})"
                    signal.alarm(5)
                    tracemalloc.reset_peak()
                    try:
                        result = function(**{name: target}, **rest)
                        if hasattr(result, "__enter__") and hasattr(result, "gen"):
                            with result:
                                pass
                        result = repr(result)
                    except (ValueError, OSError, TypeError) as error:
                        result = str(error)
                    finally:
                        signal.alarm(0)
                    assert "diary" not in result, what
                    assert tracemalloc.get_traced_memory()[1] < 2**27, what
    finally:
        tracemalloc.stop()
        signal.signal(signal.SIGALRM, before)
