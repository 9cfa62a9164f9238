"""A CSV file as spreadsheets write it, at the command line."""

import json
import re
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from conformodal.cli import table_predict
from conformodal.cli.table import RowSplit, _draw, _split_rows, choose_columns, doubt_targets
from conformodal.cli.table_csv import CsvFormat, TableError, read_table
from conformodal.conformal import ConformalRegressor, PredictiveDensity, QuantileBins, SplitConformal, diagnose
from conformodal.conformal.tables import as_inputs
from tests.helpers import invoke, refusal, run_ok

pytestmark = pytest.mark.usefixtures("short_fits")


def written(folder, text, encoding="utf-8"):
    path = folder / "own.csv"
    path.write_bytes(text.encode(encoding))
    return path


def test_an_export_of_a_german_spreadsheet_is_read(tmp_path):
    lines = 'Größe (cm);"Dosis; mg";Datum;Notiz', '1170,5;0,5;01.02.2024;"a, b # c"', " 99;1;31.12.2024;"
    text = "\n".join([*lines, "80,25;;15.03.2024;x", ""])
    for encoding in ("utf-8-sig", "cp1252", "utf-16"):
        table, notes = read_table(written(tmp_path, text, encoding))
        assert list(table) == ["Größe (cm)", "Dosis; mg", "Datum", "Notiz"]
        assert table["Größe (cm)"].tolist() == [1170.5, 99, 80.25]
        np.testing.assert_array_equal(table["Dosis; mg"], [0.5, 1, np.nan])
        assert table["Datum"].tolist() == [*pd.to_datetime(["2024-02-01", "2024-12-31", "2024-03-15"])]
        assert table["Notiz"].tolist()[0] == "a, b # c"
        assert "'01.02.2024' is read as 2024-02-01" in " ".join(notes)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('a,b\n"1,5",x\n"2,25",y\n', [1.5, 2.25]),
        ("a,b\n1.125,x\n2,y\n", [1.125, 2]),
        ("a;b\n1,125;x\n2;y\n", [1.125, 2]),
        ("a;b\n0.125;x\n2.345;y\n", [0.125, 2.345]),
        ("a;b\n1.234;0.5\n2.345;0.25\n", [1.234, 2.345]),
        ("a|b\n-1e3|x\n2|y\n", [-1000, 2]),
        ("a,b\n5 mm,x\n6 cm,y\n", ["5 mm", "6 cm"]),
        ("a,b\n(1.5),x\n2,y\n", ["(1.5)", "2"]),
    ],
)
def test_the_decimal_mark_is_recognised(tmp_path, text, expected):
    assert read_table(written(tmp_path, text))[0]["a"].tolist() == expected


@pytest.mark.parametrize(
    ("text", "given", "expected"),
    [
        ('a,b\n"1,234",x\n"12,345.5",y\n', CsvFormat(thousands=","), [1234, 12345.5]),
        ("a;b\n1.234,50;x\n2,5;y\n", CsvFormat(thousands="."), [1234.5, 2.5]),
        ("a;b\n1.234;x\n2;y\n", CsvFormat(thousands="."), [1234, 2]),
        ("a;b\n1.234;x\n2;y\n", CsvFormat(decimal="."), [1.234, 2]),
        ("a,b\n-999,x\n2,y\n", CsvFormat(na_values=["-999"]), [None, 2]),
        ("a:b\n1:x\n2:y\n", CsvFormat(sep=":"), [1, 2]),
    ],
)
def test_marks_that_are_named_are_read(tmp_path, text, given, expected):
    column = read_table(written(tmp_path, text), given)[0]["a"]
    np.testing.assert_array_equal(column, np.array(expected, dtype=float))


@pytest.mark.parametrize(
    ("text", "doubt"),
    [
        pytest.param('a,b\n"1,234",x\n"12,345",y\n', "'1,234' in line 2", id="quoted commas"),
        pytest.param('a,b\n1.125,x\n"5,678",y\n', "'5,678' in line 3", id="one comma"),
        pytest.param("a;b\n1.234;x\n2;y\n", "'1.234' in line 2", id="points"),
        pytest.param("a;b\n1.234;0,5\n2.345;0,25\n", "'1.234' in line 2", id="decimal commas elsewhere"),
        pytest.param("a\tb\n1,234\tx\n2\ty\n", "'1,234' in line 2", id="commas between tabs"),
        pytest.param(
            "a;b\n1.234;0.5\n2,5;0.5\n1.5;0.5\n",
            "'1.234' in line 2 may have marks between thousands, as '2,5' in line 3 has another mark",
            id="points and commas",
        ),
    ],
)
def test_ambiguous_thousands_separators_are_refused(tmp_path, text, doubt):
    with pytest.raises(TableError, match=rf"own\.csv: column 'a': .*{re.escape(doubt)}.* --thousands"):
        read_table(written(tmp_path, text))


@pytest.mark.parametrize(
    ("rows", "named"),
    [
        (["1.125", "2"], "'1.125'"),
        ([*map(str, range(30)), "n.d."], "'n.d.'"),
        ([*map(str, range(40)), "inf", "1e400"], "'inf'"),
        ([*map(str, range(40)), "-999", "-999"], "--na-values=-999"),
        (["1", '"5 inch,2', "3", '"6 inch', "7"], "line 3"),
    ],
)
def test_ambiguous_values_are_reported(tmp_path, rows, named):
    _, notes = read_table(written(tmp_path, "a,b\n" + "".join(f"{row},1\n" for row in rows)))
    assert named in " ".join(notes)


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("sep=;\na;b\n1,5;2\n3;4\n", 2),
        ("Report of 2024\n\na,b\n1.5,2\n3,4\n", 2),
        ("# made by a tool\na,b\n1.5,2\n3,4\n", 2),
        ("a,b\n1.5,2,\n3,4,\n", 2),
        ("a,b,\n1.5,2,\n3,4,\n", 2),
        ('"a",b\n"1.5","2"\n"3","4"\n', 2),
        ("TOA5,Roof,CR1,12\na,b\nmm,kg\n" + "1.5,2\n" * 60, 61),
        ("TOA5,12\na,b\nmm,kg\n" + "1.5,2\n" * 60, 61),
        ("a,b\n[mm],[kg]\n" + "1.5,2\n" * 30, 31),
    ],
)
def test_what_stands_around_the_values_is_passed_over(tmp_path, text, rows):
    values, _ = read_table(written(tmp_path, text))
    assert len(values) == rows
    assert values["a"].dropna().iloc[0] == 1.5
    assert values["b"].dropna().iloc[0] == 2


@pytest.mark.parametrize(
    ("days", "first"),
    [
        (["3/2/2024", "15/2/2024"], "2024-02-03"),
        (["3/2/2024", "2/15/2024"], "2024-03-02"),
        (["2024-03-02", "2024-02-15"], "2024-03-02"),
        (["3/2/24", "4/5/24"], "2024-03-02"),
        (["2-Mar-2024", "15-Feb-2024"], "2024-03-02"),
        (["20240302T000000", "20240215T120000"], "2024-03-02"),
    ],
)
def test_the_whole_column_decides_the_date_order(tmp_path, days, first):
    values, notes = read_table(written(tmp_path, "\n".join(["a,b", *(f"{day},1" for day in days)])))
    assert values["a"].iloc[0] == pd.Timestamp(first)
    assert f"a: dates, of which {days[0]!r} is read as {first}" in notes


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"a,y,a\n1,2,3\n", "called a"),
        (b"a,a ,y\n1,2,3\n", "called a"),
        (b"a,y\n1,5,2,5\n1,7,3,5\n", "names"),
        (b"1.5,2\n3,4\n", "names"),
        (b"a,y\n1,2\n1,5,2\n1,3\n", "line 3"),
        (b"PK\x03\x04\x00\x00", "CSV"),
        (b"", "CSV"),
        (b"\xff\xfea", "UTF-16"),
    ],
)
def test_what_is_not_clear_is_refused(tmp_path, content, named):
    (tmp_path / "own.csv").write_bytes(content)
    with pytest.raises(TableError, match=rf"own\.csv: .*{named}"):
        read_table(tmp_path / "own.csv")


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


def test_omitted_columns_and_rows_are_reported():
    X, y, lines = choose_columns(frame(), ["dose"], "ward", "f")
    assert list(X) == ["ward", "age"]
    assert list(y) == ["dose"]
    assert len(X) == 98
    told = " ".join(lines)
    for words in (
        "id (numbers the rows)",
        "name (another text",
        "empty (90% missing)",
        "same (one value",
        "lines 3, 7",
    ):
        assert words in told
    assert "used: ward (text, 2 labels), age" in told


@pytest.mark.parametrize("at", [30, 99])
@pytest.mark.parametrize("label", [None, "Total", "x"])
def test_omitted_totals_and_index_are_reported(at, label):
    table = frame()[["ward", "age"]].assign(dose=np.arange(100) + 1.0)
    table.loc[at, ["age", "dose"]] = table.drop(index=at)[["age", "dose"]].sum()
    table.loc[at, "ward"] = label
    table.insert(0, "column 1", np.sort(np.random.default_rng(0).choice(900, 100, False)) * 1.0)
    X, _, lines = choose_columns(table, ["dose"], None, "f")
    assert at not in X.index
    assert len(X) == 99
    assert list(X) == ["ward", "age"]
    assert f"1 row with totals of the others (lines {at})" in " ".join(lines)
    assert "column 1 (an index)" in " ".join(lines)


@pytest.mark.parametrize(
    ("targets", "group", "excluded", "named"),
    [
        (["doze"], None, [], "'doze' .did you mean 'dose'"),
        (["ward"], None, [], "'ward'"),
        (["dose", "dose"], None, [], "dose"),
        (["dose"], "dose", [], "dose"),
        (["dose"], "wards", [], "'wards'"),
        (["empty"], None, [], "10 rows"),
        (["dose"], None, ["x"], "'x'"),
        (["dose"], None, ["dose"], "dose"),
    ],
)
def test_columns_that_cannot_be_used_are_refused(targets, group, excluded, named):
    with pytest.raises(TableError, match=f"^f: .*{named}"):
        choose_columns(frame(), targets, group, "f", excluded)


@pytest.mark.parametrize(
    "options",
    [
        "--model own.csv", "--model .", "--plot own.csv", "--plot new.gif", "--plot own.png", "--sep ab",
        "--group a --group b", "--alpha 90", "--alpha 0.9", "--seed -1", "--unit a --group a",
    ],
)  # fmt: skip
def test_refused_options_overwrite_nothing(tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.png").write_bytes(b"\x89PNG")
    path = written(tmp_path, "a,y\n" + "1,2\n" * 60)
    told = refusal("table", path, "--target", "y", *options.split())
    option, value = options.split()[:2]
    assert option.strip("-") in told or value in told
    assert path.read_text().startswith("a,y\n1,2\n")
    assert {p.name for p in tmp_path.iterdir()} == {"own.csv", "own.png"}


@pytest.mark.parametrize(("option", "package"), [("--plot", "matplotlib"), ("--model", "skops")])
def test_a_missing_extra_is_named_before_the_file_is_read(tmp_path, monkeypatch, option, package):
    monkeypatch.setitem(sys.modules, package, None)
    told = refusal("table", tmp_path / "missing.csv", "--target", "y", option, tmp_path / "new.png")
    assert option in told
    assert package in told


def test_dollars_in_a_targets_name_are_drawn_as_they_are(tmp_path):
    pytest.importorskip("matplotlib")
    name, rng, proba = "$5_% to $6_%", np.random.default_rng(0), np.full((50, 10), 0.1)
    bins = QuantileBins(10).fit(rng.random(100))
    bins.names = [name]
    split, y = SplitConformal(bins).calibrate(proba, rng.random(50)), rng.random(50)
    found = diagnose(split, proba, y)
    _draw(PredictiveDensity(bins, [proba]), split.predict(proba), pd.DataFrame({name: y}), found, tmp_path / "own.svg")
    assert f"<!-- {name}: sets, alpha = 0.1 -->" in (tmp_path / "own.svg").read_text()


def test_the_command_prints_columns_and_group_coverage(tmp_path):
    pytest.importorskip("matplotlib")
    pytest.importorskip("skops")
    X = frame(150)
    X["age"] = X["dose"].fillna(0) + 0.1 * X["age"]
    X.to_csv(tmp_path / "own.csv", sep=";", decimal=",", index=False, encoding="utf-8-sig")
    outputs = ("--model", tmp_path / "reg.cm", "--plot", tmp_path / "own.png")
    warnings.simplefilter("error", UserWarning)  # what is to be known is told as a note
    for options in (("--unit", "name"), ("--split", "time"), ("--group", "ward")):  # what it has written it replaces
        result = invoke("table", tmp_path / "own.csv", "--target", "dose", *outputs, *options)
        assert result.exit_code == 0, result.output
    assert ConformalRegressor.load(tmp_path / "reg.cm").bins_.names == ["dose"]
    for words in ("used: ward (text, 2 labels), age", "dose: ", "(true: ", "coverage of dose", "group a", "group b"):
        assert words in result.output


def rentals(n=400):
    rng = np.random.default_rng(0)
    hours = pd.date_range("2023-12-25", periods=n, freq="7h")
    level = 100 + 80 * np.sin(2 * np.pi * hours.hour / 24) + rng.normal(0, 5, n).round()
    casual = rng.integers(0, 50, n)
    return pd.DataFrame(
        {"id": [f"r{i}" for i in range(n)], "when": hours.strftime("%d/%m/%Y %H:%M"), "site": rng.choice(["a", "b"], n)}
    ).assign(casual=casual, registered=level.round() - casual, count=level.round())


def test_doubtful_targets_are_reported():
    table, X = rentals(), rentals()[["casual", "registered"]].astype(float)
    told = " ".join(doubt_targets(X, table[["count"]], -np.inf))
    assert "count is never negative" in told
    assert "count holds whole numbers" in told
    assert "count equals the sum of casual and registered" in told
    assert doubt_targets(X[["casual"]], table[["count"]] + 0.5, 0.0) == []


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_saved_model_matches_columns_by_name(tmp_path, monkeypatch, kind):
    pytest.importorskip("skops")
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(table_predict, "_ROWS", 4)  # at once
    table = rentals().drop(columns=["casual", "registered"])
    dated = table.assign(when=pd.to_datetime(table["when"], format="%d/%m/%Y %H:%M"))
    (table.to_csv if kind == "csv" else dated.to_parquet)(tmp_path / f"old.{kind}", index=False)
    fit = ("--target", "count", "--model", tmp_path / "reg.cm", "--min", 0, "--group", "site")
    told = run_ok("table", "fit", tmp_path / f"old.{kind}", *fit).output
    assert "when (date: year, month, day of the year, weekday and hour)" in told
    reg = ConformalRegressor.load(tmp_path / "reg.cm")
    new = dated.iloc[40:55].assign(extra=1)
    known, expected = new, reg.predict_table(new.assign(when=new["when"].dt.tz_localize("UTC")))
    assert (new["when"].dt.day <= 12).all()  # and are read as in training
    if kind == "csv":
        new = new.assign(when=new["when"].dt.strftime("%d/%m/%Y %H:%M"))
    shuffled = new[[*reversed(new.columns)]]
    write = shuffled.to_csv if kind == "csv" else shuffled.to_parquet
    write(tmp_path / f"new.{kind}", index=False)
    told = run_ok("table", "predict", tmp_path / "reg.cm", tmp_path / f"new.{kind}", "--out", tmp_path / "out.parquet")
    assert "not read: extra and count" in told.output
    result = parquet.read_table(tmp_path / "out.parquet").to_pandas()
    assert result["row"].tolist() == [*range(15)]
    assert result["id"].tolist() == new["id"].tolist()
    np.testing.assert_allclose(result["count"], expected["count"], rtol=1e-12)  # sums of rows in another order
    np.testing.assert_array_equal(result["count_high"], expected["count_high"])
    regions = reg.predict_region(as_inputs(reg, known), groups=known["site"])
    for i, parts in enumerate(result["count_intervals"]):
        np.testing.assert_array_equal([[part["low"], part["high"]] for part in parts], regions.intervals(i)[0])
        assert 0 < sum(part["probability"] for part in parts) <= 1 + 1e-9
    gaps = shuffled.assign(site=shuffled["site"].where(np.arange(15) != 2))
    (gaps.to_csv if kind == "csv" else gaps.to_parquet)(tmp_path / f"gaps.{kind}", index=False)
    told = run_ok(
        "table", "predict", tmp_path / "reg.cm", tmp_path / f"gaps.{kind}", "--out", tmp_path / "filled.parquet"
    )
    assert "site is missing in 1" in told.output
    ends = parquet.read_table(tmp_path / "filled.parquet").to_pandas()["count_high"]
    np.testing.assert_array_equal(ends, np.where(np.arange(15) == 2, np.inf, result["count_high"]))
    run_ok("table", "predict", tmp_path / "reg.cm", tmp_path / f"new.{kind}", "--out", tmp_path / "out.csv")
    text = pd.read_csv(tmp_path / "out.csv")
    assert json.loads(text["count_intervals"][0])[0]["low"] == result["count_low"][0] >= 0


def test_new_rows_of_another_schema_are_refused(tmp_path):
    pytest.importorskip("skops")
    pytest.importorskip("pyarrow")
    table = rentals()
    table.to_csv(tmp_path / "old.csv", index=False)
    run_ok("table", tmp_path / "old.csv", "--target", "count", "--exclude", "casual,id", "--model", tmp_path / "reg.cm")
    cases = {
        "lacks the columns ['when']": table.drop(columns="when"),
        "registered held numbers": table.assign(registered="many"),
        "when held dates": table.assign(when=1.5),
    }
    predict = ("table", "predict", tmp_path / "reg.cm", tmp_path / "new.csv", "--out")
    for words, new in cases.items():
        new.to_csv(tmp_path / "new.csv", index=False)
        told = refusal(*predict, tmp_path / "out.csv")
        assert words in told
        assert "new.csv" in told
    assert not (tmp_path / "out.csv").exists()
    assert "--out" in refusal(*predict, tmp_path / "o.txt")


def test_drift_in_the_last_rows_is_reported(tmp_path):
    rows = [f"{i % 7},{i % 7 + 0.1 * (i % 11) + 50 * (i >= 240)}" for i in range(300)]
    (tmp_path / "a.csv").write_text("\n".join(["x,y", *rows]))
    assert "the data seem to drift" in run_ok("table", tmp_path / "a.csv", "--target", "y", "--split", "time").output


MARKS = {
    "space that does not break": ("a;y\n0,5;1\u00a0234,50\n0,25;999,50\n", [1234.5, 999.5]),
    "narrow space": ("a;y\n0,5;1\u202f234\u202f567,5\n0,25;999,50\n", [1234567.5, 999.5]),
    "minus sign": ("a,y\n0.5,\u22121.25\n0.25,2.5\n", [-1.25, 2.5]),
}


@pytest.mark.parametrize("mark", MARKS)
@pytest.mark.parametrize("times", [1, 40])
def test_typographic_marks_of_few_numbers_are_read(tmp_path, mark, times):
    text, values = MARKS[mark]
    head, first, second = text.splitlines(keepends=True)
    (tmp_path / "t.csv").write_text(head + first + second * times, encoding="utf-8")
    frame, notes = read_table(tmp_path / "t.csv")
    assert frame["y"].tolist() == [values[0]] + [values[1]] * times
    assert not [note for note in notes if "missing" in note]


UNITS = {
    "a unit": (["12 kg", "3.5 kg", "7 kg"], [12, 3.5, 7], "numbers in 'kg', of which '12 kg' in line 2"),
    "percent": (["5%", "12.5 %", "7 %"], [5, 12.5, 7], "numbers in '%', of which '5%' in line 2"),
    "a currency": (["$5", "$12.50", "$7"], [5, 12.5, 7], "numbers in '$', of which '$5' in line 2"),
    "limits": (["3", "<0.5", "2"], [3, 0.5, 2], "1 value, such as '<0.5' in line 3, read as the limit"),
    "decimal commas": (["3.5", "1,25", "2.5"], [3.5, 1.25, 2.5], "such as '1,25' in line 3, read with a decimal comma"),
    "several units": (["12 kg", "300 g", "7 kg"], None, "'12 kg' in line 2 and '300 g' in line 3; read as text"),
    "some percent": (["12 %", "0.3", "7 %"], None, "'12 %' in line 2 and '0.3' in line 3; read as text"),
    "codes": (["12A", "3B", "7C"], None, None),
    "limits alone": (["<10", ">20", "<10"], None, None),
}


@pytest.mark.parametrize("case", UNITS)
def test_units_and_limits_in_numbers_are_read_if_clear(tmp_path, case):
    cells, expected, told = UNITS[case]
    (tmp_path / "t.csv").write_text("v;x\n" + "".join(f"{cell};0.5\n" for cell in cells))
    frame, notes = read_table(tmp_path / "t.csv")
    assert frame["v"].tolist() == (cells if expected is None else expected)
    notes = [note for note in notes if note.startswith("v: ")]
    assert len(notes) == (told is not None)
    assert told is None or told in notes[0]


@pytest.mark.parametrize("cells", [["3", "<0.5", "2"], ["12 kg", "300 g", "7 kg"], ["1", "2 %"] + ["3"] * 40])
def test_a_target_of_limits_or_several_units_is_refused(tmp_path, cells):
    (tmp_path / "t.csv").write_text("v;x\n" + "".join(f"{cell};0.5\n" for cell in cells))
    frame, _ = read_table(tmp_path / "t.csv")
    with pytest.raises(TableError, match=r"target 'v' has .* in line 3"):
        choose_columns(frame, ["v"], None, "t.csv")


def test_another_unit_than_that_learnt_from_is_refused(tmp_path):
    (tmp_path / "t.csv").write_text("v,x\n12 kg,1\n3 kg,2\n")
    assert read_table(tmp_path / "t.csv", CsvFormat(units={"v": "kg"}))[0].attrs["format"]["units"] == {"v": "kg"}
    for before, words in (("g", "'g'"), ("", "no unit")):
        with pytest.raises(TableError, match=rf"column 'v' has 'kg', and had {words}"):
            read_table(tmp_path / "t.csv", CsvFormat(units={"v": before}))


def test_dates_are_read_in_the_format_that_is_named(tmp_path):
    (tmp_path / "t.csv").write_text("d,x\n010224,1\n030224,2\n")
    assert read_table(tmp_path / "t.csv")[0]["d"].tolist() == [10224, 30224]
    frame, _ = read_table(tmp_path / "t.csv", CsvFormat(dates={"d": "%d%m%y"}))
    assert frame["d"].tolist() == [pd.Timestamp("2024-02-01"), pd.Timestamp("2024-02-03")]
    assert frame["x"].tolist() == [1, 2]
    with pytest.raises(TableError, match=r"'d' must hold dates as %Y-%m-%d, got '010224' in line 2"):
        read_table(tmp_path / "t.csv", CsvFormat(dates={"d": "%Y-%m-%d"}))
    assert "COLUMN=FORMAT" in refusal("table", tmp_path / "t.csv", "--target", "x", "--date", "%d%m%y")


WORDS = {
    "a label": (["None", "A", "B"], ["None", "A", "B"], "'None' in 1 cell is a label"),
    "a gap beside gaps": (["NA", "", "B"], [None, None, "B"], "'NA' in 1 cell is taken as missing"),
    "a gap in numbers": (["NA", "1", "2"], [None, 1.0, 2.0], None),
    "nothing else": (["NA", "NA", "NA"], [None, None, None], "is taken as missing"),
}


@pytest.mark.parametrize("case", WORDS)
def test_missing_value_words_are_labels_in_text_columns(tmp_path, case):
    cells, expected, told = WORDS[case]
    (tmp_path / "t.csv").write_text("x,v\n" + "".join(f"{k},{cell}\n" for k, cell in enumerate(cells)))
    frame, notes = read_table(tmp_path / "t.csv")
    assert [None if pd.isna(value) else value for value in frame["v"]] == expected
    assert [note for note in notes if note.startswith("v: ")] == [note for note in notes if told and told in note]
    again, _ = read_table(tmp_path / "t.csv", CsvFormat(kinds={"v": "text with NA"}, verbatim=["x"]))
    assert again["v"].notna().sum() == (2 if case == "a gap beside gaps" else 3)
    assert again["x"].tolist() == ["0", "1", "2"]


def test_identifiers_are_copied_as_they_are_written(tmp_path):
    pytest.importorskip("skops")
    parquet = pytest.importorskip("pyarrow.parquet")
    rng = np.random.default_rng(0)
    ids = {"code": [f"{k:05d}" for k in range(60)], "order": [str(2**53 + k) for k in range(60)]}
    table = pd.DataFrame(ids | {"x": rng.normal(size=60).round(3)}).assign(y=lambda t: 2 * t["x"])
    table.to_csv(tmp_path / "t.csv", index=False)
    options = ("--target", "y", "--exclude", "code,order", "--model", tmp_path / "m.cm")
    run_ok("table", "fit", tmp_path / "t.csv", *options)
    run_ok("table", "predict", tmp_path / "m.cm", tmp_path / "t.csv", "--out", tmp_path / "r.parquet")
    result = parquet.read_table(tmp_path / "r.parquet").to_pandas()
    assert {name: result[name].tolist() for name in ids} == ids


def as_read(table):
    """How a file is written that is read as one before it, by its table."""
    form = table.attrs["format"]
    return CsvFormat(kinds=form["kinds"], missing=form["missing"])


ORDERS = {
    "month first, beside semicolons": ("d,x\n02/13/2024,1\n", "d;x\n03/04/2024;1\n", "2024-03-04"),
    "month first, with points": ("d,x\n02/13/2024,1\n", "d,x\n03.04.2024,1\n", "2024-03-04"),
    "month first by default": ("d,x\n02/03/2024,1\n", "d;x\n03/04/2024;1\n", "2024-03-04"),
    "day first, beside commas": ("d;x\n03/04/2024;1\n", "d,x\n03/04/2024,1\n", "2024-04-03"),
    "day first, and another proof": ("d;x\n03/04/2024;1\n", "d,x\n03/04/2024,1\n03/13/2024,1\n", "2024-03-04"),
    "no order in years first": ("d;x\n2024-02-03;1\n", "d,x\n03/04/2024,1\n", "2024-03-04"),
    "no order in names of months": ("d;x\n3-Feb-2024;1\n", "d,x\n03/04/2024,1\n", "2024-03-04"),
}


@pytest.mark.parametrize("case", ORDERS)
def test_the_order_of_dates_is_that_learnt_from(tmp_path, case):
    before, new, expected = ORDERS[case]
    learnt, _ = read_table(written(tmp_path, before))
    values, _ = read_table(written(tmp_path, new), as_read(learnt))
    assert values["d"].iloc[0] == pd.Timestamp(expected)


@pytest.fixture(scope="module")
def learnt(short_fits, tmp_path_factory):
    """A saved regressor of a file with codes, months first, and two words for missing values."""
    pytest.importorskip("skops")
    pytest.importorskip("pyarrow")
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("learnt")
    x = rng.uniform(0, 10, 200).round(3)
    table = pd.DataFrame({"x": x, "code": rng.choice(["12", "13", "14a"], 200)})
    table["state"] = rng.choice(["good", "poor", "NA", ""], 200)
    table["size"] = np.where(np.arange(200) % 40, rng.normal(size=200).round(2).astype(str), "n/k")
    table["sold"] = (pd.Timestamp("2023-01-01") + pd.to_timedelta(rng.integers(0, 365, 200), "D")).strftime("%m/%d/%Y")
    table.assign(y=(3 * x + rng.normal(size=200)).round(3)).to_csv(folder / "old.csv", index=False)
    run_ok("table", "fit", folder / "old.csv", "--target", "y", "--model", folder / "model.cm")
    return folder / "model.cm"


@pytest.mark.parametrize("size", ["n/k", "", "0.5"])
def test_new_rows_are_read_as_those_learnt_from(learnt, tmp_path, size):
    file, out = tmp_path / "new.csv", tmp_path / "out.csv"
    file.write_text(f"x;code;state;size;sold;y\n1.5;12;NA;{size};03/04/2023;5\n2.5;13;NA;{size};05/06/2023;8\n")
    run_ok("table", "predict", learnt, file, "--out", out)
    sold = pd.to_datetime(["2023-03-04", "2023-05-06"])
    gaps = {"state": [None, None], "size": [float(size) if size == "0.5" else np.nan] * 2}
    typed = pd.DataFrame({"x": [1.5, 2.5], "code": ["12", "13"], **gaps, "sold": sold})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = ConformalRegressor.load(learnt).predict_table(typed)
    assert expected[["y_low", "y_high"]].abs().to_numpy().max() < 100  # no row has a label that is new
    columns = ["y", "y_low", "y_high"]
    np.testing.assert_allclose(pd.read_csv(out)[columns], expected[columns], rtol=1e-12)
    assert json.loads(run_ok("monitor", learnt, file, "--json").stdout)["n_new"] == 2


def test_text_in_a_column_of_numbers_stays_refused(learnt, tmp_path):
    file = tmp_path / "new.csv"
    for size in ("many", "2023-03-04"):
        file.write_text(f"x,code,state,size,sold\n1.5,12,good,{size},03/04/2023\n")
        assert f"size held numbers or dates in training, got ['{size}']" in refusal(
            "table", "predict", learnt, file, "--out", tmp_path / "out.csv"
        )


def test_models_of_files_without_kinds_are_still_read():
    csv = {"decimal": ",", "day_first": ["sold"], "labels": ["state"], "dates": {"due": "%d%m%y"}}
    old = SimpleNamespace(file_format_={"identifiers": ["id"], "csv": csv}, columns_=["sold", "state"])
    form = table_predict.as_learnt(old, CsvFormat(dates={"paid": "%Y"}))
    assert form.kinds == {"sold": "day first", "state": "text with NA"}
    assert form.dates == {"due": "%d%m%y", "paid": "%Y"}
    assert (form.decimal, form.missing, form.verbatim) == (",", {}, ["id"])


def test_undated_rows_are_the_first_in_time(capsys):
    days = pd.Series(pd.date_range("2024-01-01", periods=20)).where(np.arange(20) % 4 > 0)
    X = pd.DataFrame({"sold": days[::-1].to_numpy()})
    test, train = _split_rows(X, None, RowSplit.TIME, np.random.default_rng(0))
    assert sorted([*test, *train]) == [*range(20)]
    assert X["sold"].iloc[test].min() > X["sold"].iloc[train].max()
    assert X["sold"].iloc[train[:5]].isna().all()
    assert "note: 5 rows without sold taken as the first in time" in capsys.readouterr().out


def zero_heavy(n=1000):
    y = np.zeros(n)
    y[[5, 9, 700, 701]] = 100, 200, 100, 400
    return pd.DataFrame({"kind": np.resize(["a", "b"], n), "y": y})


def labelled(label, rows, n=1000):
    rng = np.random.default_rng(0)
    table = pd.DataFrame({"kind": np.resize(["a", "b"], n).astype(object), "y": rng.normal(size=n)})
    table.loc[rows, "kind"] = label
    return table


@pytest.mark.parametrize(
    ("table", "noted"),
    [
        pytest.param(labelled("Somme", [3, 8, 999]), "3 rows with 'Somme' (lines 3, 8, 999) used", id="department"),
        pytest.param(labelled("Average", [7]), "1 row with 'Average' (lines 7) used", id="one label inside"),
        pytest.param(labelled("Total Energies", [*range(990, 1000)]), "992, 993, 994, ...) used", id="sorted labels"),
        pytest.param(zero_heavy(), "", id="zeros"),
        pytest.param(zero_heavy().assign(z=-1.797693e308), "", id="sums that overflow"),
    ],
)
def test_real_rows_are_not_taken_as_totals(table, noted):
    X, _, lines = choose_columns(table, ["y"], None, "f")
    assert len(X) == len(table)
    assert noted in " ".join(lines)
    assert "totals of the others" not in " ".join(lines)


def test_labels_of_totals_end_the_rows():
    table = labelled("Total", [998])
    table.loc[999, "kind"] = "Mean"
    X, _, lines = choose_columns(table, ["y"], None, "f")
    assert len(X) == 998
    assert "2 rows with totals of the others (lines 998, 999)" in " ".join(lines)


@pytest.mark.parametrize("targets", [["temp", "temp_low"], ["row"]])
def test_targets_whose_regions_share_columns_are_refused(tmp_path, targets):
    options = [option for name in targets for option in ("--target", name)]
    told = refusal("table", "fit", tmp_path / "t.csv", *options, "--model", tmp_path / "m.cm")
    assert f"lead to several columns ['{targets[-1]}']" in told


def plain_file(path, **more):
    rng = np.random.default_rng(0)
    x = rng.normal(size=60).round(3)
    table = pd.DataFrame({"x": x, "y": (x + 0.1 * rng.normal(size=60)).round(3), **more})
    (table.to_parquet if path.suffix == ".parquet" else table.to_csv)(path, index=False)


def test_copied_columns_never_hide_those_of_regions(tmp_path):
    pytest.importorskip("skops")
    file = tmp_path / "t.csv"
    plain_file(file, row=np.arange(60) + 1, y_low=np.arange(60) + 100, row_in_file=np.arange(60) + 200)
    run_ok("table", "fit", file, "--target", "y", "--model", tmp_path / "m.cm")
    told = run_ok("table", "predict", tmp_path / "m.cm", file, "--out", tmp_path / "r.csv").output
    assert "renamed: row to row_in_file_in_file and y_low to y_low_in_file" in told
    result = pd.read_csv(tmp_path / "r.csv")
    assert list(result)[:4] == ["row", "row_in_file_in_file", "y_low_in_file", "row_in_file"]
    assert result.iloc[0, :4].tolist() == [0, 1, 100, 200]
    assert result["y_low"].max() < 5


def test_copied_lists_are_written_as_json(tmp_path):
    pytest.importorskip("skops")
    pytest.importorskip("pyarrow")
    file = tmp_path / "t.parquet"
    plain_file(file, tags=[[k, k + 1] for k in range(59)] + [None])
    run_ok("table", "fit", file, "--target", "y", "--exclude", "tags", "--model", tmp_path / "m.cm")
    run_ok("table", "predict", tmp_path / "m.cm", file, "--out", tmp_path / "r.csv")
    tags = pd.read_csv(tmp_path / "r.csv")["tags"]
    assert tags.iloc[3] == "[3, 4]"
    assert pd.isna(tags.iloc[59])


def test_predict_never_replaces_the_file_that_it_reads(tmp_path):
    file = written(tmp_path, "x,y\n1,2\n")
    assert "is the file to predict" in refusal("table", "predict", tmp_path / "m.cm", file, "--out", file)
    assert file.read_text() == "x,y\n1,2\n"


@pytest.mark.parametrize("text", ["x,y\n5,\n6,\n7,\n8,9\n", "x;y\n5,5;\n6,5;\n7,5;\n8,5;9\n"])
def test_a_sparse_last_column_keeps_its_separator(tmp_path, text):
    values, _ = read_table(written(tmp_path, text))
    np.testing.assert_array_equal(values["y"], [np.nan, np.nan, np.nan, 9])
    assert values["x"].notna().all()


@pytest.mark.parametrize("kind", [float, "str"])
def test_a_target_without_values_is_refused(kind):
    table = frame().assign(dose=pd.Series([None] * 100, dtype=kind))
    with pytest.raises(TableError, match=r"f: target 'dose' holds no values$"):
        choose_columns(table, ["dose"], None, "f")


def test_columns_of_parquet_may_be_named_by_numbers(tmp_path):
    pytest.importorskip("pyarrow")
    pd.DataFrame(np.random.default_rng(0).normal(size=(60, 2))).to_parquet(tmp_path / "t.parquet")
    assert "target: 1" in run_ok("table", tmp_path / "t.parquet", "--target", "1").output


def test_named_levels_of_a_parquet_index_are_columns(tmp_path):
    pytest.importorskip("pyarrow")
    table = pd.DataFrame({"city": "a", "day": pd.date_range("2024-01-01", periods=3), "x": [1.0, 2.0, 3.0]})
    for index in (["day"], ["city", "day"]):
        table.set_index(index).to_parquet(tmp_path / "t.parquet")
        values, _ = read_table(tmp_path / "t.parquet")
        assert sorted(values) == ["city", "day", "x"]
        assert values["day"].tolist() == table["day"].tolist()
    table.set_index(pd.Index([5, 6, 7])).to_parquet(tmp_path / "t.parquet")
    assert list(read_table(tmp_path / "t.parquet")[0]) == ["city", "day", "x"]
