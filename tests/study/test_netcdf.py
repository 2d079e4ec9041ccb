"""Files that are written without h5netcdf: xarray reads them as its own, and HDF5 says the same."""

import io

import h5py
import numpy as np
import pytest
import xarray as xr

from s4a.study.hdf5 import DIMS
from s4a.study.netcdf import write_netcdf
from s4a.study.store import ENGINE, read, write

EVERYTHING = xr.Dataset(
    {
        "matrix": (("row", "column"), np.arange(6, dtype=np.float32).reshape(2, 3), {"unit": "mm"}),
        "square": (("row", "row_"), np.eye(2)),
        "empty": (("none", "column"), np.zeros((0, 3))),
        "small": ("column", np.array([-1, 0, 1], np.int8)),
        "large": ("column", np.array([0, 1, 2**63], np.uint64)),
        "gaps": ("column", [1.0, np.nan, -np.inf]),
        "is_odd": ("column", [True, False, True]),
        "text": ("column", ["", "é", "two words"]),
        "when": ("column", np.array(["2026-11-26", "NaT", "1999-01-01"], "M8[ns]")),
        "one_text": ((), "alone"),
        "one_number": ((), np.int16(7)),
    },
    {"row": ["a", "b"], "beside": ("column", [1.5, 2.5, 3.5]), "column": [10, 20, 30]},
    {"text": "µm", "none": "", "number": 3, "share": 0.5, "list": [1, 2], "names": ["a", "b"]},
)


def written_by_both(data):
    """The file of a Dataset as written here, and as by xarray."""
    here, there = io.BytesIO(), io.BytesIO()
    write_netcdf(data, here)
    data.to_netcdf(there, engine=ENGINE)
    return here, there


def test_what_is_written_is_read_again(study_folder):
    files = [read(path).drop_encoding() for path in sorted(study_folder.rglob("*.nc"))]
    for data in [EVERYTHING, xr.Dataset(), *files]:
        ours, others = written_by_both(data)
        with (
            xr.open_dataset(ours, engine=ENGINE) as here,
            xr.open_dataset(others, engine=ENGINE) as there,
        ):
            xr.testing.assert_identical(here, data)
            xr.testing.assert_identical(here, there)
            for name, variable in there.variables.items():
                assert here[name].dtype == variable.dtype, name


def test_a_file_that_is_compressed_is_smaller_and_holds_the_same(tmp_path):
    large = np.arange(3000.0).round(-1)
    data = EVERYTHING.assign(large_one=("vertex", large), gone=("vertex", large * np.nan))
    whole, small, path = io.BytesIO(), io.BytesIO(), tmp_path / "small.nc"
    write_netcdf(data, whole)
    write_netcdf(data, small, 4)
    assert len(whole.getvalue()) - len(small.getvalue()) > 0.9 * 2 * large.nbytes
    with h5py.File(small) as file:
        packed = {name for name, one in file.items() if one.compression == "gzip" and one.shuffle}
    assert packed == {"large_one", "gone"}
    with xr.open_dataset(small, engine=ENGINE) as here:
        xr.testing.assert_identical(here, data)
    data = data[["large_one", "gone"]]
    write(data, path, compression=4)
    found = read(path)
    assert path.stat().st_size < large.nbytes
    xr.testing.assert_equal(found, data)


def test_an_encoding_that_a_dataset_brings_along_compresses_nothing(tmp_path):
    data = xr.Dataset({"zero": ("vertex", np.zeros(3000))})
    data["zero"].encoding = {"zlib": True, "complevel": 9, "chunksizes": (3000,)}
    write(data, tmp_path / "a.nc")
    with h5py.File(tmp_path / "a.nc") as file:
        assert file["zero"].chunks is None


def test_hdf5_has_the_attributes_and_dims_that_h5netcdf_gives():
    data = EVERYTHING.drop_vars("empty")
    ours, others = written_by_both(data)
    with h5py.File(ours, "r") as here, h5py.File(others, "r") as there:
        assert set(here) == set(there)
        assert set(here.attrs) == set(there.attrs)
        for name, expected in there.items():
            found = here[name]
            assert (found.dtype, found.shape) == (expected.dtype, expected.shape), name
            assert found.maxshape == expected.maxshape
            assert set(found.attrs) == set(expected.attrs)
            for attribute in set(found.attrs) - {DIMS, "REFERENCE_LIST"}:  # these say where
                np.testing.assert_array_equal(found.attrs[attribute], expected.attrs[attribute])
            for axis in range(found.ndim if DIMS in found.attrs else 0):
                scales = found.dims[axis][0].name, expected.dims[axis][0].name
                assert scales[0] == scales[1]


@pytest.mark.parametrize(
    ("data", "error", "needed"),
    [
        (xr.Dataset({"a/b": 1}), ValueError, "without slash"),
        (xr.Dataset({"a": ("b/c", [1])}), ValueError, "without slash, .* found b/c"),
        (xr.Dataset({"row": (("row", "column"), np.eye(2))}), ValueError, "found row"),
        (xr.Dataset({"a": ("x", np.array([1 + 1j]))}), TypeError, "a needs numbers or texts"),
        (xr.Dataset({"a": ("x", np.array([b"a", None]))}), TypeError, "a needs numbers or texts"),
        (xr.Dataset(attrs={"a": {"b": 1}}), TypeError, "a needs numbers or texts"),
        (xr.Dataset(attrs={"a": None}), TypeError, "a needs numbers or texts"),
    ],
)
def test_what_netcdf_does_not_have_is_refused_by_name(data, error, needed):
    with pytest.raises(error, match=needed):
        write_netcdf(data, io.BytesIO())
