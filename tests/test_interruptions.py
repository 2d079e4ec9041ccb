"""Runs that end before their time: nothing goes on behind them, nothing is damaged, the next one goes on."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from s4a import analyse, study, synthetic
from s4a.pipeline import Run

OPTIONS = {"n_coarse": 150, "k_init": 8, "k": 12}
RUN = """
import sys, time
from s4a import analyse, pipeline

def slow(*arguments, task=pipeline.coarse_task):
    time.sleep(2)
    return task(*arguments)

if __name__ == "__main__":
    pipeline.coarse_task = slow
    analyse(sys.argv[2:], store=sys.argv[1], n_coarse=150, k_init=8, k=12, n_jobs=2)
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return synthetic.write(synthetic.brains(4, 300, seed=2), tmp_path_factory.mktemp("files"))


@contextlib.contextmanager
def running(folder, files):
    """A run in a session of its own, with two workers in the middle of their tasks; gives it and their processes."""
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
def test_workers_are_gone_within_seconds_of_the_end_of_a_run_and_the_study_is_resumable(files, tmp_path, how):
    folder = tmp_path / "study"
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
        assert tree["registration"].sizes["shape"] == 4
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert not list(folder.rglob(".*.tmp"))


def test_a_worker_of_a_run_that_is_over_writes_nothing(tmp_path):
    with study.lock(tmp_path) as old:
        study.write(synthetic.sphere(50), tmp_path / "a.nc", "key", claim=old)
    with study.lock(tmp_path) as new:
        with pytest.raises(ValueError, match=f"the run of process {os.getpid()} no longer holds"):
            study.write(synthetic.sphere(60), tmp_path / "a.nc", "key", claim=old)
        assert study.read(tmp_path / "a.nc").sizes["vertex"] == 50
        study.write(synthetic.sphere(60), tmp_path / "a.nc", "key", claim=new)
    assert study.read(tmp_path / "a.nc").sizes["vertex"] == 60
    assert not list(tmp_path.glob(".*.tmp"))


def test_costs_add_up_over_the_runs_that_share_a_stage_and_stay_where_nothing_is_left_to_do(tmp_path):
    with study.lock(tmp_path) as claim:
        Run(claim, 1).costs_file.write_text('{"a": [5.0, 7000000.0], "b": [5.0, 7.0], "c": [5.0, 7.0]}')
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
