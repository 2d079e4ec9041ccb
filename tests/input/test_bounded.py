"""Compressed files: read as what they hold, and never more than the memory holds."""

import gzip
import tracemalloc
import zlib
from base64 import b64encode
from io import BytesIO

import numpy as np
import pytest

from s4a.input.files import WRITERS, find_meshes, read_mesh, write_mesh

X = np.array([[0, 0, 0], [1.5, 0, 0], [1.5, 2, 0], [0, 2, 0], [0.25, 0.5, 3]])
T = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


def file(path, content):
    path.write_bytes(content)
    return path


def test_compressed_files_are_read_as_what_they_hold(tmp_path):
    for suffix in (".ply", ".obj", ".off", ".stl", ".vtk", ".gii", ".npz"):
        write_mesh(tmp_path / f"m{suffix}", X, T)
        packed = file(
            tmp_path / f"m{suffix}.gz", gzip.compress((tmp_path / f"m{suffix}").read_bytes())
        )
        (tmp_path / f"m{suffix}").unlink()
        points, triangles, attrs = read_mesh(packed)
        assert np.array_equal(points[triangles], X[T])
        assert "note" not in attrs
    assert [name for _, name in find_meshes(tmp_path)] == [
        f"m_{s}_gz" for s in "gii npz obj off ply stl vtk".split()
    ]
    (tmp_path / "one").mkdir()
    (tmp_path / "m.ply.gz").rename(tmp_path / "one" / "brain.ply.gz")
    assert [name for _, name in find_meshes(tmp_path / "one", "brain")] == ["brain"]


def test_a_compressed_file_that_is_cut_or_damaged_is_refused(tmp_path):
    packed = gzip.compress(
        WRITERS[".obj"](np.random.default_rng(0).random((50, 3)), T, {}), mtime=0
    )
    with pytest.raises(ValueError, match="the gzip data ends early: found 40 bytes"):
        read_mesh(file(tmp_path / "m.ply.gz", packed[:40]))
    with pytest.raises(ValueError, match="damaged gzip data"):
        read_mesh(file(tmp_path / "m.ply.gz", packed[:30] + b"\xff" * 30 + packed[60:]))


def bombs():
    """Files of less than 400 kB that unpack to 80 MB."""
    zeros = bytes(80_000_000)
    block = zlib.compress(zeros)
    head = np.array([1, len(zeros), 0, len(block)], "<u4").tobytes()
    vtp = (
        b'<VTKFile type="PolyData" byte_order="LittleEndian" compressor="vtkZLibDataCompressor">'
        b"<PolyData>"
        b'<Piece NumberOfPoints="9" NumberOfPolys="0"><Points>'
        b'<DataArray type="Float32" format="binary">'
        + b64encode(head)
        + b64encode(block)
        + b"</DataArray></Points></Piece></PolyData></VTKFile>"
    )
    gifti = (
        b'<?xml version="1.0"?><GIFTI Version="1.0" NumberOfDataArrays="1">'
        b'<DataArray Intent="NIFTI_INTENT_POINTSET" '
        b'DataType="NIFTI_TYPE_FLOAT32" Dimensionality="1" Dim0="20000000" '
        b'Encoding="GZipBase64Binary" '
        b'Endian="LittleEndian" ArrayIndexingOrder="RowMajorOrder" ExternalFileName="" '
        b'ExternalFileOffset="">'
        b"<Data>" + b64encode(block) + b"</Data></DataArray></GIFTI>"
    )
    npz = BytesIO()
    np.savez_compressed(npz, V=np.zeros(10_000_000), F=np.array([[0, 1, 2]]))
    return {"gz": gzip.compress(zeros), "vtp": vtp, "gii": gifti, "npz": npz.getvalue()}


def test_an_archive_that_lies_about_its_sizes_is_read_no_further_than_it_says(tmp_path):
    packed = BytesIO()
    np.savez_compressed(packed, V=np.zeros(10_000_000), F=np.array([[0, 1, 2]]))
    true = (80_000_128).to_bytes(4, "little")
    assert packed.getvalue().count(true) == 2
    lying = packed.getvalue().replace(true, (1000).to_bytes(4, "little"))
    with pytest.raises(ValueError, match=r"m.npz cannot be read as NPZ"):
        read_mesh(file(tmp_path / "m.npz", lying))
    tracemalloc.start()
    with pytest.raises(ValueError):
        read_mesh(tmp_path / "m.npz")
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 10e6


def test_what_unpacks_to_too_much_is_refused_before_it_fills_the_memory(tmp_path):
    part = gzip.compress(bytes(2**26), 9)
    path = file(tmp_path / "m.ply.gz", 200 * part)  # 12.5 GiB in 13 MB
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"at most 64 MiB expected in \d+ compressed bytes"):
        read_mesh(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 2**27


def test_what_unpacks_to_too_much_is_refused(tmp_path):
    for suffix, data in bombs().items():
        assert len(data) < 400_000
        with pytest.raises(ValueError, match=r"at most .* expected in .*compressed .*found more"):
            read_mesh(file(tmp_path / f"m.{suffix}", data))
