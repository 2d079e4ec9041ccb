"""Files that are no regular files, names that forge lines or are too long: each costs itself."""

import contextlib
import io
import os
import re
import socket
import sys

import numpy as np
import pytest
from faults.shapes import shape

from s4a import cli, open_study, read_mesh, read_shapes, write_mesh
from s4a.input.annotations import read_labels, read_landmarks
from s4a.input.files import find_meshes, not_meshes
from s4a.input.raw import LARGEST_FILE, read_bytes, shown
from s4a.input.subjects import read_table

if sys.platform == "win32":
    pytest.skip("pipes, links and such names are those of POSIX", allow_module_level=True)

FORGED = "f\ngood_0  excluded\x1b[2J\u202eylp.ply"  # what its name would write
LONG = "n" * 249
IRREGULAR = {  # file -> message
    "pipe.ply": "found a named pipe",
    "pipe_labels.gii": "found a named pipe",
    "pipe_arrays.npz": "found a named pipe",
    "zero.ply": "found a device",
    "socket.ply": "found a socket",
    "broken.ply": "found a broken link to nowhere.ply",
    "loop.ply": "cannot be opened or read: Too many levels of symbolic links",
    "sparse.ply": "a file of at most 2 GiB expected, found a larger one",
}
SMALL = ["--n-coarse", "100", "--k-init", "6", "--k", "10", "--step", "4", "--refine", "intrinsic"]


def make_irregular(folder):
    for name in ("pipe.ply", "pipe_labels.gii", "pipe_arrays.npz"):
        os.mkfifo(folder / name)
    (folder / "zero.ply").symlink_to("/dev/zero")
    (folder / "broken.ply").symlink_to("nowhere.ply")
    (folder / "loop.ply").symlink_to("loop.ply")
    with open(folder / "sparse.ply", "wb") as file:
        file.truncate(LARGEST_FILE + 1)
    before = os.getcwd()
    os.chdir(folder)  # the path of a socket has 108 bytes
    with socket.socket(socket.AF_UNIX) as one:
        one.bind("socket.ply")
    os.chdir(before)


def make_named(folder):
    """Good shapes with names that are not."""
    names = [FORGED, f"{LONG}1.ply", f"{LONG}2.ply", "脳" * 80 + ".ply", "One.ply", "one.ply"]
    for i, name in enumerate(names):
        write_mesh(folder / name, *shape(i + 20))
    with contextlib.suppress(OSError):  # a file system may want UTF-8
        (folder / os.fsdecode(b"caf\xe9.ply")).write_bytes((folder / "one.ply").read_bytes())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("irregular")
    make_irregular(folder)
    make_named(folder)
    (folder / "folder.ply").mkdir()
    (folder / "elsewhere").symlink_to("/")
    for i in range(3):
        write_mesh(folder / f"good_{i}.ply", *shape(i))
    return folder


def printed(*arguments):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = cli.main(list(map(str, arguments)))
    return code, out.getvalue()


def test_what_is_no_regular_file_costs_itself_and_is_named_with_the_reason(folder):
    report = read_shapes(folder, compare=False)["report"].to_dataset()
    excluded = report["status"] == "excluded"
    assert sorted(report["shape"].values[excluded]) == sorted(
        name.partition(".")[0] for name in IRREGULAR
    )
    for name, message in IRREGULAR.items():
        assert message in report["reason"].sel(shape=name.partition(".")[0]).item()
    assert (
        "folder.ply is not a mesh (a folder, and its files were searched)"
        in (report.attrs["remarks"])
    )
    assert (
        "elsewhere is not a mesh (a link to a folder, which is not followed)"
        in (report.attrs["remarks"])
    )


def test_what_is_no_regular_file_is_refused_at_once_by_every_reader(folder):
    for name, message in IRREGULAR.items():
        for read in (read_mesh, read_labels, read_landmarks, lambda path: read_table(path, ["a"])):
            expected = rf"{name} cannot be read as .*{re.escape(message)}"
            with pytest.raises(ValueError, match=expected):
                read(folder / name)
        assert find_meshes(folder / name)[0][0].name == name  # named by itself, it is tried


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs users")
def test_a_file_that_may_not_be_read_is_named(tmp_path):
    write_mesh(tmp_path / "secret.ply", *shape())
    (tmp_path / "secret.ply").chmod(0)
    root = os.geteuid() == 0  # can read in spite of any mode
    if root:
        os.seteuid(65534)
    try:
        with pytest.raises(ValueError, match=r"secret.ply cannot be read as mesh.*Permission"):
            read_mesh(tmp_path / "secret.ply")
    finally:
        if root:
            os.seteuid(0)


@pytest.mark.skipif(not os.path.exists("/proc/self/mem"), reason="needs a file that fails")
def test_a_file_that_fails_while_it_is_read_is_named(tmp_path):
    (tmp_path / "a.ply").symlink_to("/proc/self/mem")
    with pytest.raises(ValueError, match=r"a.ply cannot be read as mesh: .*Input/output error"):
        read_mesh(tmp_path / "a.ply")


def test_a_folder_that_cannot_be_searched_is_reported(tmp_path, monkeypatch):
    write_mesh(tmp_path / "a.ply", *shape())
    (tmp_path / "shut").mkdir()
    scandir = os.scandir

    def refuse(path):
        if str(path).endswith("shut"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    assert [(path.name, why) for path, why in not_meshes(tmp_path, "a*")] == [
        ("shut", "a folder that cannot be searched: Permission denied")
    ]


def test_names_of_shapes_are_unique_and_short_enough_for_the_files_of_a_study(folder):
    names = [name for _, name in find_meshes(folder)]
    assert len({name.casefold() for name in names}) == len(names)
    assert max(map(len, names)) == 100
    remarks = read_shapes(folder, compare=False)["report"].attrs["remarks"]
    assert remarks.count("names of shapes have at most 100 characters") == 3
    alone = dict(find_meshes(folder, f"{LONG}1"))  # the name does not depend on other files
    assert set(alone.values()) < set(names)


def test_a_name_cannot_add_a_line(folder):
    code, text = printed("check", folder, "--no-intersections")
    assert code == 1  # as shapes were excluded
    assert "\x1b" not in text
    assert "\u202e" not in text
    assert not re.search(r"^good_0 +excluded", text, re.M)
    report = read_shapes(folder, compare=False)["report"].to_dataset()
    for name in ("path", "reason", "warning"):
        assert all(text.isprintable() for text in report[name].values.tolist()), name
    assert all(line.isprintable() for line in report.attrs["remarks"].splitlines())
    assert shown(FORGED) in report["path"].sel(shape="f_good_0__excluded__2Ju202eylp").item()


def test_a_run_over_them_has_the_results_of_the_good_ones_alone(tmp_path):
    more = "--n-jobs 1 --no-intersections --template good_0".split()
    for name in ("all", "few"):
        (tmp_path / name).mkdir()
        for i, file in enumerate(["good_0.ply", FORGED, f"{LONG}1.ply", "one.ply"]):
            write_mesh(tmp_path / name / file, *shape(i))
    make_irregular(tmp_path / "all")
    found = []
    for name in ("all", "few"):
        out = tmp_path / f"study_of_{name}"
        assert printed("run", tmp_path / name, "--out", out, *SMALL, *more)[0] == 0
        found.append(open_study(out))
    reasons = found[0]["report"]["reason"].values.tolist()
    for name, message in IRREGULAR.items():
        reason = next(reason for reason in reasons if f"/{name} cannot be read" in reason)
        assert message in reason
    result, expected = (study["pca"]["score"] for study in found)
    assert result["shape"].values.tolist() == expected["shape"].values.tolist()
    assert np.array_equal(result, expected)


def test_a_file_that_says_it_is_empty_is_read_to_its_end():
    if os.path.exists("/proc/self/status"):
        assert b"VmSize" in read_bytes("/proc/self/status")
