"""Checks of surfaces that tests share."""

from collections import defaultdict


def assert_oriented_manifold(X, T):
    """Every directed edge once, and one fan of triangles around every vertex.

    In plain Python, on its own.
    """
    after, directed = defaultdict(dict), set()
    for a, b, c in T.tolist():
        assert len({a, b, c}) == 3
        for p, q, r in ((a, b, c), (b, c, a), (c, a, b)):
            assert (p, q) not in directed
            directed.add((p, q))
            after[p][q] = r
    assert len(after) == len(X), "a vertex without triangles"
    for fan in after.values():
        ends = set(fan) - set(fan.values())
        assert len(ends) <= 1, "several fans"
        at, calls = next(iter(ends or fan)), 0
        while at in fan and calls < len(fan):
            at, calls = fan[at], calls + 1
        assert calls == len(fan), "several closed fans"
