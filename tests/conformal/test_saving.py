"""A saved regressor answers as before, and no other file is loaded."""

import io
import tracemalloc
import warnings
import zipfile
from datetime import date
from decimal import Decimal

import numpy as np
import pandas as pd
import pytest
from sklearn.compose import make_column_transformer
from sklearn.ensemble import RandomForestClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import OneHotEncoder

from conformodal.conformal import ConformalRegressor, ConformodalError, StackedDensity, saving
from conformodal.conformal.density import named
from conformodal.conformal.density.named import SubsetProcess

pytestmark = pytest.mark.usefixtures("short_fits")
skops = pytest.importorskip("skops.io")
SMOOTH_MEMBER = named.smooth_member  # which short_fits leaves out
RNG = np.random.default_rng(0)
X = pd.DataFrame({"a": RNG.uniform(size=200), "site": RNG.choice(["north", "south"], 200)})
Y = X.a.to_numpy() + RNG.normal(0, 0.1, 200)
FOREST = make_pipeline(
    make_column_transformer((OneHotEncoder(), ["site"]), remainder="passthrough"), RandomForestClassifier(5)
)
KINDS = {
    "default": {},
    "bounds": {"y_min": -1, "calibration_size": 0.4},
    "classifier": {"estimator": FOREST, "n_bins": 8, "conformity_score": "hpd"},
    "two targets": {"joint": "max", "alpha": "0.2"},
}


def fitted(**options):
    targets = np.column_stack((Y, -Y)) if "joint" in options else Y
    return ConformalRegressor(**({"random_state": 0} | options)).fit(X, targets)


@pytest.mark.parametrize("kind", KINDS)
def test_a_regressor_comes_back_as_it_was(kind, tmp_path):
    reg = fitted(**KINDS[kind])
    reg.save(tmp_path / "reg.cm")
    again = ConformalRegressor.load(tmp_path / "reg.cm")
    assert repr(again) == repr(reg)
    for one, other in zip(again.predict_region(X, alpha=[0.1, 0.3]), reg.predict_region(X, [0.1, 0.3]), strict=True):
        for j, mask in enumerate(other.masks):
            np.testing.assert_array_equal(one.masks[j], mask)
        np.testing.assert_array_equal(one.bins.limits, other.bins.limits)
    np.testing.assert_array_equal(again.predict(X), reg.predict(X))
    again.conformalize(X, np.column_stack((Y, -Y)) if "joint" in KINDS[kind] else Y)


def test_a_smooth_member_comes_back(tmp_path, monkeypatch):
    monkeypatch.setattr(named, "smooth_member", SMOOTH_MEMBER)
    x = np.sort(RNG.uniform(size=200))[:, None]
    reg = ConformalRegressor(random_state=0).fit(x, np.sin(6 * x[:, 0]) + RNG.normal(0, 0.02, 200))
    assert isinstance(reg.estimators_[0].location_._models[0], SubsetProcess)
    reg.save(tmp_path / "reg.cm")
    again = ConformalRegressor.load(tmp_path / "reg.cm")
    np.testing.assert_array_equal(again.predict_region(x).masks[0], reg.predict_region(x).masks[0])


@pytest.mark.parametrize(
    "labels", [(False, True), (date(2020, 1, 1), date(2021, 1, 1)), (0, 5), ("a", "b"), (0.0, 0.5)]
)
def test_groups_come_back_whatever_their_labels_are(labels, tmp_path):
    groups = [labels[i % 2] for i in range(200)]
    reg = ConformalRegressor(RandomForestClassifier(5), n_bins=8, alpha=Decimal("0.2"), random_state=0)
    reg.fit(X[["a"]], Y, groups=groups).save(tmp_path / "reg.cm")
    again = ConformalRegressor.load(tmp_path / "reg.cm")
    assert again.calibrator_.sizes_ == reg.calibrator_.sizes_
    assert set(again.calibrator_.sizes_.values()) == {20}
    for alpha in (None, 0.4):
        found, expected = (one.predict_region(X[["a"]], alpha, groups) for one in (again, reg))
        np.testing.assert_array_equal(found.masks[0], expected.masks[0])
        assert not found.unbounded.any()


@pytest.mark.slow
def test_the_stack_comes_back_as_it_was(tmp_path):
    reg = ConformalRegressor(StackedDensity(5), random_state=0).fit(X[:60], Y[:60])
    reg.save(tmp_path / "reg.cm")
    np.testing.assert_array_equal(ConformalRegressor.load(tmp_path / "reg.cm").predict(X), reg.predict(X))


class Foreign(RandomForestClassifier):
    pass


def test_types_of_others_are_named_and_need_trust(tmp_path):
    path = tmp_path / "reg.cm"
    inner = make_pipeline(FOREST[0], Foreign(5, random_state=0))
    reg = fitted(estimator=inner, n_bins=8)
    reg.save(path)
    name = f"{Foreign.__module__}.Foreign"
    with pytest.raises(ConformodalError, match=rf"reg\.cm: holds the types {name}; if you trust"):
        ConformalRegressor.load(path)
    reg.save(path)  # replaces it
    np.testing.assert_array_equal(ConformalRegressor.load(path, trusted=[name]).predict(X), reg.predict(X))


def archive(name="schema.json"):
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as files:
        files.writestr(name, "{}")
    return held.getvalue()


@pytest.mark.parametrize(
    ("content", "match"),
    [(None, "cannot be read"), (b"text", "is not a saved regressor"), (archive(), "is not a saved regressor"),
     (skops.dumps({"format": "x"}), "is not a complete conformodal-table-6"),
     (skops.dumps({"format": "conformodal-table-1", "scikit-learn": "0", "regressor": 3}), "fit and save it again"),
     (skops.dumps({"format": "conformodal-table-99", "scikit-learn": "0", "regressor": 3}), "update conformodal"),
     (archive("reg.skops"), "is an archive .zip.; unpack it"),
     (skops.dumps({"format": "conformodal-table-6", "scikit-learn": "0", "regressor": 3}), "is not a saved")],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:.*saved with scikit-learn")
def test_other_files_are_refused(content, match, tmp_path):
    if content is not None:
        (tmp_path / "reg.cm").write_bytes(content)
    with pytest.raises(ConformodalError, match=rf"reg\.cm: .*{match}"):
        ConformalRegressor.load(tmp_path / "reg.cm")


def stated(path, name, size):
    """Let an archive's directory state another size of an entry."""
    content = bytearray(path.read_bytes())
    at = content.rindex(name.encode())  # in the directory, 46 bytes after its entry begins
    content[at - 22 : at - 18] = size.to_bytes(4, "little")
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("name", "content", "size", "match"),
    [("big.npy", bytes(2**27), None, "unpacks to 129 MB"), ("big.npy", bytes(2**27), 1000, "Bad CRC-32"),
     ("../x.npy", b"1", None, "in a folder"), ("x.npy", b"", None, "is empty"),
     ("schema.json", b"{}", None, "one name"), ("x.npz", "nested", None, "unpacks to 128 MB")],
)  # fmt: skip
def test_foreign_archives_are_refused_before_unpacking(name, content, size, match, tmp_path):
    path, held = tmp_path / "reg.cm", io.BytesIO()
    if content == "nested":
        with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as inner:
            inner.writestr("data.npy", bytes(2**27))
        content = held.getvalue()
    fitted(estimator=FOREST, n_bins=4).save(path)
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as files:
        warnings.simplefilter("ignore")  # of the name that is there already
        files.writestr(name, content)
    if size:
        stated(path, name, size)
    tracemalloc.start()
    try:
        with pytest.raises(ConformodalError, match=rf"reg\.cm: is not a saved regressor: .*{match}"):
            ConformalRegressor.load(path)
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()


def test_highly_compressible_regressor_is_loaded(tmp_path):
    """It shrinks by more than an archive may grow when it is loaded."""
    reg = fitted(estimator=FOREST, n_bins=4)
    reg.zeros_ = np.zeros(10**7)
    reg.save(tmp_path / "reg.cm")
    np.testing.assert_array_equal(ConformalRegressor.load(tmp_path / "reg.cm").zeros_, reg.zeros_)


@pytest.mark.parametrize("content", [b"text", archive(), skops.dumps({"format": "x"}), None])
def test_other_files_and_folders_are_not_replaced(content, tmp_path):
    path = tmp_path / "reg.cm" if content else tmp_path
    if content:
        path.write_bytes(content)
    with pytest.raises(ConformodalError, match="exists and is not a saved regressor"):
        saving.save_regressor(None, path)
    assert path.is_dir() or path.read_bytes() == content


def test_another_version_of_scikit_learn_is_a_warning(tmp_path, monkeypatch):
    reg = fitted(estimator=FOREST, n_bins=4)
    with monkeypatch.context() as patch:
        patch.setattr(saving.sklearn, "__version__", "1.0")
        reg.save(tmp_path / "reg.cm")
    with pytest.warns(UserWarning, match=r"saved with scikit-learn 1\.0"):
        ConformalRegressor.load(tmp_path / "reg.cm")
    with pytest.raises(ConformodalError, match="estimator cannot be saved"):
        reg.set_params(random_state=io).save(tmp_path / "x")
