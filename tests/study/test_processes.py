"""Worker processes use memory again that their arrays freed."""

import platform

import numpy as np
import pytest
from joblib import delayed

from s4a.study.processes import workers

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
