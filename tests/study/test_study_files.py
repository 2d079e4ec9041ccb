"""Files of a study: round trips, detection of damage, and untrusted files."""

import io
import os
import random
import shutil

import h5py
import numpy as np
import pytest
import xarray as xr
from small import OPTIONS

from s4a import analyse, cli, open_study, synthetic, verify
from s4a.study import netcdf, store
from s4a.study.progress import read_costs
from s4a.study.tree import Reader, check_file

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


def rewritten(file, data):
    """The file with other bytes, under another inode, as a reader may still have the old one."""
    file.unlink()
    file.write_bytes(data)


def flipped(data, bit):
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return changed


# ---- reading and writing


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
        "one_text": ((), "alone"),
        "one_number": ((), np.int16(7)),
    },
    {"row": ["a", "b"], "beside": ("column", [1.5, 2.5, 3.5]), "column": [10, 20, 30]},
    {"text": "µm", "none": "", "number": 3, "share": 0.5, "list": [1, 2], "names": ["a", "b"]},
)


def written_by_both(data):
    """The file of a Dataset as written here, and as by xarray."""
    here, there = io.BytesIO(), io.BytesIO()
    netcdf.write_netcdf(data, here)
    data.to_netcdf(there, engine="h5netcdf")
    return here, there


def test_what_is_written_is_read_again(study_folder):
    paths = [*study_folder.glob("*.nc"), *study_folder.glob("*/*brain_01.nc")]
    for data in [EVERYTHING, xr.Dataset(), *(netcdf.read(path).drop_encoding() for path in paths)]:
        ours, others = written_by_both(data)
        with (
            xr.open_dataset(ours, engine="h5netcdf") as here,
            xr.open_dataset(others, engine="h5netcdf") as there,
        ):
            xr.testing.assert_identical(here, data)
            xr.testing.assert_identical(here, there)
            for name, variable in there.variables.items():
                assert here[name].dtype == variable.dtype, name


def test_a_tree_is_read_as_it_was_written(tmp_path):
    tree = xr.DataTree.from_dict(
        {"/": xr.Dataset(attrs={"n": 1}), "/a/b": EVERYTHING, "/c": EVERYTHING}
    )
    store.write(tree, tmp_path / "tree.nc")
    result = netcdf.read_tree(tmp_path / "tree.nc")
    assert result["a/b"].identical(tree["a/b"])
    with xr.open_datatree(tmp_path / "tree.nc", group="/a", engine="h5netcdf") as there:
        assert there["b"].to_dataset().identical(EVERYTHING)


def test_hdf5_has_the_dims_that_h5netcdf_gives_and_a_checksum_of_every_variable_of_numbers():
    ours, others = written_by_both(EVERYTHING.drop_vars("empty"))
    with h5py.File(ours, "r") as here, h5py.File(others, "r") as there:
        assert set(here) == {*there, netcdf.GROUP}
        for name, expected in there.items():
            if name in ("row_", "none"):  # dims without values
                continue
            assert (here[name].dtype, here[name].shape) == (expected.dtype, expected.shape), name
            for axis, dim in enumerate(here[name].dims):
                assert [scale.name for scale in dim.values()] == [
                    scale.name for scale in expected.dims[axis].values()
                ]
            assert here[name].fletcher32 == (expected.dtype.kind in "iuf" and expected.ndim > 0)


@pytest.mark.parametrize(
    ("data", "error", "needed"),
    [
        (xr.Dataset({"a/b": 1}), ValueError, "without slash"),
        (xr.Dataset({"a": ("b/c", [1])}), ValueError, "without slash .*b/c"),
        (xr.Dataset({"row": (("row", "column"), np.eye(2))}), ValueError, "found row"),
        (
            xr.Dataset({"a": ("x", np.array(["2026"], "M8[ns]"))}),
            TypeError,
            "a needs numbers or texts",
        ),
        (xr.Dataset({"a": ("x", np.array([1 + 1j]))}), TypeError, "a needs numbers or texts"),
        (xr.Dataset({"a": ("x", np.array([b"a", None]))}), TypeError, "a needs numbers or texts"),
        (xr.Dataset(attrs={"a": {"b": 1}}), TypeError, "a needs numbers or texts"),
        (xr.Dataset(attrs={"a": None}), TypeError, "a needs numbers or texts"),
    ],
)
def test_what_netcdf_does_not_have_is_refused_by_name(data, error, needed):
    with pytest.raises(error, match=needed):
        netcdf.write_netcdf(data, io.BytesIO())


# ---- damage


def test_a_bit_flipped_anywhere_is_an_error_that_names_the_file_or_without_effect(
    study_folder, tmp_path
):
    rng, path, calls = random.Random(0), tmp_path / "a.nc", 0
    files = sorted(study_folder.rglob("*.nc"))
    for _ in range(300):
        file = rng.choice(files)
        data, key = file.read_bytes(), netcdf.attributes(file)["task_key"]
        path.write_bytes(flipped(data, rng.randrange(8 * len(data))))
        try:
            assert netcdf.read(path).identical(netcdf.read(file))
        except OSError as error:
            assert "a.nc cannot be read" in str(error)  # noqa: PT017
            assert "run the analysis again" in str(error)  # noqa: PT017
            assert not netcdf.is_done(path, key)
            calls += 1
    assert calls > 150


def test_a_truncated_file_is_an_error(file):
    data = file.read_bytes()
    for share in (0, 0.001, 0.02, 0.3, 0.6, 0.9, 0.999):
        file.write_bytes(data[: int(share * len(data))])
        assert not netcdf.is_done(file, "key")
        with pytest.raises(OSError, match=r"a\.nc cannot be read"):
            netcdf.read(file)


def test_a_larger_variable_is_checked_when_it_is_read_and_not_before(file):
    with h5py.File(file) as inside:
        at = inside["position"].id.get_chunk_info(0).byte_offset
    file.write_bytes(flipped(file.read_bytes(), 8 * at + 800))
    data = netcdf.open_file(file)
    assert data["position"].shape == (500, 3)
    with pytest.raises(OSError, match=r"a\.nc cannot be read .*filter"):
        data["position"].load()


def test_a_run_recomputes_damaged_files_only_with_the_same_bytes(brains, folder):
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
        b'{"costs": {"a": [1, 2, 3]}}',
        b'{"costs": {"a": ["x", 1]}}',
        b"\xff\xfe",
        b"[" * 100_000,
        b"null",
    ],
)
def test_damaged_costs_are_reported_and_ignored(tmp_path, caplog, content):
    (tmp_path / "costs.json").write_bytes(content)
    assert read_costs(tmp_path / "costs.json") == {}
    assert "times of earlier runs are not counted" in caplog.text


# ---- files of strangers


def external_storage(file, secret):
    file.create_dataset("position", (1500,), "f8", external=[(str(secret), 0, 12000)])


def external_link(file, secret):
    file["position"] = h5py.ExternalLink(str(secret), "/age")


def soft_link(file, secret):
    file["position"] = h5py.SoftLink("/corner_vertex")


def virtual(file, secret):
    layout = h5py.VirtualLayout(shape=(500, 3), dtype="f8")
    layout[:] = h5py.VirtualSource(str(secret), "age", shape=(500, 3))
    file.create_virtual_dataset("position", layout)


def packed(file, secret):
    file.create_dataset("position", (2**40,), "u1", chunks=(2**20,), compression="gzip")


def never_written(file, secret):
    file.create_dataset("position", (2**50,), "f8")


def group(file, secret):
    file.create_group("position")


def compound(file, secret):
    file["position"] = np.zeros(3, [("a", "f8"), ("b", "i4")])


def other_shape(file, secret):
    file["position"] = np.zeros((3, 3))


STRANGE = [external_storage, external_link, soft_link, virtual, packed, never_written, group]
STRANGE += [compound, other_shape]


def test_what_leads_out_of_a_file_or_unpacks_is_refused_before_it_is_read(file, tmp_path):
    secret, whole = tmp_path / "diary", file.read_bytes()
    secret.write_bytes(SECRET)
    for strange in STRANGE:
        rewritten(file, whole)
        with h5py.File(file, "a") as inside:
            del inside["position"]
            strange(inside, secret)
        with pytest.raises(OSError, match=r"a\.nc cannot be read") as result:
            netcdf.read(file)
        assert "diary" not in str(result.value), strange
        assert not netcdf.is_done(file, "key"), strange


def with_contents(path, change):
    """Write other contents into a file, as somebody could who knows how."""
    with netcdf.opened(path) as (_, text, _):
        text = np.frombuffer(change(text.decode()).encode(), "u1")
    with h5py.File(path, "a") as inside:
        del inside[netcdf.CONTENTS]
        inside[netcdf.CONTENTS] = text


TEXTS = '", "'.join(["x" * 10**6, *[""] * 10**5])
MANY = '"variables": {"a": {"dims": ["b"], "shape": [100001], "dtype": "U", "attrs": {}, "values": '
MANY += f'["{TEXTS}"]}}, '
LIES = {
    "another size": lambda text: text.replace("[500, 3]", "[1000000000, 3]"),
    "objects": lambda text: text.replace("<f8", "|O8"),
    "a dim too few": lambda text: text.replace('["vertex", "xyz"]', '["vertex"]'),
    "cut off": lambda text: text[:-9],
    "no group": lambda text: "{}",
    "more text than there can be": lambda text: text.replace('"variables": {', MANY, 1),
}


def test_contents_that_cannot_be_are_refused(file):
    whole = file.read_bytes()
    for lie in LIES.values():
        rewritten(file, whole)
        with_contents(file, lie)
        with pytest.raises(OSError, match=r"a\.nc cannot be read"):
            netcdf.read(file)


def test_a_file_of_another_version_is_named_and_computed_again(file):
    synthetic.sphere(50).to_netcdf(file, engine="h5netcdf")
    assert not netcdf.is_done(file, "key")
    with pytest.raises(OSError, match=r"another version of s4a wrote it.*remove it"):
        netcdf.read(file)


@pytest.mark.parametrize("path", ["original", "original/brain_01.nc"])
def test_symbolic_links_within_a_study_are_not_followed(folder, tmp_path, path):
    (folder / path).rename(tmp_path / "elsewhere")
    (folder / path).symlink_to(tmp_path / "elsewhere")
    with pytest.raises((ValueError, OSError), match=f"{path}.* symbolic link"):
        open_study(folder)
    whole = tmp_path / "link"
    (folder / path).unlink()
    (tmp_path / "elsewhere").rename(folder / path)
    whole.symlink_to(folder)
    assert "pca" in open_study(whole)  # the study itself may be a link


IN_STUDY = [
    (["view"], "study.html"),
    (["statistics"], "statistics"),
    (["statistics"], "statistics/evaluation.csv"),
    (["run", "absent.ply", "--out"], "report.txt"),
]


@pytest.mark.parametrize("kind", ["symbolic link", "pipe"])
def test_what_is_no_file_in_a_study_is_not_written_to(folder, tmp_path, capsys, kind):
    if kind == "pipe" and not hasattr(os, "mkfifo"):
        pytest.skip("this system has no pipes")
    (tmp_path / "diary").write_text("mine")
    for command, name in IN_STUDY:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        os.mkfifo(path) if kind == "pipe" else path.symlink_to(tmp_path / "diary")
        assert cli.main([*command, str(folder)]) == 2
        assert f"{name} is a {kind}" in capsys.readouterr().err
        path.unlink()
    assert (tmp_path / "diary").read_text() == "mine"


def test_a_study_with_a_damaged_file_is_not_opened_and_the_file_is_named(folder, capsys):
    for name in ("registration/brain_03", "registration", "original/brain_01"):  # read before
        path = folder / f"{name}.nc"
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(OSError, match=f"{name}.nc cannot be read"):
            open_study(folder)
    assert cli.main(["statistics", str(folder)]) == 2
    assert "original/brain_01.nc cannot be read" in capsys.readouterr().err


def test_a_report_of_somebody_else_in_a_study_is_not_overwritten(tmp_path):
    (tmp_path / ".lock").touch()
    synthetic.sphere(50).to_netcdf(tmp_path / "report.nc", engine="h5netcdf")
    before = (tmp_path / "report.nc").read_bytes()
    with pytest.raises(ValueError, match=r"report\.nc was not made by s4a"), store.lock(tmp_path):
        pass
    assert (tmp_path / "report.nc").read_bytes() == before


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
def test_a_pipe_instead_of_a_file_does_not_block(file):
    file.unlink()
    os.mkfifo(file)
    assert not netcdf.is_done(file, "key")
    with pytest.raises(OSError, match="not a regular file"):
        netcdf.open_file(file)


# ---- what a file holds


def without(name):
    return lambda data: data.drop_vars(name)


def as_text(name):
    return lambda data: data.assign({name: data[name].astype(str)})


def beyond(name):
    return lambda data: data.assign({name: data[name] + 10_000_000})


CHANGES = [
    ("original/brain_01", without("position"), "missing variables position"),
    ("original/brain_01", beyond("corner_vertex"), "corner_vertex needs indices 0..1499 of vertex"),
    ("original/brain_01", as_text("position"), "position needs numbers"),
    ("original/brain_01", lambda d: d.rename(xyz="abc"), "position needs the dims"),
    ("original/brain_01", lambda d: d.isel(xyz=[0, 1]), "xyz needs 3 entries, found 2"),
    ("original/brain_01", lambda d: d.drop_attrs(), "the attribute status needs a text"),
    ("coarse/brain_01", beyond("coarse_vertex"), "coarse_vertex needs indices"),
    ("coarse/brain_01", beyond("sample_vertex"), "sample_vertex needs indices"),
    ("coarse/brain_01", without("eigenvalue"), "missing variables eigenvalue"),
    ("coarse/brain_01", lambda d: d.isel(original_vertex=slice(900)), "needs indices|needs 1500"),
    ("latent", without("latent_basis"), "missing variables latent_basis"),
    ("latent", without("shape"), "missing variables shape"),
    ("latent", lambda d: d.assign_coords(shape=["brain_01"] * 4), "unique names"),
    ("registration", lambda d: d.drop_attrs(), "the attribute template needs a text"),
    ("registration", lambda d: d.isel(triangle=slice(9)), "triangle needs"),
    ("registration/brain_01", beyond("registered_match"), "registered_match needs indices"),
    ("registration/brain_01", beyond("template_triangle"), "template_triangle needs indices"),
    ("registration/brain_01", lambda d: d.isel(vertex=slice(9)), "vertex needs"),
    ("registration/brain_01", lambda d: d.assign_attrs(score="?"), "score needs a number"),
    ("pca", without("score"), "missing variables score"),
    ("pca", lambda d: d.isel(vertex=slice(9)), "vertex needs"),
    ("report", without("status"), "missing variables status"),
    ("report", lambda d: d.isel(shape=[0, 0, 1, 2]), "unique names"),
]


def test_files_that_do_not_hold_what_they_should_are_named_with_what(folder):
    misfits = []
    for name, change, message in CHANGES:
        path = folder / f"{name}.nc"
        whole, data = path.read_bytes(), netcdf.read(path)
        key, made_from = data.attrs.pop("task_key"), data.attrs.pop("made_from").split()
        store.write(change(data), path, key, made_from)
        with pytest.raises(OSError, match=message):
            open_study(folder).load()
        if check_file(Reader(folder), name)[0] != "damaged":
            misfits.append(path.read_bytes())
        rewritten(path, whole)
    assert len(misfits) == 4
    rewritten(folder / "pca.nc", misfits[-1])  # which does not fit the files it was made from
    assert verify(folder)["state"].sel(file="pca.nc").item() == "damaged"


# ---- verify


def test_files_exchanged_within_a_study_are_refused_by_name(folder):
    kinds = ["original/", "coarse/", "registration/"]
    kinds += [f"network/{kind}_" for kind in ("descriptor", "comparison", "alignment")]
    for kind in kinds:
        a, b = (folder / f"{kind}brain_0{i}.nc" for i in (1, 2))
        a.rename(folder / "c")
        b.rename(a)
        (folder / "c").rename(b)
        with pytest.raises(OSError, match="holds brain_02, is named brain_01"):
            Reader(folder).open(f"{kind}brain_01", netcdf.open_file)
    with pytest.raises(OSError, match="holds brain_02, is named brain_01"):
        open_study(folder)
    found = verify(folder)
    assert (found["state"].values == "damaged").sum() == 2 * len(kinds)
    assert (found["state"].values != "whole").sum() == 2 * len(kinds)


def test_a_file_under_the_name_of_another_is_refused(folder):
    shutil.copy(folder / "network.nc", folder / "latent.nc")
    with pytest.raises(OSError, match="holds network, is named latent: files were exchanged"):
        open_study(folder)


def test_files_made_from_files_of_another_run_are_stale(folder):
    path = folder / "registration" / "brain_01.nc"
    data = netcdf.read(path)
    registration = netcdf.attributes(folder / "registration.nc")["task_key"]
    coarse = netcdf.attributes(folder / "coarse/brain_01.nc")["task_key"]
    made_from = f"registration={registration} coarse/brain_01={coarse}"
    assert data.attrs["made_from"] == made_from
    store.write(data, path, data.attrs["task_key"], [f"latent={registration}"])
    other = folder / "original/brain_02.nc"
    store.write(netcdf.read(other), other, "another key")
    state = verify(folder)["state"]
    assert state.sel(file="registration/brain_01.nc").item() == "stale"
    assert state.sel(file="coarse/brain_02.nc").item() == "stale"


def test_verify_prints_one_line_and_has_an_exit_code(folder, capsys):
    assert cli.main(["verify", str(folder)]) == 0
    n = len(list(folder.rglob("[!.]*.nc")))
    assert f"{n} files: {n} whole" in capsys.readouterr().out
    (folder / "notes.txt").write_text("mine")
    shutil.copy(folder / "original/brain_01.nc", folder / "original/other.nc")
    (folder / "network/alignment_brain_04.nc").unlink()
    path = folder / "pca.nc"
    path.write_bytes(path.read_bytes()[:-9])
    assert cli.main(["verify", str(folder)]) == 1
    first, *lines = capsys.readouterr().out.splitlines()
    assert "1 damaged" in first
    assert "1 missing" in first
    assert "run the same `s4a run` again to compute these files again" in first
    assert sorted(line.split(",")[0].strip() for line in lines) == [
        "network/alignment_brain_04.nc",
        "notes.txt",
        "original/other.nc",
        "pca.nc",
    ]


def test_verify_does_not_blame_what_was_made_from_a_damaged_file(folder):
    names = ["coarse/brain_03.nc", "original/brain_01.nc", "registration/brain_02.nc"]
    for name in names[1:]:
        path = folder / name
        path.write_bytes(flipped(path.read_bytes(), 8 * 100))
    with h5py.File(folder / names[0], "a") as file:  # which differs from its contents now
        file["position"].attrs["units"] = "m"
    (folder / "report.nc").unlink()  # as where a study is not finished
    result = verify(folder)
    state = result["state"]
    assert sorted(result["file"].values[state.values == "damaged"]) == names
    assert result["file"].values[state.values == "missing"].tolist() == ["report.nc"]
    assert (state.values == "whole").sum() == state.size - 4
    differ = "the contents differ from the HDF5 data"
    assert differ in result["fault"].sel(file=names[0]).item()


def test_texts_that_share_bytes_of_a_file_are_refused(tmp_path):
    n, path = 1000, tmp_path / "a.nc"
    with h5py.File(path, "w") as file:
        texts = file.create_dataset("text", (n,), h5py.string_dtype())
        texts[0] = "a" * 2**20
        at = texts.id.get_offset()
    data = path.read_bytes()  # every text is a reference of 16 bytes
    path.write_bytes(data[:at] + n * data[at : at + 16] + data[at + 16 * n :])
    with pytest.raises(OSError, match="text has more text than its file"):
        netcdf.open_plain(path)
