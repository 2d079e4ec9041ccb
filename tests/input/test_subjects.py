"""The table of the shapes.

What is read, what is refused, and that nothing but the statistics knows of it.
"""

import numpy as np
import pytest
import xarray as xr

from s4a import Options, analyse, cli, insert, open_study, statistics, synthetic
from s4a.input.annotations import read_labels, read_landmarks
from s4a.input.files import slugs
from s4a.input.subjects import read_table, subjects, with_table

OPTIONS = {"n_coarse": 150, "k_init": 8, "k": 12, "n_jobs": 1}
NAMES = [f"brain_{i:02d}" for i in range(1, 8)]
TABLE = "shape;sex;age;score\n" + "".join(
    f"{n};{'fm'[i % 2]};{20 + 7 * i};{i / 2}\n" for i, n in enumerate(NAMES)
)


@pytest.fixture(scope="module")
def brains():
    return {
        n: m.to_dataset() for n, m in synthetic.brains(7, 300, seed=3)["original"].children.items()
    }


@pytest.fixture(scope="module")
def folder(brains, tmp_path_factory):
    folder = tmp_path_factory.mktemp("subjects")
    (folder / "table.csv").write_text(TABLE)
    given = {n: m for n, m in brains.items() if n != "brain_07"}
    (folder / "six.csv").write_text("\n".join(TABLE.splitlines()[:-1]))
    analyse(given, store=folder / "study", table=folder / "six.csv", **OPTIONS).close()
    return folder


def test_columns_are_integers_numbers_or_text_in_the_order_of_the_shapes(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text('age,shape,site,weight\n31,"b 1.ply",Bern,60.5\n40,a,,NA\n')
    result = read_table(file, ["a", "b_1"])
    assert result["age"].values.tolist() == [40, 31]
    assert result["age"].dtype == np.int64
    assert result["site"].values.tolist() == ["", "Bern"]
    assert result["weight"].values == pytest.approx([np.nan, 60.5], nan_ok=True)
    assert result["age"].attrs["long_name"] == "column 'age' of the table of the shapes"


def test_a_row_may_name_the_file_of_its_shape_with_folders_and_gz(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text("shape,age\nb.nii.gz,4\na.nii.gz,3\n")
    assert read_table(file, slugs(["d/a.nii.gz", "d/b.nii.gz"]))["age"].values.tolist() == [3, 4]
    names = slugs(["d/s1/head.ply", "d/s2/head.ply"])
    for folder in ("", "d/", "/data/d/"):
        file.write_text(f"shape,age\n{folder}s2/head.ply,4\n{folder}s1/head.ply,3\n")
        assert read_table(file, names)["age"].values.tolist() == [3, 4]


def test_integers_that_are_too_large_are_floats(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text(f"shape,size\na,1{30 * '0'}\nb,-1\n")
    assert read_table(file, ["a", "b"])["size"].values.tolist() == [1e30, -1.0]


def test_digits_that_would_give_the_same_number_stay_text(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text("shape,who,age\na,90071992547409931,01\nb,90071992547409932,2\nc,-,3\n")
    result = read_table(file, ["a", "b", "c"])
    assert result["who"].values.tolist() == ["90071992547409931", "90071992547409932", ""]
    assert result["age"].values.tolist() == [1, 2, 3]
    file.write_text("shape,who\na,01\nb,1\nc,2\n")
    assert read_table(file, ["a", "b", "c"])["who"].values.tolist() == ["01", "1", "2"]


def test_what_says_that_a_value_is_missing_is_neither_number_nor_text(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text("shape,age,site\na,NA,n/a\nb,31,Bern\nc,-,-\nd,,NaN\n")
    result = read_table(file, list("abcd"))
    assert result["site"].values.tolist() == ["", "Bern", "", ""]
    assert result["age"].values == pytest.approx([np.nan, 31, np.nan, np.nan], nan_ok=True)


def test_a_column_that_is_mostly_numbers_is_named_with_its_cells(tmp_path, caplog):
    file = tmp_path / "table.csv"
    file.write_text("shape;age;size;code\na;31;60,5;1a\nb;?;61,0;2a\nc;40;62,5;3\n")
    result = read_table(file, list("abc"))
    assert [result[name].dtype.kind for name in ("age", "size", "code")] == ["U"] * 3
    assert "'age' is mostly numbers, but 1 of 3 cells are not (b: '?')" in caplog.text
    assert "'size' is mostly numbers, but 3 of 3 cells are not (a: '60,5'" in caplog.text
    assert "'code'" not in caplog.text


def test_a_person_of_several_shapes_is_named(tmp_path, caplog):
    file = tmp_path / "table.csv"
    file.write_text("shape,subject,age\na,p1,31\nb,p1,32\nc,p2,NA\n")
    read_table(file, list("abc"))
    assert "1 values of the column 'subject' have several shapes (p1: a, b)" in caplog.text


def test_rows_without_a_shape_are_ignored_and_shapes_without_a_row_lack_values(tmp_path, caplog):
    file = tmp_path / "table.csv"
    file.write_text("shape,site,age\na,Bern,31\nc.ply,Basel,42\n")
    result = read_table(file, ["a", "b"])
    assert result["shape"].values.tolist() == ["a", "b"]
    assert result["site"].values.tolist() == ["Bern", ""]
    assert result["age"].values == pytest.approx([31, np.nan], nan_ok=True)
    assert "rows ignored, as no shape has their name: c.ply" in caplog.text
    assert "no row, so all values are missing: b" in caplog.text


def test_statistics_leave_out_a_shape_that_has_no_row_in_the_table(example_study, caplog):
    study = example_study.copy()
    names = study["registration"]["shape"].values.tolist()
    study["subjects"] = subjects({"age": np.arange(5) ** 2}, names[1:])
    result = statistics.regression(study, "age", n_permutations=19)
    assert result.attrs["left_out"] == names[0]
    assert names[0] in caplog.text


@pytest.mark.parametrize(
    "text, words",
    [
        ("name,age\na,1\n", "a column 'shape' .* needed; found \\['name', 'age'\\]"),
        ("shape,age\nc,1\nA,2\n", r"names of the shapes \(a, b\) needed .* found c, A"),
        ("shape,age\na,1\nb,2\na,3\n", "found two for 'a'"),
        ("shape,age\n# b is odd\n\na,1\nb\n", "2 cells in every row needed; found 1 in line 5"),
        ("shape,a/b\na,1\nb,2\n", "without '/'; found 'a/b'"),
        ("shape,age,age\na,1,2\nb,1,2\n", "found 'age'"),
        ("shape\na\nb\n", "a column in addition to 'shape' needed"),
        (
            "shape,age\na,1\nb,1e999\n",
            "finite numbers, or nothing, needed in the column 'age'; found inf",
        ),
        ("", "cannot be read as a table: the file is empty"),
    ],
)
def test_a_wrong_table_is_named_with_what_was_needed_and_found(text, words, tmp_path):
    file = tmp_path / "wrong.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=f"wrong.csv.*{words}"):
        read_table(file, ["a", "b"])


def test_a_study_has_the_table_and_nothing_else_depends_on_it(folder, brains):
    given = {n: m for n, m in brains.items() if n != "brain_07"}
    work = folder / "study"
    with open_study(work) as study:
        assert study["subjects"]["age"].values.tolist() == [20, 27, 34, 41, 48, 55]
        assert Options.from_report(study).table.endswith("six.csv")
        modes = study["pca"].to_dataset().load()
    before = {
        p: p.stat().st_mtime_ns for p in [work / "latent.nc", *(work / "registration").iterdir()]
    }
    (folder / "other.csv").write_text((folder / "six.csv").read_text().replace("20", "99"))
    with analyse(given, store=work, table=folder / "other.csv", **OPTIONS) as again:
        assert again["subjects"]["age"].values[0] == 99
        assert (
            again["pca"].to_dataset().drop_attrs(deep=False).identical(modes.drop_attrs(deep=False))
        )
    with analyse(given, store=work, **OPTIONS) as again:
        assert again["subjects"]["age"].values[0] == 99  # a table stays until another is given
    analyse(given, store=work, table=folder / "six.csv", **OPTIONS).close()
    assert {p: p.stat().st_mtime_ns for p in before} == before


def test_a_table_of_other_meshes_is_named(folder, brains, tmp_path):
    given = {n: m for n, m in brains.items() if n in NAMES[:3]}
    rows = [line for line in TABLE.splitlines() if line.split(";")[0] in ("shape", *NAMES[:3])]
    (tmp_path / "three.csv").write_text("\n".join(rows))
    work = tmp_path / "study"
    first = analyse(given, store=work, table=tmp_path / "three.csv", **OPTIONS)
    same = analyse(given, store=work, **OPTIONS)
    assert "table" not in first["report"].attrs["remarks"] + same["report"].attrs["remarks"]
    first.close()
    same.close()
    given = {NAMES[0]: given[NAMES[1]], NAMES[1]: given[NAMES[1]], NAMES[5]: brains[NAMES[5]]}
    with analyse(given, store=work, **OPTIONS) as other:
        remarks = other["report"].attrs["remarks"]
    assert "three.csv, is kept, but it has no row for brain_06; it has rows for other" in remarks
    assert "other shapes: brain_03; the meshes have changed: brain_01: give" in remarks


def test_statistics_take_columns_and_say_which_values_are_missing(folder):
    with open_study(folder / "study") as study:
        by_name = statistics.group_test(study, "sex", covariates=["age"], n_permutations=19)
        age = study["subjects"]["age"].values
        given = statistics.group_test(study, list("fmfmfm"), covariates=age, n_permutations=19)
        assert by_name.drop_attrs().identical(given.drop_attrs())
        assert by_name.attrs["covariates"] == "covariate 'age'"
        by_sex = statistics.regression(study, "age", covariates=["sex"], n_permutations=9)
        assert by_sex.attrs["highest"] == age.max()
        assert by_sex.attrs["covariates"] == "covariate 'sex' as indicators of m against f"
        with pytest.raises(
            ValueError, match=r"group 'size' needs a column of that name .* has sex, age, score"
        ):
            statistics.group_test(study, "size")
        with pytest.raises(ValueError, match="a regression needs a variable of numbers"):
            statistics.regression(study, "sex")


def test_shapes_without_a_value_are_left_out_of_the_test_and_named(folder, caplog):
    with open_study(folder / "study") as study:
        registration = study["registration"].to_dataset().load()
        table = study["subjects"].to_dataset().load()
    holes = xr.DataTree.from_dict(
        {"registration": registration, "subjects": table.where(table["age"] < 50)}
    )
    result = statistics.regression(holes, "age", n_permutations=9)
    assert "no value for 1 of 6 shapes, which are excluded from the test: brain_06" in caplog.text
    five = registration.isel(shape=slice(5))
    alone = statistics.regression(
        xr.DataTree.from_dict({"registration": five}), table["age"].values[:5], n_permutations=9
    )
    assert result.attrs["left_out"] == "brain_06"
    assert result.drop_attrs().identical(alone.drop_attrs())
    assert statistics.regression_modes(holes, result)["pca"]["shape"].size == 5


def test_a_table_can_replace_the_first(folder):
    (folder / "site.csv").write_text("shape,site\n" + "".join(f"{n},x\n" for n in NAMES[:6]))
    with open_study(folder / "study") as study:
        other = with_table(study, folder / "site.csv")
        assert list(other["subjects"].data_vars) == ["site"]
        assert "sex" in study["subjects"]


@pytest.mark.usefixtures("short_films")
def test_the_command_prints_tables_and_writes_files(folder, capsys, monkeypatch):
    monkeypatch.setattr(
        "s4a.write_page",
        lambda tree, file, **_: file.write_text(str(tree["pca"].sizes["component"])),
    )
    flags = "--group sex --regress-on age --permutations 19".split()
    assert cli.main(["statistics", str(folder / "study"), *flags]) == 0
    message, out = capsys.readouterr().out, folder / "study" / "statistics"
    head = "groups of sex (f: 3, m: 3)"
    for words in (head, "family-wise", "outliers:", "others: lengths in mm"):
        assert words in message, words
    assert (out / "regression.html").read_text() == "1"
    assert (out / "regression.gif").read_bytes()[:3] == b"GIF"
    rows = (out / "outliers.shape.csv").read_text().splitlines()
    assert rows[0] == "shape,mahalanobis,outlier_p,left_out_error,outlier"
    assert [row.split(",")[0] for row in rows[1:]] == NAMES[:6]
    evaluation = np.genfromtxt(out / "evaluation.component.csv", delimiter=",", names=True)
    with xr.open_dataset(out / "evaluation.nc") as result:
        assert evaluation["compactness"] == pytest.approx(result["compactness"].values)
        assert evaluation["component"].tolist() == list(range(1, result.sizes["component"] + 1))
    for name in ("group", "group_map", "classification", "regression"):
        assert (out / f"{name}.nc").is_file(), name
    assert cli.main(["statistics", str(folder / "study"), "--group", "site"]) == 2
    assert "group 'site' needs a column of that name" in capsys.readouterr().err


def test_the_command_refuses_what_makes_no_test_and_says_a_warning_once(folder, capsys, caplog):
    command = ["statistics", str(folder / "study"), "--out", str(folder / "few")]
    for n in ("-1", "0", str(10**9)):
        assert cli.main([*command, "--group", "sex", "--permutations", n]) == 2
        assert "--permutations must be an integer of at" in capsys.readouterr().err
    caplog.clear()
    flags = ["--group", "sex", "--covariates", "score", "--permutations", "9"]
    assert cli.main([*command, *flags, "--variances", "unequal"]) == 0
    assert caplog.text.count("groups under 10 shapes (f: 3, m: 3)") == 1
    assert "adjusted for covariate 'score'" in capsys.readouterr().out


def test_the_command_inserts_shapes(folder, brains, tmp_path, capsys):
    from s4a import write_mesh
    from s4a.geometry.mesh import as_arrays

    mesh = brains["brain_07"]
    write_mesh(tmp_path / "brain_07.ply", *as_arrays(mesh), coordinate_system="RAS", unit="mm")
    (tmp_path / "broken.ply").write_text("no mesh")
    out = ["--out", str(tmp_path / "out"), "--n-jobs", "1"]
    command = ["insert", str(folder / "study"), str(tmp_path), *out]
    assert cli.main(command) == 1  # one of them is excluded
    message = capsys.readouterr().out.splitlines()
    assert message[0].split()[:4] == ["shape", "confidence", "round", "trip"]
    assert "excluded" in message[2]
    with (
        xr.open_datatree(tmp_path / "out" / "inserted.nc") as tree,
        open_study(folder / "study") as study,
    ):
        alone = insert(study, tmp_path / "brain_07.ply")
        np.testing.assert_array_equal(tree["pca"]["score"], alone["pca"]["score"])
        assert tree["registration/brain_07"]["template_triangle"].sizes == {"original_vertex": 300}
    scores = (tmp_path / "out" / "scores.csv").read_text().splitlines()
    assert scores[1].split(",")[0] == "brain_07"
    assert (tmp_path / "out" / "brain_07.ply").is_file()


@pytest.mark.parametrize(
    "data, message",
    [
        ("shape,âge\na,1\n".encode("utf-16"), "found UTF-16: save it as CSV UTF-8"),
        ("shape,age\na,1\n".encode("utf-16-le"), "found UTF-16: save it as CSV UTF-8"),
        ("shape,age\nà,1\n".encode("latin-1"), "byte 0xe0 in line 2: .* Latin-1 .* 'à'"),
        (b"shape,age\na,1\0\n", "the byte 0 in line 2: the file seems to be binary or damaged"),
        (b"PK\x03\x04\x14\0", "found a workbook or an archive: export it as CSV UTF-8"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "found a workbook or an archive"),
        (b"", "the file is empty"),
        (b"\xef\xbb\xbf", "the file is empty"),
    ],
)
def test_a_table_in_another_encoding_is_an_error_that_names_the_encoding(tmp_path, data, message):
    file = tmp_path / "table.csv"
    file.write_bytes(data)
    with pytest.raises(ValueError, match=rf"table.csv cannot be read as a table: .*{message}"):
        read_table(file, ["a"])
    with pytest.raises(ValueError, match=rf"table.csv cannot be read as labels: .*{message}"):
        read_labels(file.rename(tmp_path / "labels_table.csv"))
    if not data.startswith(b"PK"):
        expected = rf"table.csv cannot be read as landmarks: .*{message}"
        with pytest.raises(ValueError, match=expected):
            read_landmarks(tmp_path / "labels_table.csv")


def test_a_table_with_the_mark_of_utf_8_is_read(tmp_path):
    (tmp_path / "table.csv").write_text("shape,age\na,1\n", encoding="utf-8-sig")
    assert read_table(tmp_path / "table.csv", ["a"])["age"].values.tolist() == [1]
