"""Random numbers: ``rng=`` as an alternative to ``seed=`` (Scientific Python SPEC 7).

The report of a study stores an integer seed, so that a result can be repeated.  Every public
function with ``seed`` also takes ``rng``: an integer, with the same meaning as `seed`, or a
:class:`numpy.random.Generator`, from which a seed is drawn, so that a second call with the same
generator gets another seed.  Unlike in SPEC 7, None means the default of ``seed`` and not fresh
entropy; for the latter pass ``rng=numpy.random.default_rng()``.
"""

from typing import Any

import numpy as np

RNG = int | np.integer | np.random.Generator
LARGEST = 2**31  # upper limit of a drawn seed, valid in all libraries


def seed_of(seed: int, rng: RNG | None) -> int:
    """Return the seed to use.

    Parameters
    ----------
    seed : int
        Seed of the caller, by default 0.
    rng : int, Generator or None
        Alternative to `seed`.

    Raises
    ------
    TypeError
        If `rng` has another type.
    ValueError
        If both are given, or `rng` is negative.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.seeds import seed_of
    >>> seed_of(3, None), seed_of(0, 3)
    (3, 3)
    >>> rng = np.random.default_rng(1)
    >>> seed_of(0, rng) == seed_of(0, np.random.default_rng(1)) != seed_of(0, rng)
    True
    """
    if rng is None:
        return seed
    if seed:
        raise ValueError(f"seed={seed!r} and rng are given: leave out one of the two")
    if isinstance(rng, np.random.Generator):
        return int(rng.integers(LARGEST))
    if isinstance(rng, bool) or not isinstance(rng, int | np.integer):
        raise TypeError(f"rng needs a whole number or a numpy.random.Generator, found {rng!r}")
    if rng < 0:
        raise ValueError(f"rng needs a whole number from 0, found {rng}")
    return int(rng)


def seeded(options: dict[str, Any]) -> dict[str, Any]:
    """Replace ``rng`` in options by ``seed``, if it is given.

    Examples
    --------
    >>> from s4a.seeds import seeded
    >>> seeded({"k": 50, "rng": 3}), seeded({"k": 50})
    ({'k': 50, 'seed': 3}, {'k': 50})
    """
    if "rng" not in options:
        return options
    others = {name: value for name, value in options.items() if name != "rng"}
    return others | {"seed": seed_of(others.get("seed", 0), options["rng"])}
