"""The same run on a dask scheduler with two worker processes."""

import contextlib
import json
import subprocess
import sys
import time

import numpy as np
import pytest
from small import FLAGS

import s4a
from s4a import cli


def command(*words):
    return [sys.executable, "-m", *map(str, words)]


def run(folder, out, cluster):
    return command("s4a", "run", folder, "--out", out, "--cluster", cluster, *FLAGS)


def assert_the_same(out, local):
    study = s4a.open_study(out)
    assert [n.path for n in study.subtree] == [n.path for n in local.subtree]
    for node in study.subtree:
        if node.path != "/report":  # it has the times
            for name, values in node.to_dataset().data_vars.items():
                np.testing.assert_array_equal(
                    values, local[node.path][name], err_msg=f"{node.path}/{name}"
                )
    study.close()


def wait_for(result, what, seconds=120):
    end = time.monotonic() + seconds
    while not result():
        assert time.monotonic() < end, f"no {what} in {seconds} s"
        time.sleep(0.02)


def test_with_one_of_two_dask_workers_killed_a_run_gives_the_bits_of_a_local_one(
    brain_files, study_of_files, tmp_path
):
    pytest.importorskip("distributed")
    folder = brain_files[0].parent
    where, out = tmp_path / "scheduler.json", tmp_path / "study"
    with contextlib.ExitStack() as stack:

        def start(*words):
            process = subprocess.Popen(
                words, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        scheduler = ["--port", 0, "--no-dashboard", "--scheduler-file", where]
        start(*command("distributed.cli.dask_scheduler", *scheduler))
        wait_for(lambda: where.exists() and where.stat().st_size, "scheduler")
        address = json.loads(where.read_text())["address"]
        worker = [address, "--nthreads", 1, "--no-nanny", "--no-dashboard"]
        workers = [start(*command("distributed.cli.dask_worker", *worker)) for _ in range(2)]
        process = start(*run(folder, out, address))
        wait_for(lambda: any(out.glob("coarse/*.nc")), "task done")
        done = {path: path.stat().st_mtime_ns for path in out.rglob("*.nc")}
        workers[0].kill()
        assert process.wait(timeout=300) == 0
        assert workers[1].poll() is None
    assert_the_same(out, study_of_files)
    again = [path for path, time in done.items() if path.stat().st_mtime_ns != time]
    # the task of the dead worker may have been written, but not yet reported to the scheduler
    assert len(again) <= 1


def test_an_invalid_address_is_an_error_that_says_what_is_needed(capsys, tmp_path):
    pytest.importorskip("distributed")
    for address in ("nowhere", "local:", "local:0", "local:two"):
        words = ["run", str(tmp_path), "--out", str(tmp_path / "study"), "--cluster", address]
        assert cli.main(words) == 2
        assert "tcp://host:port, or local:N" in capsys.readouterr().err
