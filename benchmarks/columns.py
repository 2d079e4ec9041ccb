"""Check of the columns of a table: findings in simulated columns, clean and with one wrong value.

``python benchmarks/columns.py`` prints the table of docs/plausibility.md, in half a minute.
"""

import logging
import sys

import numpy as np

from s4a.input.columns import check_column

SIZES = (5, 10, 20, 50)
TIMES = 200
# clean columns of n numbers
CLEAN = {
    "ages of adults": lambda rng, n: rng.integers(18, 90, n),
    "ages of children, with decimals": lambda rng, n: rng.uniform(0.1, 17, n).round(2),
    "ages of children and of adults": lambda rng, n: np.where(
        rng.random(n) < 0.5, rng.normal(9, 2, n), rng.normal(45, 12, n)
    ).round(),
    "normal": lambda rng, n: rng.normal(100, 15, n),
    "standardised": lambda rng, n: rng.normal(0, 1, n).round(3),
    "log-normal volumes": lambda rng, n: rng.lognormal(8, 0.6, n).round(1),
    "very skewed volumes": lambda rng, n: rng.lognormal(0, 1.5, n).round(2),
    "0 or 1": lambda rng, n: rng.integers(0, 2, n),
    "rarely 1": lambda rng, n: rng.random(n) < 0.1,
    "levels 1 to 4": lambda rng, n: rng.integers(1, 5, n),
    "counts": lambda rng, n: rng.poisson(1.5, n),
    "consecutive numbers": lambda rng, n: rng.permutation(n) + 1,
    "numbers of patients": lambda rng, n: rng.integers(10_000, 99_999, n),
    "contrasts -1 and 1": lambda rng, n: rng.choice([-1, 1], n),
    "changes": lambda rng, n: rng.normal(2, 5, n).round(),
    "constant": lambda rng, n: np.full(n, 37.0),
}
WRONG = {
    "-9": lambda x, rng: -9,
    "-999": lambda x, rng: -999,
    "99": lambda x, rng: 99,
    "9999": lambda x, rng: 9999,
    "ten times": lambda x, rng: 10 * x,
    "a tenth": lambda x, rng: x / 10,
}


class Count(logging.Handler):
    """Number of warnings."""

    n = 0

    def emit(self, record):
        self.n += 1


def found(values, count):
    """Return whether a column is reported."""
    before = count.n
    try:
        check_column(values, [f"s{i}" for i in range(len(values))], "column")
    except ValueError:
        return True
    return count.n > before


def share(make, n, count, spoil=None):
    """Return the percentage of simulated columns that are reported."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(TIMES):
        values = np.asarray(make(rng, n), float)
        if spoil is not None:
            i = rng.integers(n)
            values[i] = spoil(values[i], rng)
        hits += found(values, count)
    return 100 * hits / TIMES


def rows(count):
    """Yield the rows of the table."""
    for name, make in CLEAN.items():
        yield f"{name}, clean", [share(make, n, count) for n in SIZES]
    for kind in ("ages of adults", "ages of children, with decimals", "log-normal volumes"):
        for name, spoil in WRONG.items():
            yield f"{kind}, one {name}", [share(CLEAN[kind], n, count, spoil) for n in SIZES]


def main():
    """Print the table."""
    count = Count()
    logger = logging.getLogger("s4a.input.columns")
    logger.addHandler(count)
    logger.propagate = False
    head = [f"reported, % of {TIMES} columns", *(f"{n} shapes" for n in SIZES)]
    sys.stdout.write(f"| {' | '.join(head)} |\n|---|{'---:|' * len(SIZES)}\n")
    for name, shares in rows(count):
        sys.stdout.write(f"| {name} | {' | '.join(f'{one:.3g}' for one in shares)} |\n")


if __name__ == "__main__":
    main()
