"""Pairwise registration: use of threads, iterations of ZoomOut."""

import numpy as np
import xarray as xr
from scipy.spatial.distance import cdist
from threadpoolctl import threadpool_info, threadpool_limits

import s4a
from s4a.study import pair


def blas_threads():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_a_pair_takes_one_thread_of_blas_and_gives_back_the_others(monkeypatch):
    calls, match_shapes = [], pair.match_shapes

    def watched(*given):
        calls.extend(blas_threads())
        return match_shapes(*given)

    monkeypatch.setattr(pair, "match_shapes", watched)
    mesh = s4a.synthetic.ellipsoid(200)
    with threadpool_limits(2, "blas"):
        before = blas_threads()
        s4a.match_pair(mesh, mesh, n_coarse=100, k=10, k_init=6)
        after = blas_threads()
    assert set(calls) == {1}
    assert after == before
    assert max(before) == 2


def test_each_kept_iteration_of_zoomout_is_the_map_of_the_match_before_it(meshes):
    source, target, *_ = meshes.values()
    small = {"n_coarse": 300, "k": 20, "k_init": 10}
    pair = s4a.match_pair(source, target, preset="paper", keep_iterations=True, **small)
    assert pair["iteration_size"].values.tolist() == [10, 15, 20]
    Phi, Psi = (
        s4a.spectrum(s4a.coarsen(mesh, n_coarse=300), k=20)["eigenfunction"].values
        for mesh in (source, target)
    )
    for i, size in enumerate((10, 15, 20)):
        C = pair["iteration_fmap"].values[i]
        assert np.isnan(C[size:]).all()
        match = cdist(Psi[:, :size], Phi[:, :size] @ C[:size, :size].T).argmin(1)
        assert (pair["iteration_match"].values[i] == match).mean() > 0.99
    assert np.array_equal(pair["iteration_fmap"][-1], pair["fmap"])
    assert pair["descriptor_of_source"].shape == (10, 80)
    assert "iteration_fmap" not in s4a.match_pair(source, target, preset="paper", **small)


def test_the_result_of_a_pair_does_not_depend_on_the_number_of_threads(meshes, caplog):
    source, target, *_ = meshes.values()
    one, two, most = (
        s4a.match_pair(source, target, n_coarse=300, k=20, k_init=10, n_jobs=n) for n in (1, 2, 999)
    )
    xr.testing.assert_identical(one, two)
    xr.testing.assert_identical(one, most)
    assert "999 workers were asked for" in caplog.text
