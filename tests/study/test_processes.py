"""Worker processes are used again, and use memory again that their arrays freed."""

import os
import platform

import numpy as np
import pytest
from joblib import delayed

from s4a.study import processes
from s4a.study.processes import limited, workers

resource = pytest.importorskip("resource", reason="of POSIX")
SIZE, HUGE_PAGE = 40_000_000, 2**21  # bytes


def faults_of_arrays(_):
    """Pages that the system cleared for each of ten arrays, freed before the next."""
    counts = [resource.getrusage(resource.RUSAGE_SELF).ru_minflt]
    for _ in range(10):
        array = np.ones(SIZE // 8)
        del array
        counts.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
    return np.diff(counts)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of the C library of Linux")
def test_a_worker_uses_the_memory_of_an_array_for_the_next():
    for _, *others in workers(2)(delayed(faults_of_arrays)(i) for i in range(2)):
        assert np.median(others) < SIZE / HUGE_PAGE / 2


def test_the_next_call_uses_the_same_processes():
    ways = {}, {"return_as": "generator"}
    pids = [set(workers(2, **way)(delayed(os.getpid)() for _ in range(8))) for way in ways]
    assert len(pids[0] | pids[1]) <= 2


def test_processes_are_limited_to_cores_and_tasks(monkeypatch, caplog):
    monkeypatch.setattr(processes, "cpu_count", lambda: 8)
    assert [limited(n) for n in (None, 1, 8)] == [None, 1, 8]
    assert [limited(n, 4) for n in (1, 8, 999)] == [1, 4, 4]
    assert caplog.text == ""
    assert limited(999) == 8
    assert "999 workers were asked for; this machine has 8 cores, so 8 are used" in caplog.text
