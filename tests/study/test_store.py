"""A study on disk: keys, complete files, one run at a time, round trips."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from s4a import open_study, synthetic
from s4a.schema import dataset
from s4a.study import netcdf, store

PARTS = ["content", 3, 2.5, None, True, [1, 2], {"a": 1}, np.arange(4), b"bytes"]


def test_a_key_is_the_same_for_the_same_parts():
    assert store.task_key(*PARTS) == store.task_key(*PARTS)
    assert store.task_key({"a": 1, "b": 2}) == store.task_key({"b": 2, "a": 1})


def test_a_key_changes_with_the_order_and_the_limits_of_the_parts():
    assert store.task_key("a", "b") != store.task_key("b", "a")
    assert store.task_key("ab") != store.task_key("a", "b")
    assert store.task_key(b"a\0b") != store.task_key(b"a", b"b")
    assert store.task_key('"a"') != store.task_key(b'"a"')
    assert store.task_key(np.zeros((2, 3))) != store.task_key(np.zeros((3, 2)))


def test_numpy_numbers_make_the_key_of_the_numbers():
    assert store.task_key(np.int64(3), np.float64(2.5), np.bool_(True)) == store.task_key(
        3, 2.5, True
    )


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "shape.nc"
    store.write(synthetic.sphere(200), path, "key")
    return path


def test_a_written_file_is_done_for_its_key_and_no_other(file):
    assert netcdf.is_done(file, "key")
    assert not netcdf.is_done(file, "other")
    assert not netcdf.is_done(file.with_name("absent.nc"), "key")


def test_a_foreign_file_is_not_done(file):
    for content in (
        b"",
        b"ply\nformat ascii 1.0\n",
        b"\0" * 4096,
        b"\x89HDF\r\n\x1a\n",
        b"CDF\x01",
    ):
        file.write_bytes(content)
        assert not netcdf.is_done(file, "key")


def test_a_write_that_fails_leaves_the_old_file_and_nothing_temporary(file):
    bad = synthetic.sphere(100).assign_attrs(broken=object())
    with pytest.raises(TypeError):
        store.write(bad, file, "again")
    assert [f.name for f in file.parent.iterdir()] == ["shape.nc"]
    assert netcdf.is_done(file, "key")


HOLDER = """
import sys
from s4a.study import netcdf, store
with store.lock(sys.argv[1]):
    sys.stdout.write("held\\n")
    sys.stdout.flush()
    sys.stdin.read()
"""


def test_a_second_process_is_refused_while_the_first_holds_the_folder_and_let_in_when_it_is_killed(
    tmp_path,
):
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as first:
        assert first.stdout.readline() == "held\n"
        with (
            pytest.raises(ValueError, match=f"process {first.pid}.*another folder"),
            store.lock(tmp_path),
        ):
            pass
        first.kill()
        first.wait()
        with store.lock(tmp_path):
            pass
    with store.lock(tmp_path):  # and again
        pass


def test_what_a_killed_run_left_is_removed_by_the_next(file):
    left = file.with_name(".shape.nc.77.tmp")
    left.write_bytes(b"half")
    with store.lock(file.parent):
        assert not left.exists()
        assert netcdf.is_done(file, "key")


def test_what_is_not_a_study_is_refused(tmp_path):
    (tmp_path / "file").write_text("no")
    (tmp_path / "empty").mkdir()
    for name in ("none", "empty", "file"):
        with pytest.raises(ValueError, match="is not a study folder"):
            open_study(tmp_path / name)


def test_a_tree_survives_the_round_trip(study, tmp_path):
    file = tmp_path / "tree.nc"
    study.to_netcdf(file, engine="h5netcdf")
    with xr.open_datatree(file, engine="h5netcdf") as again:
        for node in study.subtree:
            expected = node.to_dataset(inherit=False)
            assert again[node.path].to_dataset(inherit=False).identical(expected), node.path


def test_an_unfinished_study_opens_with_what_is_there(study_folder, tmp_path):
    folder = shutil.copytree(study_folder, tmp_path / "study")
    (folder / "original" / ".c.nc.77.tmp").write_bytes(b"half")
    for name in ("registration/brain_02", "pca", "report"):
        (folder / f"{name}.nc").unlink()
    with open_study(folder) as tree:
        assert tree["registration"]["shape"].values.tolist() == ["brain_01", "brain_03", "brain_04"]
        assert "pca" not in tree
    (folder / "coarse/brain_02.nc").unlink()  # from which the network was made
    with open_study(folder) as tree:
        assert list(tree["coarse"].children) == ["brain_01", "brain_03", "brain_04"]
        assert list(tree["original"].children) == [f"brain_0{i}" for i in (1, 2, 3, 4)]
        assert "registration" not in tree


def test_a_registration_is_read_when_it_is_used_and_only_of_the_shapes_asked_for(
    study_folder, study, monkeypatch
):
    read, part = [], netcdf.Stored.part
    monkeypatch.setattr(
        netcdf.Stored,
        "part",
        lambda self, key: read.append((self.file.stem, self.path)) or part(self, key),
    )
    n_open = len(os.listdir("/proc/self/fd")) if sys.platform == "linux" else 0
    registration = open_study(study_folder)["registration"].to_dataset()
    names = registration["shape"].values.tolist()
    assert not [name for name in read if name[0] in names]
    assert n_open == (len(os.listdir("/proc/self/fd")) if sys.platform == "linux" else 0)
    one = registration["displacement"].sel(shape=names[2])
    read.clear()
    whole = study["registration"].to_dataset()
    assert one.identical(whole["displacement"].sel(shape=names[2]))
    assert read == [(names[2], "displacement")]
    assert registration.identical(whole)
    read.clear()
    assert registration.identical(whole)  # and is then kept
    assert read == []


def test_parts_of_a_registration_are_parts_of_the_whole(study_folder, study):
    whole = study["registration"]["displacement"]
    for part in (
        {"shape": 1},
        {"shape": -1, "vertex": 5},
        {"shape": [2, 0], "xyz": [1, 1]},
        {"shape": slice(None, None, -2), "vertex": slice(3, 40, 7)},
        {"shape": [], "vertex": [4, 2]},
        {"shape": 3, "vertex": [4, 2], "xyz": 0},
        {"vertex": [9, 3], "xyz": 2},
        {"shape": xr.DataArray([1, 2], dims="at"), "vertex": xr.DataArray([5, 6], dims="at")},
    ):
        lazy = open_study(study_folder)["registration"]["displacement"]
        assert lazy.isel(part).identical(whole.isel(part)), part
    lazy = open_study(study_folder)["registration"]["displacement"]
    lazy[1, :10] = 7.0  # in memory, and nowhere else
    assert (lazy[1, :10] == 7).all()
    assert lazy[0].identical(whole[0])
    assert open_study(study_folder)["registration"]["displacement"].identical(whole)


def test_a_file_written_again_after_it_was_opened_is_an_error(tmp_path):
    store.write(dataset(position=np.zeros((700, 3))), tmp_path / "a.nc", "k")
    result = netcdf.open_file(tmp_path / "a.nc")
    store.write(dataset(position=np.ones((700, 3))), tmp_path / "a.nc", "other")
    with pytest.raises(ValueError, match="written again since it was opened; open the study again"):
        result.load()


def test_a_file_removed_after_it_was_opened_is_named(tmp_path):
    store.write(dataset(position=np.zeros((700, 3))), tmp_path / "a.nc", "k")
    result = netcdf.open_file(tmp_path / "a.nc")
    (tmp_path / "a.nc").unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.nc was removed since it was opened: put it"):
        result.load()


def test_a_folder_with_files_of_somebody_else_is_refused_and_not_touched(tmp_path):
    (tmp_path / "original").mkdir()
    (tmp_path / "pca.nc").write_bytes(b"mine")
    synthetic.sphere(50).to_netcdf(tmp_path / "original" / "mine.nc", engine="h5netcdf")
    (tmp_path / "original" / ".draft.tmp").write_bytes(b"mine")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    message = r"is not a study and not empty \(it has original, pca.nc\): give a new or an empty"
    with pytest.raises(ValueError, match=message), store.lock(tmp_path):
        pass
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_study_that_was_copied_without_its_lock_is_still_a_study(tmp_path):
    mine = tmp_path / "original" / ".draft.tmp"
    store.write(synthetic.sphere(50), tmp_path / "original" / "a.nc", "key")
    mine.write_bytes(b"mine")
    with store.lock(tmp_path):
        assert mine.exists()  # only temporary files of s4a are removed


def test_a_lock_that_is_a_symbolic_link_is_not_followed(tmp_path):
    diary = tmp_path / "diary"
    diary.write_text("mine")
    folder = tmp_path / "study"
    folder.mkdir()
    (folder / ".lock").symlink_to(diary)
    with pytest.raises(OSError, match="cannot be written"), store.lock(folder):
        pass
    assert diary.read_text() == "mine"
