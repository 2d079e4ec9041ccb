"""Check of the columns of a table (6.1): missing-value codes, outliers, names that look alike.

Values are reported and never changed.  A test is refused if it would be meaningless.
"""

import logging
import re
from collections.abc import Sequence

import numpy as np
from scipy.special import stdtr

from s4a.input.subjects import is_plain_number, listed, look, look_alikes
from s4a.schema import Array

log = logging.getLogger(__name__)

# -9, 99, -999, 9998 and similar, and the largest integers of 16 and 32 bits
_CODES = re.compile(r"-1|-?(9*[789]|77+|88+|9+\.9+|32768|2147483648)|32767|65535|2147483647")
_WORDS = re.compile(
    r"[?.]+|none|unknown|missing|not? (available|applicable|data)|n\.a\.|n\.?d\.?|#.*[!?]",
    re.IGNORECASE,
)
_DATE = re.compile(r"(19|20)\d\d(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01])")  # as 20240131
_NUMBERS = {"true": "1", "yes": "1", "false": "0", "no": "0"}
_ALONE = 0.995  # share of the variance of a column that an outlier may have
_LEVEL, _SLIP_LEVEL = 3e-4, 0.04  # of an outlier in a column; of a value ten times the others


def check_column(
    values: Array, names: Sequence[str], what: str, *, categories: bool = False
) -> None:
    """Check a column before a test: missing-value codes, outliers, names that look alike.

    Parameters
    ----------
    values : ndarray (s,) or (s, c)
        Numbers, which may be NaN, or text.
    names : sequence of str (s,)
        Names of the shapes.
    what : str
        Name of the column in messages.
    categories : bool
        Whether numbers are names of groups or subjects.

    Raises
    ------
    ValueError
        If a value is certainly a missing-value code, one shape has almost the whole variance of the
        column, or two names differ only in invisible characters.  Other findings are warnings.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.columns import check_column
    >>> check_column(np.array([31, 40, -999, 52]), ["a", "b", "c", "d"], "age")
    Traceback (most recent call last):
    ValueError: age: -999 of c is a code of a missing value (others 31 to 52): write NA, or, if it \
is a value, give the column in another unit
    """
    for column in np.reshape(values, (len(values), -1)).T:
        is_text = column.dtype.kind == "U" and not all(map(is_plain_number, column))
        if categories or is_text:
            _check_names(list(map(str, column.tolist())), names, what)
        else:
            _check_numbers(column.astype(float), names, what)


def _check_names(cells, names, what):
    """Check names of groups or subjects."""
    numbers = [float(cell) if is_plain_number(cell) else np.nan for cell in cells]
    is_mixed = np.isnan(numbers).any()
    codes = _usual(numbers) if is_mixed else missing_codes(np.array(numbers))
    codes |= [bool(_WORDS.fullmatch(cell)) for cell in cells]
    _report_codes(codes, cells, names, what, "the others are names" if is_mixed else "")
    for same, variants in look_alikes(cells):
        example = {cell: names[cells.index(cell)] for cell in variants}
        text = f"{what}: {' and '.join(f'{cell!a} ({name})' for cell, name in example.items())} "
        if same:
            raise ValueError(
                f"{text}look alike, and differ only in encoding or invisible characters: write the "
                "same name for the same group"
            )
        log.warning("%sdiffer only in case or similar letters: are these different groups?", text)
    letters = {cell.casefold(): cell for cell in cells if len(cell) == 1}
    for word in sorted({cell for cell in cells if len(cell) > 2 or look(cell) == "no"}):
        letter = letters.get(word[0].casefold(), letters.get(_NUMBERS.get(look(word), "")))
        if letter:
            log.warning("%s: are %r and %r different groups?", what, letter, word)


@np.errstate(all="ignore")  # of numbers near the largest
def _check_numbers(x, names, what):
    """Check a column of numbers."""
    cells = [f"{value:.10g}" for value in x]
    known = np.isfinite(x)
    codes = _mask(missing_codes, x, known)
    rest = known & ~codes
    _report_codes(codes, cells, names, what, f"others {_range(x[rest])}" if rest.any() else "")
    far = _mask(outlying, x, rest)
    usual = x[rest & ~far]
    if far.any():
        text = f"{what}: outliers, {_named(far, cells, names)} (others {_range(usual)})"
        remaining = np.delete(x[rest], abs(x[rest] - np.median(x[rest])).argmax())
        share = 1 - remaining.var() * len(remaining) / (x[rest].var() * rest.sum())
        if share > _ALONE:
            raise ValueError(
                f"{text}: {share:.1%} of the variance is of one shape, so a test would "
                "compare it with all others: correct the value, or write NA"
            )
        log.warning("%s: correct the value, or write NA, if it is wrong; the test uses it", text)
    if rest.sum() > 1 and all(_DATE.fullmatch(cells[i]) for i in np.flatnonzero(rest)):
        text = "%s: %s look like dates, whose differences are not days: write days or years"
        log.warning(text, what, _range(x[rest]))
    sizes = " and ".join(map(_range, _two_sizes(usual)))
    if sizes:
        log.warning("%s: values of two sizes, %s: are all in one unit?", what, sizes)


def _mask(test, x, known):
    mask = known.copy()
    mask[known] = test(x[known])
    return mask


def _range(x):
    return f"{min(x):.10g} to {max(x):.10g}"


def _named(mask, cells, names):
    return listed([f"{cells[i]} of {names[i]}" for i in np.flatnonzero(mask)])


def _two_sizes(x):
    """Split positive values if one part is about 100 or 1000 times the other; else return ()."""
    x = np.sort(x[x != 0])
    at = 1 + int(np.argmax(np.diff(np.log(x)))) if len(x) > 1 and x[0] > 0 else 0
    low, high = x[:at], x[at:]
    if min(len(low), len(high)) < 2 or low[-1] >= 4 * low[0] or high[-1] >= 4 * high[0]:
        return ()
    factor = np.log10(np.median(high) / np.median(low))
    return (low, high) if factor > 1.5 and abs(factor - round(factor)) < 0.2 else ()


def _report_codes(codes, cells, names, what, others):
    """Warn about missing-value codes; ValueError if one is certain."""
    found = _named(codes, cells, names)
    if not found:
        return
    numbers = [float(cells[i]) for i in np.flatnonzero(codes) if is_plain_number(cells[i])]
    others = f" ({others})" if others else ""
    if any(x < -10 or x >= 100 for x in numbers):  # others may be values
        raise ValueError(
            f"{what}: {found} is a code of a missing value{others}: write NA, or, if it is a "
            "value, give the column in another unit"
        )
    log.warning("%s: %s may be a code of a missing value%s: write NA if so", what, found, others)


def missing_codes(x: Array) -> Array:
    """Return a mask of numbers ``(n,)`` that are usual missing-value codes, and outlying.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.columns import missing_codes
    >>> missing_codes(np.array([31, 40, -9, 52.0])).tolist()
    [False, False, True, False]
    >>> missing_codes(np.array([-9, -4, 7, 12.0])).any()
    np.False_
    """
    possible, found = _usual(x) | (x == 0), np.zeros(len(x), bool)
    for code in np.unique(x[possible]):
        # 0, -1 and one digit of the other sign may be values
        digit = (abs(x) < 10) & ((x * code < 0) | (x == -1) | (x == 0)) & (x != code)
        rest = x[~possible | digit]
        if len(np.unique(rest)) > 1:
            found |= (x == code) & _is_code(code, rest, (x == code).sum())
    return found


def _usual(x):
    """Return a mask of the numbers that are usual codes."""
    return np.array([bool(_CODES.fullmatch(f"{value:.15g}")) for value in x])


def _is_code(code, rest, count):
    """Return whether a usual code is far enough from the other values of its column to be one."""
    if abs(code) < 10 and rest.min() < 0:
        return False  # of differences
    if code == 0:  # among values that differ too little for a zero
        steps = np.diff(np.unique(rest))
        is_narrow = len(steps) > 3 and 2 * steps.max() < rest.min() and rest.max() < 4 * rest.min()
        return bool(is_narrow and 3 * count <= len(rest))
    low, high, decimals = rest.min(), rest.max(), (rest % 1 != 0).mean()
    gap = low - code if code < 0 else code - high
    extent = (high - low) * (1 + 4 / len(rest))  # the extent of few values is uncertain
    if code < 0 <= low:
        is_far = low >= max(5, -code) or gap > max(3, 2 * extent)
        is_few = low >= 1 and len(np.unique(rest)) <= min(4, len(rest) / 2)  # categories
        is_alone = len(rest) > 4 and (code < -1 or is_few)
        return code < -10 or is_far or is_alone or (len(rest) > 3 and code < -1 and decimals > 0.75)
    if abs(code) > 99 and len(rest) > 4 and decimals == (code % 1 == 0):
        return True  # the only integer, or the only decimal
    if count > 1:
        extent = max(np.diff(np.unique(rest)).max(), (high - low) / 4)
    return bool(gap > max(3, extent))


def outlying(x: Array) -> Array:
    """Return a mask of outliers of numbers ``(n,)``, in a column of any skewness.

    A value is compared with the others, and positive ones by their logarithms too, by the t
    distribution of a new observation.  A value that is 10, 100 or 1000 times one in their range, as
    290 for 29, or of the other sign, needs less evidence, and is enough if it alone has decimals,
    as 3.1 for 31.

    Examples
    --------
    >>> import numpy as np
    >>> from s4a.input.columns import outlying
    >>> outlying(np.array([25, 31, 29, 40, 290.0])).tolist()
    [False, False, False, False, True]
    >>> outlying(np.exp([0.1, 1.2, 0.4, 2.1, 3.0])).any()
    np.False_
    """
    found = np.zeros(len(x), bool)
    if len(x) < 5:
        return found
    for sign in (1, -1):
        # values of one end, up to a tenth of the column, or a third if they are equal
        for value in np.unique(sign * x)[: -min(len(x) // 10, 5) - 2 : -1]:
            end = sign * x >= value
            most = len(x) / (3 if np.ptp(x[end]) == 0 else 10)
            if end.sum() <= max(most, 1) and _is_outlying(sign * value, x[~end], len(x)):
                found |= end
    return found


def _is_outlying(value, rest, n):
    low, high = np.quantile(rest, [0.1, 0.9])
    slips = value / np.array([1e-3, 1e-2, 0.1, 10, 100, 1000, -1])
    is_slip = 0 < high < 4 * low and ((slips >= low) & (slips <= high)).any()
    if is_slip and value % 1 and not (rest % 1).any():  # 3.1 among integers
        return True
    return _p_value(value, rest) * n < (_SLIP_LEVEL if is_slip else _LEVEL)


def _p_value(value, rest):
    """Return the p value of a new observation among others ``(m,)``, or of the logarithms."""
    step = np.diff(np.unique(rest)).min(initial=np.inf)  # to which numbers are rounded
    if not np.isfinite(step):  # a constant
        return 1.0
    p, least = _p_of_new(value, rest, step), min(value, rest.min())
    if least < 0:
        return p
    shift = 0 if least else rest[rest > 0].min()  # zero has no logarithm
    step = np.log1p(step / (np.median(rest) + shift))
    return max(p, _p_of_new(np.log(value + shift), np.log(rest + shift), step))


def _p_of_new(value, rest, step):
    deviation = np.hypot(rest.std(ddof=1), step) * np.sqrt(1 + 1 / len(rest))
    return 2 * stdtr(len(rest) - 1, -abs(value - rest.mean()) / deviation)
