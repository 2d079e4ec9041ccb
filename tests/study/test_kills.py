"""A few of the kills of ``benchmarks/kills.py``, as a test that it runs."""

import subprocess
import sys

from paths import BENCHMARKS


def test_runs_killed_at_random_go_on_bit_for_bit_and_leave_nothing():
    bench = [sys.executable, BENCHMARKS / "kills.py", "--kills", "2", "--dask", "0"]
    result = subprocess.run(bench, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 studies differ; left behind: nothing" in result.stdout
