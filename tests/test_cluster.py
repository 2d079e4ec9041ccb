"""The same run on a dask scheduler with two worker processes."""

import subprocess
import sys

import numpy as np
import pytest

import s4a
from s4a import cli, synthetic

SMALL = {"n_coarse": 400, "k": 30, "k_init": 12}


def test_two_dask_workers_give_the_bits_of_a_local_run(tmp_path):
    pytest.importorskip("distributed")
    synthetic.write(synthetic.brains(4, 1500, 5), tmp_path / "brains")
    local = s4a.analyse(tmp_path / "brains", **SMALL)
    flags = [text for name, value in SMALL.items() for text in (f"--{name.replace('_', '-')}", str(value))]
    command = ["run", tmp_path / "brains", "--out", tmp_path / "study", "--cluster", "local:2", *flags]
    subprocess.run([sys.executable, "-m", "s4a", *command], check=True, capture_output=True, timeout=300)
    study = s4a.open_study(tmp_path / "study")
    assert [n.path for n in study.subtree] == [n.path for n in local.subtree]
    for node in study.subtree:
        if node.path != "/report":  # it has the times
            for name, values in node.to_dataset().data_vars.items():
                np.testing.assert_array_equal(values, local[node.path][name], err_msg=f"{node.path}/{name}")
    study.close()


@pytest.mark.parametrize("address", ["nowhere", "local:", "local:0", "local:two"])
def test_an_address_that_is_none_says_what_is_needed(address, capsys, tmp_path):
    pytest.importorskip("distributed")
    assert cli.main(["run", str(tmp_path), "--out", str(tmp_path / "study"), "--cluster", address]) == 2
    assert "tcp://host:port or local:N" in capsys.readouterr().err
