"""Random numbers: ``rng=`` beside ``seed=``, as SPEC 7 of Scientific Python has it.

What is random here depends on a whole number, so that a study can say in its report how it is made
again.  Every public function that takes it as ``seed`` also takes ``rng``: a whole number, which is
the same as that seed; or a :class:`numpy.random.Generator`, from which the number is drawn, so that
a second call with the same generator gets another one.  Unlike in SPEC 7, None is no fresh entropy
but the default of ``seed``: a result that cannot be repeated has to be asked for, with
``rng=numpy.random.default_rng()``.

``seed=`` stays without a warning in every 0.x, 1.0 will warn of it, and no release before 1.2 will
refuse it.  The options of a study and of the command line keep it: there it is a number on record.
"""

from typing import Any

import numpy as np

RNG = int | np.integer | np.random.Generator
LARGEST = 2**31  # of a drawn seed, which every library takes


def seed_of(seed: int, rng: RNG | None) -> int:
    """The seed that a function is to take.

    Parameters
    ----------
    seed : int
        As given, 0 where it is not.
    rng : int, Generator or None
        Another way to give it.

    Raises
    ------
    TypeError
        When `rng` is neither.
    ValueError
        When both are given.

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
    """Options with ``seed`` in the place of ``rng``, where that is given.

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
