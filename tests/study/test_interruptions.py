"""Runs that end before their time.

Nothing goes on behind them, nothing is damaged, the next one goes on.
"""

import contextlib
import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from s4a import analyse, cli, open_study, synthetic
from s4a.schema import dataset
from s4a.study import netcdf, pipeline, processes, quality_control, sources, store, tasks
from s4a.study.progress import FILE
from s4a.study.runner import Run

# of meshes as coarse as these, some registrations are flagged; so there are modes all the same
OPTIONS = {"n_coarse": 150, "k_init": 8, "k": 12, "include_flagged": True}
FLAGS = "--n-coarse 150 --k-init 8 --k 12 --include-flagged --n-jobs 1".split()
# a task that holds Python's lock in native code
RUN = """
import ctypes, signal, sys
from s4a import analyse
from s4a.study import pipeline

# they are ignored below a background job of a shell, and below nohup
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

def slow(*arguments):
    ctypes.PyDLL(None).sleep(600)

if __name__ == "__main__":
    pipeline.remesh_shape = slow
    analyse(sys.argv[2:], store=sys.argv[1], n_coarse=150, k_init=8, k=12, n_jobs=2)
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return synthetic.write(synthetic.brains(3, 300, seed=2), tmp_path_factory.mktemp("files"))


@contextlib.contextmanager
def running(folder, files, n_files):
    """A run in a session of its own, as soon as it has two workers and has written so many files.

    Gives it and the processes that it started.
    """
    arguments = [sys.executable, "-c", RUN, str(folder), *map(str, files)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(arguments, start_new_session=True, **quiet) as run:
        try:
            deadline, started = time.monotonic() + 120, []
            while len(started) < 4 or len(list(folder.glob("*/[!.]*.nc"))) < n_files:
                assert run.poll() is None, run.stderr.read().decode()
                assert time.monotonic() < deadline
                time.sleep(0.01)
                started = psutil.Process(run.pid).children(recursive=True)
            if n_files:
                time.sleep(1)
            yield run, started
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)


def remains(pid):
    """What the workers of a process have in memory that all processes share."""
    return [
        p.name for p in Path("/dev/shm").glob("*") if re.search(rf"loky-{pid}-|_{pid}_", p.name)
    ]


IN_NATIVE_CODE = 4  # files that are written when workers are there; none: while they start


@pytest.mark.parametrize(
    "how, who, n_files",
    [
        (signal.SIGKILL, os.kill, 0),
        (signal.SIGINT, os.kill, IN_NATIVE_CODE),  # as from a notebook: the workers do not get it
        (signal.SIGKILL, os.kill, IN_NATIVE_CODE),  # SIGTERM ends it as suddenly
        (signal.SIGHUP, os.killpg, IN_NATIVE_CODE),  # as when a terminal is closed
    ],
)
def test_workers_end_within_seconds_of_a_run_and_leave_nothing(files, tmp_path, how, who, n_files):
    with running(tmp_path / "study", files[:2], n_files) as (run, started):
        who(run.pid, how)
        run.wait(timeout=20)
        _, alive = psutil.wait_procs(started, timeout=20)
        assert not [p for p in alive if p.status() != psutil.STATUS_ZOMBIE]
        assert run.returncode != 0
    if how != signal.SIGHUP:  # it ends what removes them; the next run in this folder does
        assert not remains(run.pid)


@pytest.fixture
def interruptible():
    """Ctrl-C raises KeyboardInterrupt, also where a shell began all this with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interruption_that_gets_lost_ends_the_run_after_the_task(files, tmp_path, monkeypatch):
    remesh_shape, before = pipeline.remesh_shape, signal.getsignal(signal.SIGINT)

    def losing(*arguments):
        with contextlib.suppress(KeyboardInterrupt):  # as Python does in a destructor
            signal.raise_signal(signal.SIGINT)
        return remesh_shape(*arguments)

    monkeypatch.setattr(pipeline, "remesh_shape", losing)
    with pytest.raises(KeyboardInterrupt):
        analyse(files[:2], store=tmp_path / "study", n_jobs=1, **OPTIONS)
    assert len(list(tmp_path.glob("study/coarse/[!.]*.nc"))) == 1
    assert signal.getsignal(signal.SIGINT) is before


def test_a_run_killed_with_its_workers_resumes_and_removes_their_files(files, tmp_path):
    folder, files = tmp_path / "study", files[:2]
    with running(folder, files, 4) as (run, _):
        os.killpg(run.pid, signal.SIGKILL)
        run.wait(timeout=20)
    assert not (folder / "report.nc").exists()
    assert remains(run.pid) or sys.platform != "linux"
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("[!.]*.nc")}
    assert len(before) >= 4
    with analyse(files, store=folder, n_jobs=1, **OPTIONS) as tree:
        assert tree["registration"].sizes["shape"] == 2
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert not remains(run.pid)
    assert not list(folder.rglob(".*.tmp"))
    assert not list(folder.glob(".log/**/*.txt"))


def test_temporary_studies_of_killed_runs_are_removed_and_those_of_others_stay(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for name in ("s4a-abandond", "s4a-of_other", "s4a-begin_ng", "s4a-thoughts"):
        (tmp_path / name).mkdir()
    for name in ("s4a-abandond", "s4a-of_other"):
        (tmp_path / name / ".lock").write_text("")
    with processes.locked(tmp_path / "s4a-of_other"), processes.temporary_folder() as folder:
        assert folder.parent == tmp_path
        left = {path.name for path in tmp_path.iterdir()}
        assert left == {"s4a-of_other", "s4a-begin_ng", "s4a-thoughts", folder.name}
    assert not folder.exists()


KILLED = """
import os, signal, sys
from pathlib import Path
from s4a import synthetic
from s4a import cli
from s4a.study import netcdf, store

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
netcdf.attributes(log.with_suffix(".nc"))
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
    "network/comparison_brain_02.nc",  # compare
    "coarse/brain_02.nc",  # remesh and spectrum
    "network/alignment_brain_02.nc",  # align
    "network/initial_000.nc",  # initial maps
    "network.nc",  # consistent ZoomOut and median
    "latent.nc",
    "registration.nc",  # registration
    "registration/brain_02.nc",
    "pca.nc",  # modes
    "report.nc",
]


def test_a_run_killed_again_and_again_ends_with_the_same_study(files, whole, tmp_path):
    kills = KILLS[::3]  # the same happens in every stage with a full disk, below
    flags = [*FLAGS, "--no-intersections"]
    where = [tmp_path / "log", tmp_path / "study", ",".join(kills)]
    subprocess.run(
        [sys.executable, "-c", KILLED, *where, *files, *flags], check=True, capture_output=True
    )
    messages = (tmp_path / "log").read_text().splitlines()
    killed = [line for line in messages if line[:6] == "killed"]
    assert killed == [f"killed {file}" for file in kills]
    result = contents(tmp_path / "study")
    # tasks of two files or none: computed again, with the same result
    shared = {"network.nc", "registration.nc", "pca.nc"}
    for file in set(result) - shared:
        assert messages.count(f"written {file}") == 1, file
    assert not list((tmp_path / "study").rglob(".*.tmp"))
    assert_the_same(tmp_path / "study", whole)


def contents(folder):
    """Every file of a study, without times."""
    files = {
        path.relative_to(folder).as_posix(): netcdf.read(path) for path in folder.rglob("[!.]*.nc")
    }
    times = ["seconds", "peak_memory"]
    return {
        file: data.drop_vars(times) if file == "report.nc" else data for file, data in files.items()
    }


@pytest.fixture(scope="module")
def whole(files, tmp_path_factory):
    """The files of an undisturbed run."""
    folder = tmp_path_factory.mktemp("whole") / "study"
    analyse(files, store=folder, intersections=False, **OPTIONS).close()
    return contents(folder)


def assert_the_same(folder, whole):
    result = contents(folder)
    assert sorted(result) == sorted(whole)
    for file, data in whole.items():
        assert data.identical(result[file]), file


def test_a_disk_that_is_full_in_every_stage_keeps_what_is_finished(
    files, whole, tmp_path, monkeypatch
):
    folder, replace, full = tmp_path / "study", os.replace, list(KILLS)

    def renamed(temporary, path):
        if full and Path(path) == folder / full[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(temporary, path)

    monkeypatch.setattr(os, "replace", renamed)
    while full:
        with pytest.raises(OSError, match=f"{full[0]} cannot be written .*No space left.*resumes"):
            analyse(files, store=folder, intersections=False, **OPTIONS)
        full.pop(0)
    analyse(files, store=folder, intersections=False, **OPTIONS).close()
    assert_the_same(folder, whole)
    assert not list(folder.rglob(".*.tmp"))
    assert not list(folder.glob(".log/**/*.txt"))


def test_files_that_disappear_or_change_while_read_end_the_run_which_then_resumes(
    files, whole, tmp_path, monkeypatch
):
    folder, meshes = tmp_path / "study", tmp_path / "meshes"
    meshes.mkdir()
    kept = {meshes / file.name: file.read_bytes() for file in files}
    read = tasks.read_shape

    def restore():
        for path, data in kept.items():
            path.write_bytes(data)

    def change(path, **options):
        mesh = read(path, **options)
        if "02" in path:
            Path(path).write_bytes(kept[meshes / files[0].name])
        return mesh

    def remove(path, **options):
        if "02" in path:
            Path(path).unlink()
        return read(path, **options)

    for happens in (change, remove):
        restore()
        monkeypatch.setattr(tasks, "read_shape", happens)
        with pytest.raises(OSError, match=r"brain_02\.ply changed or disappeared"):
            analyse(meshes / "*.ply", store=folder, intersections=False, **OPTIONS)
        assert not (folder / "original" / "brain_02.nc").exists()
    restore()
    monkeypatch.setattr(tasks, "read_shape", read)
    analyse(meshes / "*.ply", store=folder, intersections=False, **OPTIONS).close()
    assert_equal_but_paths(folder, whole)


def test_a_folder_that_vanishes_ends_a_run_until_it_is_read_and_is_not_missed_in_later_stages(
    files, whole, tmp_path, monkeypatch
):
    meshes, away, folder = tmp_path / "meshes", tmp_path / "away", tmp_path / "study"
    meshes.mkdir()
    for file in files:
        (meshes / file.name).write_bytes(file.read_bytes())
    options = {"store": folder, "intersections": False, **OPTIONS}
    replace, content = os.replace, sources.content_of_file
    vanish_at = []

    def vanish(position):
        if vanish_at == [position]:
            meshes.rename(away)
            vanish_at.clear()

    def checked_folder(path):  # before the first stage
        vanish(Path(path).name)
        return content(path)

    def renamed(temporary, path):
        replace(temporary, path)
        vanish(Path(path).relative_to(folder).as_posix())

    monkeypatch.setattr(sources, "content_of_file", checked_folder)
    monkeypatch.setattr(os, "replace", renamed)
    for position in ("brain_02.ply", "original/brain_02.nc"):
        vanish_at.append(position)
        with pytest.raises(OSError, match=r"brain_0.\.ply .*disappeared since the run began"):
            analyse(meshes, **options)
        away.rename(meshes)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("[!.]*.nc")}
    assert [path.name for path in sorted(before)] == ["brain_01.nc", "brain_02.nc"]
    vanish_at.append("original/brain_03.nc")  # the last one that is read
    analyse(meshes, **options).close()
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert_equal_but_paths(folder, whole)
    with pytest.raises(ValueError, match=r"no file or folder matches .*meshes"):
        analyse(meshes, **options)
    assert_equal_but_paths(folder, whole)


def assert_equal_but_paths(folder, whole):
    """The files of a study are those of another whose meshes were elsewhere."""
    result = contents(folder)
    assert sorted(result) == sorted(whole)
    for file in set(whole) - {"report.nc"}:
        assert result[file].equals(whole[file]), file


ERRORS = {
    "clean_shape": IndexError("list index\nout of range"),
    "compare_shape": MemoryError(),
    "remesh_shape": RecursionError(),
    "align_shape": SystemExit(0),
    "register_shape": KeyError("k"),
}


def test_an_error_in_the_task_of_a_shape_excludes_the_shape_with_a_warning(
    tmp_path, monkeypatch, capsys
):
    meshes = synthetic.write(synthetic.brains(7, 300, seed=2), tmp_path / "meshes")
    failing = dict(zip(ERRORS, sorted(file.stem for file in meshes)[1:], strict=False))
    command = ["run", *map(str, meshes), "--out", str(tmp_path / "study")]
    command += ["--template", "brain_01", *FLAGS, "--no-intersections"]
    with monkeypatch.context() as patch:
        for stage, name in failing.items():
            module = {"compare_shape": quality_control}.get(stage, pipeline)
            task = getattr(module, stage)

            def wrong(*arguments, task=task, stage=stage, name=name):
                if any(name in str(argument)[-20:] for argument in arguments[:2]):
                    raise ERRORS[stage]
                return task(*arguments)

            patch.setattr(module, stage, wrong)
        assert cli.main(command) == 1
    printed = capsys.readouterr().out
    logs = []
    with open_study(tmp_path / "study") as tree:
        report = tree["report"].to_dataset()
        excluded = report["shape"].values[report["status"].values == "excluded"]
        assert excluded.tolist() == sorted(failing.values())
        assert tree["registration"]["shape"].values.tolist() == ["brain_01", "brain_07"]
        for stage, name in failing.items():
            error, reason = type(ERRORS[stage]).__name__, report["reason"].sel(shape=name).item()
            assert error in reason
            assert "\n" not in reason
            assert error in printed
            log = re.search(r"see (\S+\.txt) in the folder of the study", reason)[1]
            logs.append(tmp_path / "study" / log)
            assert logs[-1].read_text().startswith("Traceback")
            assert "in wrong" in logs[-1].read_text()
    assert cli.main(command) == 0
    assert not any(log.exists() for log in logs)


def test_an_error_in_a_stage_of_all_shapes_ends_the_run_in_one_line_and_keeps_what_is_finished(
    files, whole, tmp_path, monkeypatch, capsys
):
    def wrong(*_, **__):
        raise TypeError("of the program")

    folder = tmp_path / "study"
    arguments = ["run", *map(str, files), "--out", str(folder), *FLAGS, "--no-intersections"]
    for stage in ("map_pairs", "consistent_maps", "pca_without"):
        with monkeypatch.context() as patch:
            patch.setattr(pipeline, stage, wrong)
            assert cli.main(arguments) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("s4a: ")]
        assert len(lines) == 1
        assert "TypeError: of the program" in lines[0]
        logs = [path for path in (folder / ".log").rglob("*.txt") if path.name in lines[0]]
        assert "in wrong" in logs[0].read_text()
    assert cli.main(arguments) == 0
    assert_the_same(folder, whole)
    assert not list(folder.glob(".log/**/*.txt"))


def test_a_crash_costs_the_shape_whose_processes_die_twice_and_nobody_else(files, whole, tmp_path):
    folder = tmp_path / "study"
    result = subprocess.run(
        [sys.executable, "-c", CRASH, str(folder), *map(str, files)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    with open_study(folder) as tree:
        report = tree["report"].to_dataset()
        assert (report["status"] == "excluded").values.tolist() == [False, True, False]
        reason = report["reason"].values[1]
        assert reason.startswith("registration: its process died (SIGSEGV: a fault in native code)")
        assert tree["report"].attrs["unforeseen"] == "brain_02"
    messages = (folder / ".log" / "registration-brain_02.txt").read_text()
    assert messages.count("begun by process") == 1
    assert "in crash" in messages
    kept = {file for file in whole if "registration" not in file and "/" in file}
    assert all(netcdf.read(folder / file).identical(whole[file]) for file in kept)


CRASH = """
import ctypes, os, signal, sys
from pathlib import Path
from s4a import analyse
from s4a.study import pipeline

def killed_once(folder, name, *arguments, task=pipeline.remesh_shape):
    mark = folder / ".killed"
    if name == "brain_03" and not mark.exists():
        mark.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return task(folder, name, *arguments)

def crash(folder, name, *arguments, task=pipeline.register_shape):
    if name == "brain_02":
        ctypes.string_at(0)
    return task(folder, name, *arguments)

if __name__ == "__main__":
    pipeline.remesh_shape, pipeline.register_shape = killed_once, crash
    options = {"n_coarse": 150, "k_init": 8, "k": 12, "n_jobs": 2, "intersections": False}
    options |= {"template": "brain_01", "include_flagged": True}
    analyse(sys.argv[2:], store=sys.argv[1], **options)
"""


def test_a_study_that_is_removed_during_a_run_is_named(files, tmp_path, monkeypatch):
    folder, replace = tmp_path / "study", os.replace
    for gone in ("coarse/brain_01.nc", ""):

        def remove(temporary, path, gone=gone):
            replace(temporary, path)
            if Path(path).name == "alignment_brain_02.nc":
                (shutil.rmtree if not gone else os.unlink)(folder / gone)

        monkeypatch.setattr(os, "replace", remove)
        named = (folder / gone).relative_to(tmp_path)
        with pytest.raises(OSError, match=f"{named} was removed or replaced during the run"):
            analyse(files, store=folder, intersections=False, **OPTIONS)
        (folder / "network" / "alignment_brain_02.nc").unlink(missing_ok=True)
    assert not folder.exists()


def test_a_worker_of_a_run_that_is_over_writes_nothing(tmp_path):
    with store.lock(tmp_path) as old:
        store.write(synthetic.sphere(50), tmp_path / "a.nc", "key", claim=old)
    with store.lock(tmp_path) as new:
        with pytest.raises(ValueError, match=f"process {os.getpid()} no longer has the lock"):
            store.write(synthetic.sphere(60), tmp_path / "a.nc", "key", claim=old)
        assert netcdf.read(tmp_path / "a.nc").sizes["vertex"] == 50
        store.write(synthetic.sphere(60), tmp_path / "a.nc", "key", claim=new)
    assert netcdf.read(tmp_path / "a.nc").sizes["vertex"] == 60
    assert not list(tmp_path.glob(".*.tmp"))


def test_costs_add_up_over_the_runs_that_share_a_stage_and_stay_where_nothing_is_left_to_do(
    tmp_path,
):
    with store.lock(tmp_path) as claim:
        costs = '{"costs": {"a": [5.0, 7000000.0], "b": [5.0, 7.0], "c": [5.0, 7.0]}}'
        (tmp_path / FILE).write_text(costs)
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
    assert netcdf.is_done(path, store.task_key("content"))
    monkeypatch.setattr(store, "VERSION", "999.0")
    assert not netcdf.is_done(path, store.task_key("content"))


FULL = """
import resource, sys
from s4a import cli
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
small = ["--n-coarse", "150", "--k-init", "8", "--k", "12", "--no-intersections"]
sys.exit(cli.main(["run", *sys.argv[2:], "--out", sys.argv[1], *small, "--n-jobs", "2"]))
"""


def test_a_full_disk_is_one_error_of_two_workers_and_leaves_complete_files(files, tmp_path):
    folder = tmp_path / "study"
    arguments = [sys.executable, "-c", FULL, str(folder), *map(str, files[:2])]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert result.returncode == 2, result.stderr
    lines = [line for line in result.stderr.splitlines() if line.startswith("s4a: ")]
    assert len(lines) == 1, result.stderr
    assert "cannot be written" in lines[0]
    assert "resumes the run" in lines[0]
    whole = sorted(folder.rglob("[!.]*.nc"))
    assert whole
    assert all(netcdf.attributes(path)["task_key"] for path in whole)
    assert not list(folder.rglob(".*.tmp"))


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    order, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: order.append("fsync") or fsync(handle))
    monkeypatch.setattr(os, "replace", lambda *paths: order.append("rename") or replace(*paths))
    store.write(synthetic.sphere(50), tmp_path / "a.nc", "key")
    assert order == ["fsync", "rename"]


def test_a_folder_that_cannot_be_written_is_one_error(tmp_path, monkeypatch):
    store.write(synthetic.sphere(50), tmp_path / "a.nc", "key")

    def refused(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "replace", refused)
    with pytest.raises(
        OSError, match=r"a.nc cannot be written .*Permission denied.*Finished files are kept"
    ):
        store.write(synthetic.sphere(60), tmp_path / "a.nc", "key")
    assert netcdf.read(tmp_path / "a.nc").sizes["vertex"] == 50
    assert [p.name for p in tmp_path.iterdir()] == ["a.nc"]


def test_names_that_lead_out_of_a_study_are_refused(tmp_path):
    folder = tmp_path / "study"
    (folder / "original").mkdir(parents=True)
    result = dataset(latent_eigenvalue=[0.0, 1.0]).assign_coords(shape=["a", "../../outside"])
    store.write(result.assign_attrs(median="a"), folder / "latent.nc")
    message = r"latent.nc cannot be read \(shapes need names of letters.*'../../outside'"
    with pytest.raises(OSError, match=message):
        open_study(folder)
