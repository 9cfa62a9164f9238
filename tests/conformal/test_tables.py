"""Tables of strangers: names, text, gaps, dates and groups, in pandas, polars and Arrow."""

import re
import warnings
from copy import copy
from datetime import date
from decimal import Decimal

import numpy as np
import pandas as pd
import pytest
from joblib import parallel_config
from scipy import sparse
from sklearn.compose import make_column_transformer
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import OneHotEncoder
from sklearn.tree import DecisionTreeClassifier
from sklearn.utils import get_tags

from conformodal.conformal import ConformalRegressor, ConformodalError, DataWarning, MondrianConformal
from conformodal.conformal.density.encoder import TableEncoder, as_column

pytestmark = pytest.mark.usefixtures("short_fits")
N = 240


def frame(n=N, seed=0):
    rng = np.random.default_rng(seed)
    found = pd.DataFrame(
        {
            "age": rng.uniform(20, 80, n),
            "sex": rng.choice(["f", "m"], n),
            "hospital": rng.choice(["A", "B", "C"], n, p=[0.6, 0.35, 0.05]),
            "visit": pd.to_datetime("2024-01-01") + pd.to_timedelta(rng.integers(0, 300, n), "D"),
        }
    )
    dose = found.age / 10 + np.where(found.sex == "f", 5, -5) + rng.normal(0, np.where(found.hospital == "A", 0.2, 2))
    found.loc[rng.random(n) < 0.1, "age"] = np.nan
    found.loc[rng.random(n) < 0.1, "sex"] = None
    return found, pd.Series(dose, name="dose")


def ages(X):
    return np.asarray(X["age"])[:, None]


def tree(**options):
    return ConformalRegressor(DecisionTreeClassifier(max_depth=4, random_state=0), n_bins=8, random_state=0, **options)


def of_polars(X):
    pl = pytest.importorskip("polars")
    return pl.DataFrame({name: X[name].astype(object).where(X[name].notna(), None).tolist() for name in X})


def test_the_encoder_fills_marks_counts_and_names():
    X = pd.DataFrame({"a": [1.0, np.nan, 5.0], "b": ["x", "y", "x"], "c": [date(2024, 1, 1), None, date(2024, 1, 3)]})
    day = 19723.0
    # of dates the time, whether it is missing, the day of the year and the weekday
    expected = [[1, 0, 1, day, 0, 1, 0], [3, 1, 0, day + 1, 1, 2, 1], [5, 0, 1, day + 2, 0, 3, 2]]
    encoder = TableEncoder().fit(X)
    np.testing.assert_array_equal(encoder.transform(X), expected)
    later = pd.DataFrame({"a": [np.nan], "b": ["never seen"], "c": [date(2024, 1, 2)]})
    np.testing.assert_array_equal(encoder.transform(later), [[3, 1, 0, day + 1, 0, 2, 1]])
    with pytest.raises(ConformodalError, match="column a held numbers or dates in training"):
        encoder.transform(later.assign(a=["1,5"]))
    with pytest.raises(ConformodalError, match="2 columns, expected 3"):
        encoder.transform(later[["a", "b"]])


def test_polars_gives_the_same_columns():
    X, _ = frame(60)
    other = of_polars(X)
    np.testing.assert_allclose(TableEncoder().fit(other).transform(other), TableEncoder().fit(X).transform(X))


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (pd.Series([1, None, 3], dtype="Int64"), [1, np.nan, 3]),
        (pd.Series([True, None], dtype="boolean"), [1, np.nan]),
        (pd.Series([Decimal("0.5"), None]), [0.5, np.nan]),
        (pd.Series([1, 2], dtype="category"), ["1", "2"]),
        (pd.Series(["a", None], dtype="string"), ["a", ""]),
        (pd.Series(pd.to_datetime(["1970-01-02", None])), [1, np.nan]),
        (pd.Series(pd.to_datetime(["1970-01-02"]).tz_localize("CET")), [23 / 24]),
        (pd.Series(["a", 1]), ["a", "1"]),
    ],
)
def test_columns_are_numbers_or_text(column, expected):
    np.testing.assert_array_equal(as_column(column, "c"), expected)


@pytest.mark.parametrize(
    "column",
    [["a", None, 1, 2.0], ["x", None, "y", "y"], pd.Categorical([1, None, 2, 2]), pd.Categorical(["u", "v"] * 2)],
)
def test_a_row_is_the_same_by_itself(column):
    X = pd.DataFrame({"k": pd.Series(column)}).loc[np.repeat(np.arange(4), 2)]
    encoder = TableEncoder().fit(X)
    assert {tuple(row) for row in encoder.transform(X)} == {tuple(row) for row in np.eye(len(X.k.unique()))}
    rows = [encoder.transform(X.iloc[[i]])[0] for i in range(8)]
    np.testing.assert_array_equal(rows, encoder.transform(X))
    for empty in ([None], [np.nan], pd.to_datetime([None])):
        missing = encoder.transform(pd.DataFrame({"k": empty}))
        np.testing.assert_array_equal(missing.any(), X.k.isna().any())
    whole = X[X.k.notna()].assign(k=lambda own: own.k.astype(X.k.dtype.name))  # categories of 1, not 1.0
    np.testing.assert_array_equal(encoder.transform(whole), encoder.transform(X)[X.k.notna()])


def test_a_table_of_arrow_is_taken_as_one_of_pandas():
    pa = pytest.importorskip("pyarrow")
    X, y = frame()
    numbers = X[["age"]].fillna(50)
    expected = tree().fit(numbers, y).predict(numbers)
    for same in (pa.Table.from_pandas(numbers), numbers.convert_dtypes(dtype_backend="pyarrow")):
        reg = tree().fit(same, y)
        np.testing.assert_array_equal(reg.predict(same), expected)
        np.testing.assert_array_equal(reg.predict_table(same)[reg.bins_.names[0]], expected)


def test_threads_answer_as_one_does(monkeypatch):
    pa = pytest.importorskip("pyarrow")
    X, y = frame()
    numbers = X[["age"]].fillna(50)
    reg = ConformalRegressor(random_state=0).fit(numbers, y)
    monkeypatch.setattr("conformodal.conformal.tables._ROWS", 16)
    expected = reg.predict_table(pa.Table.from_pandas(numbers))
    with parallel_config("threading", n_jobs=3):
        assert reg.predict_table(pa.Table.from_pandas(numbers)).equals(expected)


def test_reordered_columns_are_refused_for_any_names():
    X, y = frame()
    numbers = X[["age", "sex"]].assign(age=X.age.fillna(50), sex=X.sex == "f")
    for names in ([0, 1], pd.MultiIndex.from_tuples([("n", "age"), ("n", "sex")])):
        table = numbers.set_axis(names, axis=1)
        reg = tree().fit(table, y)
        np.testing.assert_array_equal(reg.predict(table), tree().fit(numbers, y).predict(numbers))
        with pytest.raises(ConformodalError, match="another order than in training"):
            reg.predict(table.iloc[:, ::-1])
    reg.fit(numbers.to_numpy() * 1.0, y)
    assert len(reg.predict(numbers)) == N


def test_targets_in_another_order_are_refused():
    X, y = frame()
    both, numbers = pd.DataFrame({"dose": y, "days": 10 * y}), X[["age"]].fillna(50)
    reg = tree().fit(numbers, both)
    assert reg.predict_region(numbers).contains(both).mean() > 0.8
    turned = both[["days", "dose"]]
    calls = reg.conformalize, reg.diagnose, lambda X, y: reg.predict_region(X).contains(y)
    for call in calls:
        with pytest.raises(ConformodalError, match="y has its columns in another order"):
            call(numbers, turned)


def test_values_beyond_those_learnt_from_are_not_called_few():
    X, y = frame()
    reg = tree(calibration_size=0).fit(X[["age"]].fillna(50), y)
    with pytest.warns(UserWarning, match="unbounded: 50 of 240 calibration samples have values beyond those learnt"):
        reg.conformalize(X[["age"]].fillna(50), y.where(np.arange(N) >= 50, 1e3))


def test_text_and_missing_values_need_no_preparation():
    X, y = frame(120)
    reg = ConformalRegressor(random_state=0).fit(X[:90], y[:90])
    regions = reg.predict_region(X[90:])
    assert regions.contains(y[90:]).mean() > 0.7
    assert reg.feature_names_in_.tolist() == ["age", "sex", "hospital", "visit"]
    assert regions.bins.names == ["dose"]
    assert "coverage of dose" in str(reg.diagnose(X[90:], y[90:]))


def test_a_classifier_gets_the_rows_of_the_frame_as_they_are():
    X, y = frame()
    by_name = make_column_transformer((OneHotEncoder(handle_unknown="ignore"), ["sex"]), ("passthrough", ["age"]))
    chain = make_pipeline(by_name, DecisionTreeClassifier(max_depth=4, random_state=0))
    both = pd.DataFrame({"dose": y, "days": 2 * y})
    reg = ConformalRegressor(chain, n_bins=8, random_state=0).fit(X[:200], both[:200])
    assert reg.predict_region(X[200:]).bins.names == ["dose", "days"]
    assert reg.predict_region(X[200:]).contains(both[200:].to_numpy()).mean() > 0.75
    with pytest.raises(ConformodalError, match="feature names"):
        reg.predict_region(of_polars(X[["sex", "age", "visit", "hospital"]]))


def test_nan_needs_an_estimator_that_allows_it():
    X, y = frame()
    numbers = X[["age"]].to_numpy()
    boosted = ConformalRegressor(HistGradientBoostingClassifier(max_iter=3), n_bins=4, random_state=0)
    assert get_tags(boosted).input_tags.allow_nan
    assert len(boosted.fit(numbers, y).predict_region(numbers)) == N
    with pytest.raises(ConformodalError, match="cannot be fitted: Input X contains NaN"):
        ConformalRegressor(LogisticRegression()).fit(numbers, y)
    with pytest.raises(ConformodalError, match="infinity"):
        tree().fit(numbers * np.inf, y)


def test_sparse_columns_stay_sparse():
    X, y = frame()
    wide = OneHotEncoder().fit_transform(X[["sex", "hospital"]].astype(str))
    reg = tree().fit(wide, y)
    assert sparse.issparse(wide)
    np.testing.assert_array_equal(reg.predict(wide), tree().fit(wide.toarray(), y).predict(wide.toarray()))
    with pytest.raises(ConformodalError, match="dense array"):
        ConformalRegressor().fit(wide, y)


def test_groups_are_covered_each():
    X, y = frame(1200)
    X["sex"] = (X.sex == "f") * 1.0
    numbers = X[["age", "sex"]]
    few = {"C": int((X.hospital[:600] == "C").sum())}
    assert 20 < few["C"] < 45  # too few to calibrate, a fifth of them
    with pytest.warns(UserWarning, match="regions of 1 group with .*'C'"):
        reg = tree().fit(numbers[:600], y[:600], groups=X.hospital[:600])
    assert isinstance(reg.calibrator_, MondrianConformal)
    assert set(reg.calibrator_.sizes_) == {"A", "B", "C"}
    regions = reg.predict_region(numbers[600:], groups=X.hospital[600:])
    new = X.hospital[600:].to_numpy()
    assert regions.unbounded[new == "C"].all()
    assert not regions.unbounded[new != "C"].any()
    told = reg.diagnose(numbers[600:], y[600:], groups=new)
    assert told.columns[0].coverage.inside
    assert all(check.inside for check in told.columns[0].parts.values())
    assert "of each group" in str(told)
    np.testing.assert_array_equal(reg.predict(numbers[600:], region=True, groups=new).masks[0], regions.masks[0])

    tight = reg.predict_region(numbers[600:], alpha=0.3, groups=new)
    assert (tight.masks[0] <= regions.masks[0]).all()


@pytest.mark.filterwarnings("ignore:regions are unbounded")
def test_few_rows_are_rarely_unbounded_and_warn_if_so():
    unbounded = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        X = rng.normal(size=(50, 1))
        y = X[:, 0] + rng.standard_normal(50)
        unbounded += tree().fit(X, y).predict_region(X[:1]).unbounded.any()
    assert unbounded <= 2  # 12 of 40 where the outer bins end with the range
    with pytest.warns(UserWarning, match="regions are unbounded: 4 calibration samples are too few for alpha"):
        tree().fit(X[:20], y[:20])
    with pytest.warns(UserWarning, match="regions are unbounded: 1 calibration sample is too few"):
        tree().fit(X[:5], y[:5])


@pytest.fixture(scope="module")
def mixed(short_fits):
    """A fitted regressor, 100 more rows and their values."""
    rng = np.random.default_rng(0)
    time = pd.date_range("2024-01-01", periods=400, freq="h", tz="Europe/Berlin")[rng.permutation(400)]
    X = pd.DataFrame({"x": rng.normal(size=400), "kind": rng.choice(["a", "b"], 400), "time": time})
    y = 3 * X.x + 20 * (X.kind == "a") + rng.normal(0, 0.5, 400)
    return ConformalRegressor(random_state=0).fit(X[:300], y[:300]), X[300:], y[300:]


def test_only_distant_dates_are_reported(mixed):
    reg, X, _ = mixed
    later, far = (reg.memory_.compare(X.assign(time=X.time + pd.Timedelta(days=days)))[1] for days in (30, -3000))
    assert later == ""
    assert re.search(r"time is beyond 20\d\d-\d\d-\d\d to 2024-01-1\d, its range, in 100", far)


@pytest.mark.parametrize(
    ("new", "named"),
    [
        (lambda X: X.assign(x=np.nan), "x is missing in 100, in training in 0 of 300"),
        (lambda X: X.assign(kind=None), "kind is missing in 100"),
        (lambda X: X.assign(kind=X.kind.str.upper()), "'B'.*, which may be 'b'|'A'.*, which may be 'a'"),
        (lambda X: X.assign(kind="z"), "kind has a label that is new in 100, such as 'z'"),
        (lambda X: X.assign(x=1000 * X.x), "x is beyond"),
        (lambda X: X.assign(time=X.time.dt.tz_localize(None)), "time had a time zone in training"),
    ],
)
def test_rows_unlike_training_warn_and_stay_covered(mixed, new, named):
    reg, X, y = mixed
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        usual = reg.predict_region(X)
    with pytest.warns(DataWarning, match=named):
        held = reg.predict_region(new(X)).contains(y).mean()
    assert held > 0.85 or named in ("x is beyond", "time had a time zone in training")  # these get the usual sets
    with pytest.warns(DataWarning, match=named):
        ignoring = copy(reg).set_params(unlike="ignore").predict_region(new(X))
    assert not ignoring.unbounded.any()
    assert not usual.unbounded.any()


def test_rows_without_a_group_are_counted_and_answered():
    rng = np.random.default_rng(0)
    X, site = pd.DataFrame({"x": rng.normal(size=400)}), pd.Series(rng.choice(["a", "b"], 400), name="site")
    y = X.x + np.where(site == "a", 0.1, 1.0) * rng.normal(size=400)
    reg = tree().fit(X, y, groups=site)
    gaps = site.where(np.arange(400) % 40 > 0)
    with pytest.warns(DataWarning, match="10 of 400 rows without a group"):
        regions = reg.predict_region(X, groups=gaps)
    usual, noisy = (reg.predict_region(X, groups=of) for of in (site, np.full(400, "b")))
    for k in range(400):
        np.testing.assert_array_equal(regions.intervals(k)[0], (usual if k % 40 else noisy).intervals(k)[0])
    pytest.importorskip("pyarrow")
    with pytest.warns(DataWarning, match="10 of 400 rows without a group"):
        table = reg.predict_table(X.assign(site=gaps))
    np.testing.assert_array_equal(table.filter(like="_low").to_numpy()[:, 0], regions.hull[:, 0, 0])


@pytest.fixture(scope="module")
def dated(short_fits):
    """A table with dates, values, and the ends of their regions."""
    rng, days = np.random.default_rng(0), pd.date_range("2024-01-01", periods=366)
    when = days[rng.integers(366, size=300)]
    X, y = pd.DataFrame({"when": when}), when.day_of_year + rng.normal(size=300)
    X.loc[7, "when"] = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return X, y, ConformalRegressor(random_state=0).fit(X, y).predict_region(X).hull


@pytest.mark.parametrize("form", ["%Y-%m-%d", "%Y-%m-%dT%H:%M:%S", "%Y%m%dT%H%M%S", "%Y-%m-%d %H:%M+00:00"])
def test_text_of_iso_dates_is_dates_and_it_is_said(dated, form):
    polars = pytest.importorskip("polars")
    dates, y, expected = dated
    text = pd.DataFrame({"when": dates.when.dt.strftime(form)})
    for X in (text, polars.from_pandas(text)):
        with pytest.warns(DataWarning, match=f"when is read as dates, from text such as '{re.escape(text.when[0])}'"):
            reg = ConformalRegressor(random_state=0).fit(X, y)
        np.testing.assert_array_equal(reg.predict_region(X).hull, expected)
        assert X["when"][0] == text.when[0]  # not changed
    with pytest.raises(ConformodalError, match="column when held dates"):
        reg.predict(pd.DataFrame({"when": ["soon", "later"]}))
    text.loc[9, "when"] = "n/a"
    for answer in (reg.predict, reg.predict_table):
        with pytest.raises(ConformodalError, match=r"column when held dates .* got 'n/a' in row 9 \(from 0\)"):
            answer(text)


@pytest.mark.parametrize("labels", [["2024-01-01", "never"], ["20240101", "20240102"], ["2024-01", "2024-02"]])
def test_other_text_stays_text(labels):
    X = pd.DataFrame({"k": np.resize(labels, 60), "x": np.arange(60.0)})
    reg = ConformalRegressor(random_state=0, unlike="ignore").fit(X, np.random.default_rng(0).normal(size=60))
    assert reg.text_dates_ == {}
    assert reg.memory_.columns[0].labels == dict.fromkeys(labels, 30)


def test_a_time_in_another_time_zone_is_the_same_time():
    rng, hours = np.random.default_rng(0), pd.date_range("2024-03-01", periods=300, freq="h", tz="UTC")
    order = rng.permutation(300)
    y = np.sin(np.arange(300) / 40)[order]
    X = pd.DataFrame({"at": hours}).iloc[order]
    reg = tree(unlike="ignore").set_params(estimator=None).fit(X, y)
    expected = reg.predict(X)
    for zone in ("Pacific/Auckland", "Europe/Berlin"):
        np.testing.assert_array_equal(reg.predict(X.assign(at=X["at"].dt.tz_convert(zone))), expected)
        objects = pd.Series([t.to_pydatetime() for t in X["at"].dt.tz_convert(zone)], X.index, dtype=object)
        np.testing.assert_array_equal(reg.predict(X.assign(at=objects)), expected)


@pytest.mark.parametrize("as_table", [lambda x: x, lambda x: pd.DataFrame(x, columns=["a", "b"])])
@pytest.mark.parametrize("value", [1e39, -1.797693e308])
def test_numbers_beyond_float32_are_refused_by_name(as_table, value):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(60, 2))
    y, far = x[:, 0] + rng.normal(size=60), x.copy()
    far[3, 1] = value
    reg, name = ConformalRegressor(random_state=0), "b" if hasattr(as_table(x), "columns") else "1"
    with pytest.raises(ConformodalError, match=rf"^column {name} must hold numbers .* got {re.escape(f'{value:.7g}')}"):
        reg.fit(as_table(far), y)
    reg.fit(as_table(x), y)
    with pytest.raises(ConformodalError, match=f"^column {name} must hold numbers"):
        reg.predict(as_table(far))


def test_a_column_without_values_is_missing_of_any_type():
    encoder = TableEncoder().fit(pd.DataFrame({"a": [1.0, np.nan, 5.0]}))
    for dtype in (float, object, "str"):
        empty = pd.DataFrame({"a": pd.Series([None, None], dtype=dtype)})
        np.testing.assert_array_equal(encoder.transform(empty), [[3, 1], [3, 1]])


def test_predict_table_takes_columns_named_by_numbers():
    pytest.importorskip("pyarrow")
    rng = np.random.default_rng(0)
    table = pd.DataFrame(rng.normal(size=(200, 2))).assign(**{"2": rng.choice(["a", "b"], 200)})
    table.columns = [0, 1, 2]
    y = table[0] + rng.normal(size=200)
    for groups in (None, table[2]):
        reg = tree().fit(table[[0, 1]], y, groups=groups)
        result, regions = (
            reg.predict_table(table[:9]),
            reg.predict_region(table.loc[:8, [0, 1]], groups=groups[:9] if groups is not None else None),
        )
        np.testing.assert_array_equal(result["target 0_low"], regions.hull[:, 0, 0])


def test_targets_whose_columns_coincide_are_refused():
    pytest.importorskip("pyarrow")
    X, y = frame()
    numbers = X[["age"]].fillna(50)
    reg = tree().fit(numbers, pd.DataFrame({"dose": y, "dose_low": y - 1}))
    with pytest.raises(ConformodalError, match=r"lead to several columns \['dose_low'\]; rename a target"):
        reg.predict_table(numbers)
