"""Pairwise registration: use of threads."""

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
