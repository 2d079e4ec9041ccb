"""A damaged byte is seen; a study of a stranger leads nowhere; each file holds what it should."""

import json
import os
import random
import shutil
import zlib

import h5py
import numpy as np
import pytest
import xarray as xr
from small import OPTIONS

from s4a import analyse, cli, open_study, synthetic, verify
from s4a.study import seal, store
from s4a.study.runner import read_costs

SECRET = b"the diary of somebody else " * 40


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "original" / "a.nc"
    store.write(synthetic.sphere(500), path, "key")
    return path


@pytest.fixture
def folder(study_folder, tmp_path):
    """A copy of the study, to be changed."""
    return shutil.copytree(study_folder, tmp_path / "study")


def flipped(data, bit):
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return changed


# ---- damage


def test_a_bit_flipped_anywhere_in_a_file_is_an_error_that_names_it(file):
    data, rng = file.read_bytes(), random.Random(0)
    for bit in rng.sample(range(8 * len(data)), 300):
        file.write_bytes(flipped(data, bit))
        assert not store.is_done(file, "key"), bit
        with pytest.raises(OSError, match=r"a\.nc cannot be read .* run the analysis again"):
            store.read(file)


def test_bytes_lost_or_zeroed_anywhere_are_seen(file):
    data, rng = file.read_bytes(), random.Random(1)
    for _ in range(100):
        begin = rng.randrange(len(data))
        n = min(rng.choice([1, 40, 1800]), len(data) - begin)
        for changed in (data[:begin] + bytes(n) + data[begin + n :], data[:begin]):
            if changed != data:
                file.write_bytes(changed)
                assert not store.is_done(file, "key")
                with pytest.raises(OSError, match=r"a\.nc cannot be read"):
                    store.read(file)


def test_a_larger_variable_is_checked_when_it_is_read_and_not_before(file):
    with h5py.File(file) as inside:
        at = inside["position"].id.get_offset()
    file.write_bytes(flipped(file.read_bytes(), 8 * at + 800))
    data = store.open_file(file)
    assert data["corner_vertex"].values.max() == 499
    with pytest.raises(OSError, match="the bytes of position are not those that were written"):
        data["position"].load()


def test_a_file_from_before_there_were_checksums_opens(file):
    whole = store.read(file)
    whole.to_netcdf(file, engine=store.ENGINE)
    assert store.is_done(file, "key")
    xr.testing.assert_identical(store.read(file), whole)


def test_a_file_whose_checksums_were_cut_off_does_not(file):
    data = file.read_bytes()
    file.write_bytes(data[: data.index(b"\ns4a seal")])
    with pytest.raises(OSError, match="its seal was cut off"):
        store.open_file(file)


def test_any_program_reads_a_file_with_checksums_and_names_of_columns_are_free(tmp_path):
    column = xr.DataArray(np.arange(1200.0), dims="shape")
    columns = {"body mass, kg": column, "": column, 'a "b" - c': column + 1}
    data = xr.Dataset({name: values for name, values in columns.items() if name})
    store.write(data, tmp_path / "a.nc", "key")
    with xr.open_dataset(tmp_path / "a.nc", engine=store.ENGINE) as found:
        xr.testing.assert_equal(found, data)
    xr.testing.assert_equal(store.read(tmp_path / "a.nc"), data)


def test_a_run_makes_damaged_files_anew_and_no_others_and_the_same_bytes(brains, folder):
    def states():
        return {p: p.stat().st_mtime_ns for p in folder.rglob("[!.]*.nc")}

    damaged = [
        folder / name
        for name in ("original/brain_02.nc", "registration/brain_01.nc", "coarse/brain_03.nc")
    ]
    whole = {path: path.read_bytes() for path in damaged}
    for path, data in whole.items():
        path.write_bytes(flipped(data, 4 * len(data)))
    assert set(verify(folder)["state"].values.tolist()) == {"whole", "damaged"}
    before = states()
    analyse(brains, store=folder, **OPTIONS).close()
    changed = {path for path, time in states().items() if before[path] != time}
    made_by_every_run = {folder / f"{name}.nc" for name in ("registration", "pca", "report")}
    assert changed - made_by_every_run == set(damaged)
    assert {path: path.read_bytes() for path in damaged} == whole
    assert set(verify(folder)["state"].values.tolist()) == {"whole"}


@pytest.mark.parametrize(
    "content",
    [
        b"[1, 2]",
        b'"text"',
        b'{"a": [1]}',
        b'{"a": [1, 2, 3]}',
        b'{"a": ["x", 1]}',
        b'{"a": [-1, 1]}',
        b'{"a": [NaN, 1]}',
        b'{"a": [1e999, 1]}',
        b'{"a": [1, 1%s]}' % (b"0" * 400),
        b"\xff\xfe",
        b"[" * 100_000,
        b"null",
    ],
)
def test_costs_of_another_form_are_told_and_counted_as_none(tmp_path, caplog, content):
    (tmp_path / "costs.json").write_bytes(content)
    assert read_costs(tmp_path / "costs.json") == {}
    assert "times of earlier runs are not counted" in caplog.text


# ---- variables that are packed as one whole


def pack(data, path, **how):
    """Write a Dataset as xarray packs: every variable that has numbers in one chunk."""
    encoding = {
        name: {"zlib": True, "complevel": 9, "chunksizes": data[name].shape} | how
        for name in data.variables
        if data[name].dtype.kind in "iuf"
    }
    data.to_netcdf(path, engine=store.ENGINE, encoding=encoding)


def own_bytes(path, name, change):
    """Put other bytes, of the same number, in the place of those of a packed variable."""
    with h5py.File(path) as file:
        chunk = file[name].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    place = slice(chunk.byte_offset, chunk.byte_offset + chunk.size)
    changed = change(bytes(data[place]))
    data[place] = changed.ljust(chunk.size, b"\0")
    path.write_bytes(data)


@pytest.mark.parametrize("shuffle", [True, False])
def test_variables_packed_as_one_whole_are_read_as_they_were(file, tmp_path, shuffle):
    whole, path = store.read(file), tmp_path / "packed.nc"
    pack(whole, path, shuffle=shuffle)
    with h5py.File(path) as inside:
        assert inside["position"].compression == "gzip"
        assert inside["position"].shuffle == shuffle
        assert inside["position"].id.get_chunk_info(0).size < whole["position"].nbytes
    xr.testing.assert_identical(store.read(path), whole)
    position, corners = store.arrays(path, "position", "corner_vertex")
    np.testing.assert_array_equal(position, whole["position"])
    np.testing.assert_array_equal(corners, whole["corner_vertex"])


def test_a_variable_that_says_it_unpacks_to_more_than_deflate_can_is_refused(tmp_path):
    path = tmp_path / "a.nc"
    for n, refused in ((1_000_000, False), (2_000_000, True)):
        with h5py.File(path, "w") as file:
            stored = file.create_dataset("zeros", (n,), "u1", chunks=(n,), compression="gzip")
            stored.id.write_direct_chunk((0,), zlib.compress(bytes(1_000_000), 9))
            assert (n > 1032 * stored.id.get_chunk_info(0).size) == refused
        if not refused:
            assert store.arrays(path, "zeros")[0].shape == (n,)
            continue
        for read in (store.open_file, store.read, lambda path: store.arrays(path, "zeros")):
            with pytest.raises(OSError, match=r"a\.nc cannot be read \(zeros has not all values"):
                read(path)


@pytest.mark.parametrize("n", [499, 501, 0], ids=["less", "more", "none"])
@pytest.mark.parametrize("shuffle", [True, False])
def test_a_variable_that_unpacks_to_another_size_is_refused(file, tmp_path, n, shuffle):
    path = tmp_path / "packed.nc"
    pack(store.read(file), path, shuffle=shuffle)
    own_bytes(path, "position", lambda _: zlib.compress(bytes(n * 3 * 8)))
    with pytest.raises(OSError, match=r"packed\.nc cannot be read \(it unpacks to another size"):
        store.read(path)


def test_a_packed_variable_of_bytes_that_cannot_be_unpacked_is_refused(file, tmp_path):
    path = tmp_path / "packed.nc"
    pack(store.read(file), path)
    own_bytes(path, "position", lambda stored: bytes(len(stored)))
    with pytest.raises(OSError, match=r"packed\.nc cannot be read .*decompressing"):
        store.read(path)


# ---- files of strangers


def external_storage(file, secret):
    file.create_dataset("age", (len(SECRET),), "u1", external=[(str(secret), 0, len(SECRET))])


def external_link(file, secret):
    file["age"] = h5py.ExternalLink(str(secret), "/age")


def soft_link(file, secret):
    file["age"] = h5py.SoftLink("/position")


def virtual(file, secret):
    layout = h5py.VirtualLayout(shape=(10,), dtype="f8")
    layout[:] = h5py.VirtualSource(str(secret), "age", shape=(10,))
    file.create_virtual_dataset("age", layout)


def packed(file, secret):
    file.create_dataset("age", (2**40,), "u1", chunks=(2**20,), compression="gzip")


def unlimited(file, secret):
    file.create_dataset("age", (10,), "f8", maxshape=(None,))


def never_written(file, secret):
    file.create_dataset("age", (2**50,), "f8")


def group(file, secret):
    file.create_group("age")


def compound(file, secret):
    file["age"] = np.zeros(3, [("a", "f8"), ("b", "i4")])


def one_text_many_times(file, secret):
    file["age"] = ["x" * 100_000] + [""] * 2000
    raw = file["age"].id
    at = raw.get_offset()
    file.flush()
    with open(file.filename, "r+b") as inside:
        inside.seek(at)
        pointer = inside.read(16)
        inside.seek(at)
        inside.write(pointer * 2001)


def one_long_text(file, secret):
    file["age"] = ["x" * 1_000_000] + [""] * 100_000


def many_attributes(file, secret):
    file.attrs["age"] = ["x" * 60_000] * 3000


STRANGE = [
    external_storage,
    external_link,
    soft_link,
    virtual,
    packed,
    unlimited,
    never_written,
    group,
    compound,
    one_text_many_times,
    one_long_text,
    many_attributes,
]


@pytest.mark.parametrize("strange", STRANGE)
def test_what_leads_out_of_a_file_or_unpacks_is_refused_before_it_is_read(tmp_path, strange):
    secret, path = tmp_path / "diary", tmp_path / "subjects.nc"
    secret.write_bytes(SECRET)
    synthetic.sphere(50).to_netcdf(path, engine=store.ENGINE)
    with h5py.File(path, "a") as file:
        strange(file, secret)
    for read in (store.open_file, store.read):
        with pytest.raises(OSError, match=r"subjects\.nc cannot be read") as found:
            read(path)
        assert "diary" not in str(found.value)
    assert not store.is_done(path, "")


def test_no_content_of_another_file_comes_into_a_page_or_a_table(folder, tmp_path, capsys):
    secret = tmp_path / "diary"
    secret.write_bytes(SECRET)
    path = folder / "subjects.nc"
    names = open_study(folder)["pca"]["shape"].values.tolist()
    xr.Dataset({}, {"shape": names}).to_netcdf(path, engine=store.ENGINE)
    with h5py.File(path, "a") as file:
        external_storage(file, secret)
    for command in (["view"], ["statistics", "--variable", "age"], ["verify"]):
        code = cli.main([command[0], str(folder), *command[1:]])
        said = capsys.readouterr()
        assert code == (1 if command == ["verify"] else 2)
        assert "subjects.nc" in said.out + said.err
        assert "age takes its values from other files, which are not read" in said.out + said.err
    for made in folder.rglob("*"):
        assert made == secret or made.is_dir() or SECRET[:27] not in made.read_bytes()


@pytest.mark.parametrize("place", ["original", "original/brain_01.nc"])
def test_symbolic_links_within_a_study_are_not_followed(folder, tmp_path, place):
    (folder / place).rename(tmp_path / "elsewhere")
    (folder / place).symlink_to(tmp_path / "elsewhere")
    with pytest.raises((ValueError, OSError), match=f"{place}.* symbolic link"):
        open_study(folder)
    whole = tmp_path / "link"
    (folder / place).unlink()
    (tmp_path / "elsewhere").rename(folder / place)
    whole.symlink_to(folder)
    assert "pca" in open_study(whole)  # the study itself may be a link


IN_STUDY = [
    (["view"], "study.html"),
    (["statistics"], "statistics"),
    (["statistics"], "statistics/evaluation.csv"),
    (["run", "absent.ply", "--out"], "report.txt"),
]


@pytest.mark.parametrize(("command", "name"), IN_STUDY)
def test_a_link_in_a_study_is_not_written_through(folder, tmp_path, capsys, command, name):
    (tmp_path / "diary").write_text("mine")
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(tmp_path / "diary")
    assert cli.main([*command, str(folder)]) == 2
    assert f"{name} is a symbolic link" in capsys.readouterr().err
    assert (tmp_path / "diary").read_text() == "mine"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
@pytest.mark.parametrize(("command", "name"), IN_STUDY)
def test_a_pipe_in_a_study_is_not_written_to(folder, capsys, command, name):
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    assert cli.main([*command, str(folder)]) == 2
    assert f"{name} is a pipe" in capsys.readouterr().err


def test_a_dim_that_is_not_there_is_told(file):
    store.read(file).to_netcdf(file, engine=store.ENGINE)  # without checksums
    with h5py.File(file, "r+") as raw:
        del raw["xyz"]
    with pytest.raises(OSError, match=r"a\.nc cannot be read \(position has a dim that is not in"):
        store.open_file(file)


def test_a_report_of_somebody_else_in_a_study_is_not_overwritten(tmp_path):
    (tmp_path / ".lock").touch()
    synthetic.sphere(50).to_netcdf(tmp_path / "report.nc", engine=store.ENGINE)
    before = (tmp_path / "report.nc").read_bytes()
    with pytest.raises(ValueError, match=r"report\.nc was not made by s4a"), store.lock(tmp_path):
        pass
    assert (tmp_path / "report.nc").read_bytes() == before


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
def test_a_pipe_in_the_place_of_a_file_is_not_waited_for(file):
    file.unlink()
    os.mkfifo(file)
    assert not store.is_done(file, "key")
    with pytest.raises(OSError, match="not a regular file"):
        store.open_file(file)


# ---- what a file holds


def without(name):
    return lambda data: data.drop_vars(name)


def as_text(name):
    return lambda data: data.assign({name: data[name].astype(str)})


def beyond(name):
    return lambda data: data.assign({name: data[name] + 10_000_000})


CHANGES = [
    ("original/brain_01", without("position"), "it lacks position"),
    ("original/brain_01", beyond("corner_vertex"), "corner_vertex needs indices 0..1499 of vertex"),
    ("original/brain_01", as_text("position"), "position needs numbers"),
    ("original/brain_01", lambda d: d.rename(xyz="abc"), "position needs the dims"),
    ("original/brain_01", lambda d: d.isel(xyz=[0, 1]), "xyz needs 3 entries, found 2"),
    ("original/brain_01", lambda d: d.drop_attrs(), "the attribute status needs a text"),
    ("coarse/brain_01", beyond("coarse_vertex"), "coarse_vertex needs indices"),
    ("coarse/brain_01", beyond("sample_vertex"), "sample_vertex needs indices"),
    ("coarse/brain_01", without("eigenvalue"), "it lacks eigenvalue"),
    ("coarse/brain_01", lambda d: d.isel(mode=slice(3)), "modes need as many eigenfunctions"),
    ("coarse/brain_01", lambda d: d.isel(original_vertex=slice(900)), "needs indices|needs 1500"),
    (
        "network",
        lambda d: d.assign(source=d["source"].copy(data=["?"] * d.sizes["pair"])),
        "shapes",
    ),
    ("latent", without("latent_basis"), "it lacks latent_basis"),
    ("latent", without("shape"), "it lacks shape"),
    ("latent", lambda d: d.assign_coords(shape=["brain_01"] * 4), "names that differ"),
    ("latent", lambda d: d.assign_attrs(median="nobody"), "median needs shapes of the study"),
    ("registration", lambda d: d.assign_attrs(template="nobody"), "template needs shapes"),
    ("registration", lambda d: d.drop_attrs(), "the attribute template needs a text"),
    ("registration", lambda d: d.isel(triangle=slice(9)), "triangle needs"),
    ("registration/brain_01", beyond("registered_match"), "registered_match needs indices"),
    ("registration/brain_01", beyond("template_triangle"), "template_triangle needs indices"),
    ("registration/brain_01", lambda d: d.isel(vertex=slice(9)), "vertex needs"),
    ("registration/brain_01", lambda d: d.assign_attrs(score="?"), "score needs a number"),
    ("pca", without("score"), "it lacks score"),
    ("pca", lambda d: d.isel(vertex=slice(9)), "vertex needs"),
    ("pca", lambda d: d.assign_coords(shape=list("abcd")), "scores needs shapes of the study"),
    ("report", without("status"), "it lacks status"),
    ("report", lambda d: d.isel(shape=[0, 0, 1, 2]), "names that differ"),
]


@pytest.mark.parametrize(("name", "change", "message"), CHANGES)
def test_a_file_that_does_not_hold_what_it_should_is_named_with_what(
    folder, capsys, name, change, message
):
    path = folder / f"{name}.nc"
    data = store.read(path)
    key, made_from = data.attrs.pop("task_key"), data.attrs.pop("made_from").split()
    store.write(change(data), path, key, made_from)
    for command in ("view", "statistics"):  # they need not read all
        out = folder / f"{command}.out"
        code = cli.main([command, str(folder), "--out", str(out)])
        said = capsys.readouterr().err
        assert code in (0, 2)
        assert (".nc cannot be read" in said) == (code == 2)
    with pytest.raises(OSError, match=message):
        open_study(folder).load()
    assert "damaged" in verify(folder)["state"].values


# ---- headers


def with_header(path, change):
    """Seal a file anew with another header, as somebody could who knows how."""
    data = path.read_bytes()
    begin = data.index(seal.HEAD)
    lines = data[begin:].removeprefix(seal.HEAD).decode().splitlines()[:-1]
    *parts, header = lines
    text = seal.HEAD + "".join(f"{line}\n" for line in [*parts, *change(header)]).encode()
    foot = f"{len(text):08d} {zlib.crc32(text):08x} ".encode() + seal.FOOT
    path.write_bytes(data[:begin] + text + foot)


def put(value, *keys):
    """A change of one entry of a header."""

    def change(header):
        said = json.loads(header)
        place = said["variables"]
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        return [json.dumps(said)]

    return change


def test_a_file_sealed_before_there_were_headers_is_read_the_same(file):
    whole = store.read(file)
    with_header(file, lambda header: [])
    assert store.is_done(file, "key")
    xr.testing.assert_identical(store.read(file), whole)


LIES = {
    "beyond the file": put([0, 10**12, [500, 3], "<f8", []], "position", "place"),
    "before the file": put([-8, 11992, [500, 3], "<f8", []], "position", "place"),
    "more values than bytes": put([0, 8, [10**9, 3], "<f8", []], "position", "place"),
    "unpacks to too much": put([0, 8, [10**9, 3], "<f8", [1]], "position", "place"),
    "objects": put([0, 12000, [500, 3], "|O8", []], "position", "place"),
    "a dim too few": put(["vertex"], "position", "dims"),
    "sizes that differ": put(["vertex", "corner"], "corner_vertex", "dims"),
    "cut off": lambda header: [header[:-9]],
}


@pytest.mark.parametrize("lie", LIES)
def test_a_header_that_cannot_be_is_refused(file, lie):
    with_header(file, LIES[lie])
    with pytest.raises(OSError, match=r"a\.nc cannot be read"):
        store.read(file)


def test_a_header_that_names_more_text_than_there_can_be_is_refused(tmp_path):
    file = tmp_path / "subjects.nc"
    store.write(xr.Dataset(coords={"shape": ["a", "b"]}), file, "key")
    texts = ["x" * 10**6, *[""] * 10**4]
    place = [0, 0, [len(texts)], "text", []]
    with_header(
        file, lambda header: put(texts, "shape", "texts")(put(place, "shape", "place")(header)[0])
    )
    with pytest.raises(OSError, match="shape has more text than its file"):
        store.read(file)


def test_verify_sees_a_header_that_says_something_else_than_hdf5(folder):
    with_header(folder / "coarse/brain_01.nc", put("m", "position", "attrs", "units"))
    assert open_study(folder)["coarse/brain_01"]["position"].attrs["units"] == "m"
    row = verify(folder).sel(file="coarse/brain_01.nc")
    assert row["state"].item() == "damaged"
    assert "its header is not that of its HDF5" in row["fault"].item()


# ---- verify


def test_verify_says_in_one_line_what_holds_and_its_exit_code_whether(folder, capsys):
    assert cli.main(["verify", str(folder)]) == 0
    n = len(list(folder.rglob("[!.]*.nc")))
    assert capsys.readouterr().out == f"{n} files, all whole and made from each other\n"
    (folder / "notes.txt").write_text("mine")
    shutil.copy(folder / "original/brain_01.nc", folder / "original/other.nc")
    (folder / "network/motion_brain_04.nc").unlink()
    path = folder / "pca.nc"
    path.write_bytes(flipped(path.read_bytes(), 8 * 9000))
    assert cli.main(["verify", str(folder)]) == 1
    first, *lines = capsys.readouterr().out.splitlines()
    assert "1 damaged" in first
    assert "1 missing" in first
    assert "the same `s4a run` again makes what is wrong anew" in first
    assert sorted(line.split(",")[0].strip() for line in lines) == [
        "network/motion_brain_04.nc",
        "notes.txt",
        "original/other.nc",
        "pca.nc",
    ]


@pytest.mark.parametrize("name", ["original/brain_01.nc", "registration/brain_01.nc"])
def test_verify_does_not_blame_what_was_made_from_a_damaged_file(folder, name):
    path = folder / name
    path.write_bytes(flipped(path.read_bytes(), 8 * 100))
    found = verify(folder)
    assert found["file"].values[found["state"].values != "whole"].tolist() == [name]


def test_verify_tells_files_of_an_earlier_run_and_those_from_before_checksums(brains, folder):
    path = folder / "original/brain_01.nc"
    data = store.read(path)
    data.to_netcdf(path, engine=store.ENGINE)
    found = verify(folder)
    assert found["state"].sel(file="original/brain_01.nc").item() == "unsealed"
    store.write(data, path, "another key")
    found = verify(folder)
    assert found["state"].sel(file="coarse/brain_01.nc").item() == "stale"


def test_an_unfinished_study_is_told_by_verify(folder):
    (folder / "report.nc").unlink()
    found = verify(folder)
    assert found["state"].sel(file="report.nc").item() == "missing"
