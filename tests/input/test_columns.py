"""The check of columns before a test: what is found, and that clean columns are not reported."""

from contextlib import nullcontext

import numpy as np
import pytest

from s4a.input.columns import check_column
from s4a.input.subjects import look_alikes, read_table

AGES = [20 + 3 * i + i * i % 5 for i in range(12)]
NAMES = [f"s{i}" for i in range(12)]


def findings(values, caplog, **options):
    """The message of the check of a column, a warning or an error; empty if there is none."""
    caplog.clear()
    values = np.array(values)
    try:
        check_column(values, [f"s{i}" for i in range(len(values))], "it", **options)
    except ValueError as error:
        return f"error: {error}"
    return caplog.text


def with_value(value, *rows, values=AGES):
    return [value if i in (rows or (3,)) else x for i, x in enumerate(values)]


@pytest.mark.parametrize("code", [-99, -999, -9999, 999, 9999, 999999, -32768, -77, 8888])
def test_a_test_with_a_code_of_missing_values_is_refused(code, caplog):
    found = findings(with_value(code), caplog)
    assert f"error: it: {code} of s3 is a code of a missing value (others 20 to" in found
    volumes = np.random.default_rng(0).lognormal(5, 0.4, 12)
    assert "error" in findings(with_value(-abs(code), 3, 5, values=volumes), caplog)


def test_other_codes_and_outliers_are_named_with_the_values_of_the_others(caplog):
    for code in (-9, -1, -8, 0, 99.9, -9.99):
        assert f"{code} of s3 may be a code of a missing value (others 20" in findings(
            with_value(code), caplog
        )
    found = findings(with_value(290), caplog)
    assert "outliers, 290 of s3 (others 20 to 54): correct the value, or write NA" in found
    assert "outliers, -31 of s3" in findings(with_value(-31), caplog)
    assert "outliers, 3.1 of s3" in findings(with_value(3.1), caplog)
    mixed = np.where(np.arange(12) % 2, 1.5 + 0.03 * np.arange(12), 150 + 3 * np.arange(12))
    assert "values of two sizes, 1.53 to 1.83 and 150 to 180: are all in one unit?" in findings(
        mixed, caplog
    )
    assert "20240101 to 20241201 look like dates" in findings(
        20240001 + 100 * np.arange(1, 13), caplog
    )
    for value in (1e10, -1e5, 1.7e308):
        assert "error: it: outliers" in findings(with_value(value), caplog)
        assert "variance is of one shape" in findings(with_value(value), caplog)
    assert "99 of s2, 99 of s7 may be a code" in findings(with_value(99, 2, 7), caplog)
    assert "9 of s3 may" in findings(with_value(9, values=[1, 2] * 6), caplog)
    assert "1750 of s3" in findings(with_value(1750, values=np.arange(12) + 165), caplog)
    assert "-9 of s3 may" in findings(with_value(-9, values=np.linspace(0.3, 17.2, 12)), caplog)
    assert "-9 of s3 may" in findings(with_value(-9, values=[1, 4, 9, 0, 6, 7] * 2), caplog)
    assert "-1 of s3 may" in findings(with_value(-1, values=[1, 2] * 6), caplog)
    # the only integer, inside the range of the others
    assert "error: it: 999 of s3" in findings(
        with_value(999, values=np.arange(12) * 200.5 + 0.3), caplog
    )


def test_clean_columns_are_not_reported(caplog):
    rng = np.random.default_rng(1)
    for n in (5, 12, 40):
        children, adults = rng.uniform(0.1, 17, n).round(1), rng.integers(18, 90, n)
        for column in (
            *(children, adults, np.where(rng.random(n) < 0.5, children.round(), adults)),
            *(rng.integers(0, 2, n), rng.random(n) < 0.1, rng.integers(1, 5, n)),
            *(rng.lognormal(8, 0.6, n), rng.normal(size=n), rng.poisson(1.5, n)),
            rng.normal(0, 5, 20 * n).round(),
            rng.integers(19_000_000, 21_000_000, 20 * n),  # not all of them could be dates
            with_value(31.5, values=adults),
            *(rng.choice([-1, 1], n), np.arange(n), 1000 + rng.permutation(n), np.full(n, 9.0)),
            *([-999.0] * n, with_value(np.nan, values=adults)),
            # zeros among doses, visits, counts; 0, 100 and 200
            *(np.arange(n) % 4 * 10, np.where(np.arange(n) % 2, rng.integers(20, 60, n), 0)),
            *(rng.poisson(5, n), np.arange(n) % 3 * 100, np.where(np.arange(n) % 3, 1, 200)),
        ):
            assert not findings(column, caplog), column
    assert not findings(["Aa", "AA", "b", "Müller"], caplog).startswith("error")
    assert not findings([0, 1, 2, 9, 1], caplog, categories=True).startswith("error")


def test_the_result_does_not_depend_on_the_order_of_the_values(caplog):
    for values in (with_value(-999), with_value(290), AGES):
        messages = {
            findings(order, caplog).count("of s")
            for order in (values, values[::-1], sorted(values))
        }
        assert len(messages) == 1


@pytest.mark.parametrize(
    "one, two, refused",
    [
        ("a", "A", False),
        ("é", "e\u0301", True),
        ("a", "a\u200b", True),
        ("a", "\ufeffa", True),
        ("site 1", "site\u00a01", True),
        ("m", "\uff4d", False),  # full width
        ("ﬁ", "fi", False),
        ("A", "\u0410", False),  # Cyrillic
        ("a-1", "a\u20131", False),  # an en dash
        ("01", "1", False),
        ("PO1", "P01", False),
        ("site_l", "site 1", False),
        ("O\u2019Hara", "O'Hara", False),
    ],
)
def test_names_of_groups_that_look_alike_are_named(one, two, refused, caplog):
    found = findings([one, "b", two, "b", one], caplog)
    assert found.startswith("error") == refused
    assert f"{one!a} (s0)" in found
    assert f"{two!a} (s2)" in found
    assert look_alikes([one, "b", "Al", "Ai", "10", "11"]) == []


def test_codes_among_names_of_groups_are_named(caplog):
    assert "error: it: -999 of s2 is a code" in findings(["f", "m", "-999", "f"], caplog)
    for cell in ("?", "None", "no data", "n.d."):
        assert f"{cell} of s2 may be a code" in findings(["f", "m", cell, "f"], caplog)
    assert "-9 of s2 may" in findings([1, 2, -9, 1, 2], caplog, categories=True)


def test_abbreviations_among_names_of_groups_are_named(caplog):
    for names in (["m", "Male"], ["1", "True"], ["0", "no"]):
        found = findings([*names, "b", "c", *names], caplog)
        assert "it: are {!r} and {!r} different groups?".format(*names) in found
    for names in (["A", "AB"], ["a", "bc"], ["0", "1"], ["1", "none of"]):
        assert "different groups" not in findings(names * 3, caplog)


def test_tables_of_windows_and_excel_are_read(tmp_path, caplog):
    names = ["head_1", "head_2", "Muller_3"]
    for folder in ("C:\\data\\heads\\", "heads\\", "\\\\server\\share\\", "../", "\u200b"):
        rows = [f"{folder}{file}" for file in ("head_2.ply", "Mu\u0308ller 3.ply", "head_1.ply")]
        text = "sep=;\n\ufeffShape ;;age;;\n" + "".join(
            f"{row};;{i};;;\n" for i, row in enumerate(rows, 2)
        )
        (tmp_path / "t.csv").write_text(text + ";;;;\n")
        table = read_table(tmp_path / "t.csv", names)
        assert {name: column.values.tolist() for name, column in table.items()} == {
            "age": [4, 2, 3]
        }
    for head, refused in (("age,Age", False), ("age,a\u200bge", True), ("\u00e9,e\u0301", True)):
        (tmp_path / "t.csv").write_text(f"shape,{head}\nhead_1,1,2\nhead_2,2,2\n")
        with pytest.raises(ValueError) if refused else nullcontext():
            read_table(tmp_path / "t.csv", names)
        assert refused or "['Age', 'age']" in caplog.text
    (tmp_path / "t.csv").write_text("shape,age,\nhead_1,1,\nhead_2,2,x\n")
    with pytest.raises(ValueError, match="unique names"):
        read_table(tmp_path / "t.csv", names)
