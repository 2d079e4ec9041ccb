"""Runs that end before their time.

Nothing goes on behind them, nothing is damaged, the next one goes on.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from s4a import analyse, open_study, synthetic
from s4a.schema import dataset
from s4a.study import store
from s4a.study.runner import Run

OPTIONS = {"n_coarse": 150, "k_init": 8, "k": 12}
RUN = """
import signal, sys, time
from s4a import analyse
from s4a.study import pipeline

# it is ignored below a background job of a shell
signal.signal(signal.SIGINT, signal.default_int_handler)

def slow(*arguments, task=pipeline.remesh_shape):
    time.sleep(2)
    return task(*arguments)

if __name__ == "__main__":
    pipeline.remesh_shape = slow
    analyse(sys.argv[2:], store=sys.argv[1], n_coarse=150, k_init=8, k=12, n_jobs=2)
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return synthetic.write(synthetic.brains(3, 300, seed=2), tmp_path_factory.mktemp("files"))


@contextlib.contextmanager
def running(folder, files):
    """A run in a session of its own, with two workers in the middle of their tasks.

    Gives it and their processes.
    """
    arguments = [sys.executable, "-c", RUN, str(folder), *map(str, files)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(arguments, start_new_session=True, **quiet) as run:
        try:
            deadline = time.monotonic() + 120
            while len(list(folder.glob("original/[!.]*.nc"))) < len(files):
                assert run.poll() is None, run.stderr.read().decode()
                assert time.monotonic() < deadline
                time.sleep(0.05)
            time.sleep(1)
            yield run, psutil.Process(run.pid).children(recursive=True)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_are_gone_within_seconds_of_the_end_of_a_run_and_the_study_is_resumable(
    files, tmp_path, how
):
    folder, files = tmp_path / "study", files[:2]
    with running(folder, files) as (run, workers):
        assert len(workers) >= 2
        os.kill(run.pid, how)  # as from a notebook: the workers do not get it
        run.wait(timeout=20)
        _, alive = psutil.wait_procs(workers, timeout=20)
        assert not [p for p in alive if p.status() != psutil.STATUS_ZOMBIE]
        assert run.returncode != 0
    assert not (folder / "report.nc").exists()
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("[!.]*.nc")}
    assert len(before) >= len(files)
    with analyse(files, store=folder, n_jobs=1, **OPTIONS) as tree:
        assert tree["registration"].sizes["shape"] == 2
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert not list(folder.rglob(".*.tmp"))


KILLED = """
import os, signal, sys
from pathlib import Path
from s4a import synthetic
from s4a import cli
from s4a.study import store

log, out, rename, kills = Path(sys.argv[1]), Path(sys.argv[2]), os.replace, sys.argv[3].split(",")

def renamed(temporary, path):
    file = path.relative_to(out).as_posix()
    now = kills[:1] == [file]
    with log.open("a") as told:
        told.write(f"{'killed' if now else 'written'} {file}\\n")
    if now:  # before the finished file gets its name
        os.kill(os.getpid(), signal.SIGKILL)
    rename(temporary, path)

log.write_text("")
# imports all that the runs below need, once
store.write(synthetic.sphere(9), log.with_suffix(".nc"))
store.attributes(log.with_suffix(".nc"))
os.replace = renamed
code = -signal.SIGKILL
while code == -signal.SIGKILL:
    run = os.fork()  # nothing is imported again
    if not run:
        os._exit(cli.main(["run", *sys.argv[4:], "--out", str(out)]))
    code = os.waitstatus_to_exitcode(os.waitpid(run, 0)[1])
    kills = kills[1:]
sys.exit(code)
"""
KILLS = [
    "original/brain_02.nc",  # read and clean
    "network/look_brain_02.nc",  # compare
    "coarse/brain_02.nc",  # remesh and spectrum
    "network/motion_brain_02.nc",  # align
    "network/first_000.nc",  # first maps
    "network.nc",  # consistent ZoomOut and median
    "latent.nc",
    "registration.nc",  # registration
    "registration/brain_02.nc",
    "pca.nc",  # modes
    "report.nc",
]


def test_a_run_killed_in_every_stage_ends_with_the_same_study(files, tmp_path):
    flags = [
        "--n-coarse",
        "150",
        "--k-init",
        "8",
        "--k",
        "12",
        "--n-jobs",
        "1",
        "--no-intersections",
    ]
    script = [
        sys.executable,
        "-c",
        KILLED,
        tmp_path / "log",
        tmp_path / "study",
        ",".join(KILLS),
        *files,
        *flags,
    ]
    subprocess.run(script, check=True, capture_output=True)
    told = (tmp_path / "log").read_text().splitlines()
    assert [line for line in told if line[:6] == "killed"] == [f"killed {file}" for file in KILLS]
    found = contents(tmp_path / "study")
    shared = {
        "network.nc",
        "registration.nc",
        "pca.nc",
    }  # of two files or none a task: made again, and the same
    for file in set(found) - shared:
        assert told.count(f"written {file}") == 1, file
    assert not list((tmp_path / "study").rglob(".*.tmp"))
    analyse(files, store=tmp_path / "whole", intersections=False, **OPTIONS).close()
    whole = contents(tmp_path / "whole")
    assert sorted(found) == sorted(whole)
    for file, data in whole.items():
        assert data.identical(found[file]), file


def contents(folder):
    """Every file of a study, without what the clock says."""
    files = {
        path.relative_to(folder).as_posix(): store.read(path) for path in folder.rglob("[!.]*.nc")
    }
    times = ["seconds", "peak_memory"]
    return {
        file: data.drop_vars(times) if file == "report.nc" else data for file, data in files.items()
    }


def test_a_worker_of_a_run_that_is_over_writes_nothing(tmp_path):
    with store.lock(tmp_path) as old:
        store.write(synthetic.sphere(50), tmp_path / "a.nc", "key", claim=old)
    with store.lock(tmp_path) as new:
        with pytest.raises(ValueError, match=f"the run of process {os.getpid()} no longer holds"):
            store.write(synthetic.sphere(60), tmp_path / "a.nc", "key", claim=old)
        assert store.read(tmp_path / "a.nc").sizes["vertex"] == 50
        store.write(synthetic.sphere(60), tmp_path / "a.nc", "key", claim=new)
    assert store.read(tmp_path / "a.nc").sizes["vertex"] == 60
    assert not list(tmp_path.glob(".*.tmp"))


def test_costs_add_up_over_the_runs_that_share_a_stage_and_stay_where_nothing_is_left_to_do(
    tmp_path,
):
    with store.lock(tmp_path) as claim:
        Run(claim, 1).costs_file.write_text(
            '{"a": [5.0, 7000000.0], "b": [5.0, 7.0], "c": [5.0, 7.0]}'
        )
        run = Run(claim, 1)
        for name, share in {"a": 0.5, "b": 0.0, "c": 1.0}.items():
            with run.stage(name, share):
                time.sleep(0.01)
        with pytest.raises(KeyboardInterrupt), run.stage("d"):
            raise KeyboardInterrupt
        costs = Run(claim, 1).costs
        assert 5.01 <= costs["a"][0] < 6
        assert costs["a"][1] == 7e6
        assert costs["b"] == [5, 7]
        assert 0.01 <= costs["c"][0] < 5
        assert costs["c"][1] > 10
        assert "d" in costs


def test_a_study_knows_the_files_in_a_folder_that_was_renamed(files, tmp_path):
    meshes = synthetic.write(synthetic.brains(2, 300), tmp_path / "before")
    analyse(meshes, store=tmp_path / "study", **OPTIONS).close()
    (tmp_path / "before").rename(tmp_path / "after")
    with analyse(tmp_path / "after" / "*.ply", store=tmp_path / "study", **OPTIONS) as tree:
        paths = [str(tmp_path / "after" / p.name) for p in meshes]
        assert tree["report"]["path"].values.tolist() == paths
        assert [tree[f"original/{n}"].attrs["path"] for n in tree["original"]] == paths


def test_another_version_computes_again(tmp_path, monkeypatch):
    path = tmp_path / "a.nc"
    store.write(synthetic.sphere(50), path, store.task_key("content"))
    assert store.is_done(path, store.task_key("content"))
    monkeypatch.setattr(store, "VERSION", "999.0")
    assert not store.is_done(path, store.task_key("content"))


FULL = """
import resource, sys
from s4a import cli
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
small = ["--n-coarse", "150", "--k-init", "8", "--k", "12", "--no-intersections"]
small += ["--n-jobs", sys.argv[1]]
sys.exit(cli.main(["run", *sys.argv[3:], "--out", sys.argv[2], *small]))
"""


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_a_disk_that_takes_no_more_ends_in_one_error_and_leaves_whole_files(
    files, tmp_path, n_jobs
):
    folder = tmp_path / "study"
    arguments = [sys.executable, "-c", FULL, str(n_jobs), str(folder), *map(str, files[:2])]
    found = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert found.returncode == 2, found.stderr
    lines = [line for line in found.stderr.splitlines() if line.startswith("s4a: ")]
    assert len(lines) == 1, found.stderr
    assert "cannot be written" in lines[0]
    assert "goes on where it stopped" in lines[0]
    whole = sorted(folder.rglob("[!.]*.nc"))
    assert whole
    assert all(store.attributes(path)["task_key"] for path in whole)
    assert not list(folder.rglob(".*.tmp"))


def test_a_folder_that_cannot_be_written_is_one_error(tmp_path, monkeypatch):
    store.write(synthetic.sphere(50), tmp_path / "a.nc", "key")

    def refused(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "replace", refused)
    with pytest.raises(
        OSError, match=r"a.nc cannot be written .*Permission denied.*Finished files are whole"
    ):
        store.write(synthetic.sphere(60), tmp_path / "a.nc", "key")
    assert store.read(tmp_path / "a.nc").sizes["vertex"] == 50
    assert [p.name for p in tmp_path.iterdir()] == ["a.nc"]


def test_names_that_lead_out_of_a_study_are_left_out(tmp_path, caplog):
    folder, outside = tmp_path / "study", tmp_path / "outside.nc"
    mesh = synthetic.sphere(50)
    store.write(mesh, folder / "original" / "a.nc")
    store.write(
        dataset(latent_eigenvalue=[0.0, 1.0]).assign_coords(shape=["a", "../../outside"]),
        folder / "latent.nc",
    )
    store.write(mesh.assign_attrs(template="../../outside"), folder / "registration.nc")
    store.write(mesh, outside)
    with open_study(folder) as tree:
        assert list(tree.children) == ["original"]
    assert "shapes need names of letters, digits, _ and -; found ['../../outside']" in caplog.text
