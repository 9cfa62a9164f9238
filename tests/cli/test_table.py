"""A CSV file as spreadsheets write it, at the command line."""

import sys
from importlib.util import find_spec

import numpy as np
import pandas as pd
import pytest

from conformodal.cli.table import TableError, choose_columns, read_table
from conformodal.conformal import ConformalRegressor
from conformodal.conformal.learning import location, process, quick
from conformodal.conformal.learning.location import boosting
from tests.helpers import invoke


def written(folder, text, encoding="utf-8"):
    path = folder / "own.csv"
    path.write_bytes(text.encode(encoding))
    return path


def test_an_export_of_a_german_spreadsheet_is_read(tmp_path):
    lines = 'Größe (cm);"Dosis; mg";Datum;Notiz', '1.170,5;0,5;01.02.2024;"a, b # c"', " 99;1;31.12.2024;"
    text = "\n".join([*lines, "80,25;;15.03.2024;x", ""])
    for encoding in ("utf-8-sig", "cp1252", "utf-16"):
        frame, notes = read_table(written(tmp_path, text, encoding))
        assert list(frame) == ["Größe (cm)", "Dosis; mg", "Datum", "Notiz"]
        assert frame["Größe (cm)"].tolist() == [1170.5, 99, 80.25]
        np.testing.assert_array_equal(frame["Dosis; mg"], [0.5, 1, np.nan])
        assert frame["Datum"].tolist() == [*pd.to_datetime(["2024-02-01", "2024-12-31", "2024-03-15"])]
        assert frame["Notiz"].tolist()[0] == "a, b # c"
        assert notes == [
            f"{tmp_path / 'own.csv'}: 3 rows, 4 columns separated by ';'",
            "Datum: dates, of which '01.02.2024' is read as 2024-02-01",
        ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('a,b\n"1,234",x\n"12,345",y\n', [1234, 12345]),
        ('a,b\n"1,234.5",x\n"2.5",y\n', [1234.5, 2.5]),
        ('a,b\n"1,5",x\n"2,25",y\n', [1.5, 2.25]),
        ("a\tb\n1,234\tx\n2\ty\n", [1234, 2]),  # with three decimals, 2 were 2,000
        ("a\tb\n1,234\tx\n2,500\ty\n", [1.234, 2.5]),
        ("a,b\n1.125,x\n2,y\n", [1.125, 2]),
        ("a\tb\n$1.125\tx\n$2\ty\n", [1.125, 2]),
        ("a;b\n1,125;x\n2;y\n", [1.125, 2]),
        ("a;b\n1.125;x\n2;y\n", [1125, 2]),
        ('a,b\n1.125,"0,5"\n2,"0,25"\n', [1125, 2]),
        ("a,b\n1.125,x\n1.234.567,y\n", [1125, 1234567]),
        ('a,b\n1.125,x\n"5,678",y\n', [1.125, 5678]),
        ("a;b\n1.234;0,5\n2.345;0,25\n", [1234, 2345]),  # as the decimal commas beside them
        ("a;b\n1.234;0.5\n2.345;0.25\n", [1.234, 2.345]),
        ("a;b\n1.234;x\n2345;y\n", [1.234, 2345]),
        ("a;b\n1.234;x\n0.345;y\n", [1.234, 0.345]),
        ('a,b\n"6,27,456.5",x\n"12,345",y\n', [627456.5, 12345]),
        ("a;b\n1'234.50;x\n2;y\n", [1234.5, 2]),
        ("a;b\n1\u2019234.50;x\n2;y\n", [1234.5, 2]),
        ("a,b\n\u22121.5,x\n+2,y\n", [-1.5, 2]),
        ("a,b\n(1.5),x\n2,y\n", [-1.5, 2]),
        ("a,b\n1.5-,x\n2,y\n", [-1.5, 2]),
        ("a,b\n1),x\n2),y\n", ["1)", "2)"]),
        ("a,b\n(1,x\n2,y\n", ["(1", "2"]),
        ("a,b\n+1-,x\n2,y\n", ["+1-", "2"]),
        ("a,b\n1.5%,x\n20 %,y\n", [1.5, 20]),
        ('a,b\n"$1,234.50",x\n-$2,y\n', [1234.5, -2]),
        ("a;b\n1.234,50 \u20ac;x\n2,5 \u20ac;y\n", [1234.5, 2.5]),
        ("a,b\n5 mm,x\n6 mm,y\n", [5, 6]),
        ("a,b\n5 mm,x\n6 cm,y\n", ["5 mm", "6 cm"]),
        ("a,b\nP5,x\nP6,y\n", ["P5", "P6"]),
        ("a,b\n12:30,x\n6:15,y\n", ["12:30", "6:15"]),
        ("a|b\n-1e3|x\n2|y\n", [-1000, 2]),
        ("a;b\n1 000,5;x\n2;y\n", [1000.5, 2]),
        ("a;b\n- 5 \u20ac;x\n12\u202f345 \u20ac;y\n", [-5, 12345]),
        ("a,b\n'5,x\n6,y\n", [5, 6]),
        ("a,b\n5'11,x\n5'9,y\n", ["5'11", "5'9"]),
        ("a,b\n48 30,x\n9 15,y\n", ["48 30", "9 15"]),
        ("a,b\n2020 123,x\n2021 456,y\n", ["2020 123", "2021 456"]),
        ('a,b\n"1,125e3",x\n2,y\n', [1125, 2]),
        ("a,b\n+,x\n-,y\n", ["+", "-"]),
        ("a,b\n1.2.3,x\n1.4.0,y\n", ["1.2.3", "1.4.0"]),
        ("a,b\n1 1/2,x\n2 1/4,y\n", ["1 1/2", "2 1/4"]),
        ("a;b\n1.2.3;x\n1,2;y\n", ["1.2.3", "1,2"]),
    ],
)
def test_decimal_and_thousands_marks(tmp_path, text, expected):
    assert read_table(written(tmp_path, text))[0]["a"].tolist() == expected


@pytest.mark.parametrize(
    ("text", "note"),
    [
        ('a,b\n1.125,x\n"5,678",y\n', "a: '5,678' is read as 5678"),
        ("a,b\n1,x\n(2),y\n", "a: '(2)' is read as -2"),
        (
            'a,b\n1,x\n"5 inch,2\n3,4\n"6 inch,5\n7,8\n',
            "1 row has values of several lines, such as row 2; a quote that is not closed joins rows",
        ),
    ],
)
def test_what_could_mean_two_things_is_told(tmp_path, text, note):
    assert note in read_table(written(tmp_path, text))[1]


def test_a_few_values_that_are_no_numbers_are_missing_and_told(tmp_path):
    text = "a,b\n" + "".join(f"{i},x\n" for i in range(30)) + "n.d.,x\n"
    frame, notes = read_table(written(tmp_path, text))
    assert np.isnan(frame["a"].iloc[-1])
    assert "a: 1 value taken as missing, such as 'n.d.'" in notes


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("sep=;\na;b\n1,5;2\n3;4\n", 2),
        ("Report of 2024\n\na,b\n1.5,2\n3,4\n", 2),
        ("# made by a tool\na,b\n1.5,2\n3,4\n", 2),
        ("a,b\n1.5,2,\n3,4,\n", 2),
        ("a,b,\n1.5,2,\n3,4,\n", 2),
        ("a,b\n\n1.5,2\n\n3,4\n", 2),
        ("a,b\r1.5,2\r3,4\r", 2),
        ('"a",b\n"1.5","2"\n"3","4"\n', 2),
        ("a,b\n[mm],[kg]\n" + "1.5,2\n" * 30, 31),
        ("| a | b |\n|1.5|2|\n|3|4|\n", 2),
    ],
)
def test_what_stands_around_the_values_is_passed_over(tmp_path, text, rows):
    frame, _ = read_table(written(tmp_path, text))
    assert len(frame) == rows
    assert frame["a"].dropna().iloc[0] == 1.5
    assert frame["b"].dropna().iloc[0] == 2


def test_a_name_of_two_lines_is_a_name(tmp_path):
    assert list(read_table(written(tmp_path, '"a\n(mm)",b\n1,2\n'))[0]) == ["a\n(mm)", "b"]


@pytest.mark.parametrize(
    ("days", "first"),
    [
        (["3/2/2024", "15/2/2024"], "2024-02-03"),
        (["3/2/2024", "2/15/2024"], "2024-03-02"),
        (["2024-03-02", "2024-02-15"], "2024-03-02"),
        (["3.2.24", "4.5.24"], "2024-02-03"),
        (["3/2/24", "4/5/24"], "2024-03-02"),
        (["2-Mar-2024", "15-Feb-2024"], "2024-03-02"),
    ],
)
def test_days_and_months_are_told_apart_by_the_whole_column(tmp_path, days, first):
    frame, notes = read_table(written(tmp_path, "\n".join(["a,b", *(f"{day},1" for day in days)])))
    assert frame["a"][0] == pd.Timestamp(first)
    assert f"a: dates, of which {days[0]!r} is read as {first}" in notes


@pytest.mark.parametrize("separator", [",", ";"])
@pytest.mark.parametrize("form", ["%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%d %H:%M"])
def test_a_year_in_front_is_followed_by_the_month(tmp_path, form, separator):
    days = pd.Series(pd.date_range("2024-01-01 10:30", "2024-12-31 10:30"))
    lines = [f"a{separator}b", f"15.3.2024{separator}1", *(f"{day:{form}}{separator}1" for day in days)]
    found = read_table(written(tmp_path, "\n".join(lines)))[0]["a"]
    assert found.dt.date.tolist() == [pd.Timestamp("2024-03-15").date(), *days.dt.date]


def test_dates_that_mix_their_orders_stay_text(tmp_path):
    assert read_table(written(tmp_path, "a,b\n15/2/2024,1\n2/15/2024,1\n"))[0]["a"].tolist()[0] == "15/2/2024"


def test_infinities_are_missing_and_codes_of_missing_values_are_told(tmp_path):
    text = "a,b\n" + "".join(f"{i},{i}\n" for i in range(40)) + "inf,-999\n1e400,-999\n"
    frame, notes = read_table(written(tmp_path, text))
    assert frame["a"].isna().sum() == 2
    assert "a: 2 values taken as missing, such as 'inf'" in notes
    assert "b: -999 occurs 2 times; leave cells empty if it means missing" in notes


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,y,a\n1,2,3\n", "several columns are called a"),
        ("a,a ,y\n1,2,3\n", "several columns are called a"),
        ("a,y\n1,5,2,5\n1,7,3,5\n", "above the columns, found 1, 5, 2; values that hold ','"),
        ("1.5,2\n3,4\n", "expected names above the columns"),
        ("a,y\n1,2\n1,5,2\n1,3\n", "row 2 has more values than the 2 names"),
    ],
)
def test_columns_that_are_not_clear_are_refused(tmp_path, text, says):
    with pytest.raises(TableError, match=says):
        read_table(written(tmp_path, text))


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"PK\x03\x04\x00\x00", "save the spreadsheet as CSV"), (b"", "cannot be read as CSV"), (b"\xff\xfea", "UTF-16")],
)
def test_what_is_no_table_is_refused(tmp_path, content, says):
    (tmp_path / "own.csv").write_bytes(content)
    with pytest.raises(TableError, match=says):
        read_table(tmp_path / "own.csv")


@pytest.mark.parametrize("line", ['"5 inch;1', '1;"5 inch'])  # in the second, commas alone find no quote
def test_a_quote_that_is_not_closed_is_refused_with_its_line(tmp_path, line):
    path = written(tmp_path, "\n".join(["a;b", "6;1", line, *["7;2"] * 40_000]))
    with pytest.raises(TableError, match=r"own\.csv: line 3: .* is its quote not closed"):
        read_table(path)


def frame(n=100):
    rng = np.random.default_rng(0)
    dose = rng.normal(size=n)
    dose[[3, 7]] = np.nan
    return pd.DataFrame(
        {
            "id": np.arange(n) + 1.0,
            "name": [f"patient {i}" for i in range(n)],
            "ward": rng.choice(["a", "b"], n),
            "empty": np.where(np.arange(n) < 90, np.nan, 1.0),
            "same": "yes",
            "age": rng.uniform(size=n),
            "dose": dose,
        }
    )


def test_columns_and_rows_that_say_nothing_are_left_out_and_told():
    X, y, lines = choose_columns(frame(), ["dose"], "ward", "f")
    assert list(X) == ["ward", "age"]
    assert list(y) == ["dose"]
    assert len(X) == 98
    told = " ".join(lines)
    for words in ("id (numbers the rows)", "name (another text", "empty (90% missing)", "same (one value", "rows 4, 8"):
        assert words in told
    assert "used: ward (text, 2 labels), age" in told


@pytest.mark.parametrize(
    ("targets", "group", "says"),
    [
        (["doze"], None, "has no column 'doze'; its columns are 'id'"),
        (["ward"], None, "target 'ward' must hold numbers, found '[ab]'"),
        (["dose", "dose"], None, "one part"),
        (["dose"], "dose", "one part"),
        (["dose"], "wards", "no column 'wards'"),
        (["empty"], None, "10 rows with all targets"),
    ],
)
def test_columns_that_cannot_be_used_are_refused(targets, group, says):
    with pytest.raises(TableError, match=says):
        choose_columns(frame(), targets, group, "f")


def test_a_table_of_targets_is_refused():
    with pytest.raises(TableError, match="learn from; all are targets"):
        choose_columns(frame()[["dose"]], ["dose"], None, "f")


@pytest.mark.parametrize(
    ("option", "name", "says"),
    [
        ("--model", "own.csv", "is not a saved regressor"),
        ("--model", ".", "is not a saved regressor"),
        ("--plot", "own.csv", "ends with .svg"),
        ("--plot", "new.gif", "ends with .svg"),
        ("--plot", "own.png", "is not a picture of this command"),
    ],
)
def test_other_files_are_not_overwritten(tmp_path, option, name, says):
    (tmp_path / "own.png").write_bytes(b"\x89PNG")
    path = written(tmp_path, "a,y\n1,2\n")
    result = invoke("table", path, "--target", "y", option, tmp_path / name)
    assert result.exit_code == 2
    assert says in result.stderr
    assert path.read_text() == "a,y\n1,2\n"
    assert not (tmp_path / "new.gif").exists()


def test_columns_can_be_left_out_and_groups_keep_whole_numbers():
    whole = frame().assign(site=np.arange(len(frame())) % 2 + 1.0)
    X, _, lines = choose_columns(whole, ["dose"], "site", "f", ["age"])
    assert "age" not in X
    assert "age (excluded)" in " ".join(lines)
    assert X["site"].dtype.kind == "i"
    with pytest.raises(TableError, match="has no column 'x'"):
        choose_columns(whole, ["dose"], None, "f", ["x"])
    with pytest.raises(TableError, match=r"a column has one part, .*, left out dose"):
        choose_columns(whole, ["dose"], None, "f", ["dose"])


def test_several_groups_are_refused(tmp_path):
    path = written(tmp_path, "a,b,y\n1,1,2\n")
    result = invoke("table", path, "--target", "y", "--group", "a", "--group", "b")
    assert result.exit_code == 2
    assert "--group names one column" in result.stderr


@pytest.mark.parametrize(("option", "package"), [("--plot", "matplotlib"), ("--model", "skops")])
def test_a_missing_extra_is_told_before_the_file_is_read(tmp_path, monkeypatch, option, package):
    monkeypatch.setitem(sys.modules, package, None)
    result = invoke("table", tmp_path / "missing.csv", "--target", "y", option, tmp_path / "new.png")
    assert result.exit_code == 2
    assert f"{option} needs {package}, which is not installed" in result.stderr


def test_the_regressor_is_saved_before_the_picture_is_drawn(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    pytest.importorskip("skops")
    shorten_fits(monkeypatch)
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", None)
    frame(150).to_csv(tmp_path / "own.csv", index=False)
    outputs = ("--model", tmp_path / "reg.cm", "--plot", tmp_path / "own.png")
    result = invoke("table", tmp_path / "own.csv", "--target", "dose", *outputs)
    assert result.exit_code == 70
    assert f"regressor: {tmp_path / 'reg.cm'}" in result.output
    assert ConformalRegressor.load(tmp_path / "reg.cm").bins_.names == ["dose"]


def shorten_fits(monkeypatch):
    for module in (quick, location):
        monkeypatch.setattr(module, "boosting", lambda rate, rounds, *rest: boosting(rate, 3, *rest))
    monkeypatch.setattr(process, "_STAGES", ((30, 3),))


def test_the_command_says_what_it_used_and_the_coverage_of_each_group(tmp_path, monkeypatch):
    shorten_fits(monkeypatch)
    X = frame(150)
    X["age"] = X["dose"].fillna(0) + 0.1 * X["age"]
    X.to_csv(tmp_path / "own.csv", sep=";", decimal=",", index=False, encoding="utf-8-sig")
    options = ("--model", tmp_path / "reg.cm") if find_spec("skops") else ()
    options += ("--plot", tmp_path / "own.png") if find_spec("matplotlib") else ()
    if options:  # what it has written it replaces
        assert invoke("table", tmp_path / "own.csv", "--target", "dose", *options).exit_code == 0
    result = invoke("table", tmp_path / "own.csv", "--target", "dose", "--group", "ward", *options)
    assert result.exit_code == 0, result.output
    assert not options or ConformalRegressor.load(options[1]).bins_.names == ["dose"]
    for words in ("used: ward (text, 2 labels), age", "dose: ", "(true: ", "coverage of dose", "group a", "group b"):
        assert words in result.output
    result = invoke("table", tmp_path / "own.csv", "--target", "doze")
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1


def test_a_file_that_is_not_there_is_refused_as_an_input(tmp_path):
    for path in (tmp_path / "missing.csv", tmp_path):
        result = invoke("table", path, "--target", "y")
        assert result.exit_code == 2
        assert str(path) in result.output.replace("\n", "")
