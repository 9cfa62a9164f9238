"""The workflow of scikit-learn: chains, searches, transformed targets, routing, scorers, and demanding classifiers."""

import numpy as np
import pandas as pd
import pytest
from sklearn import config_context
from sklearn.compose import make_column_transformer
from sklearn.metrics import r2_score
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_predict, cross_val_score, cross_validate
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import OneHotEncoder, StandardScaler
from sklearn.tree import DecisionTreeClassifier

from conformodal.conformal import ConformalRegressor, Regions

RNG = np.random.default_rng(0)
X = RNG.uniform(-1, 1, (300, 2))
Y = np.exp(RNG.choice([-1, 1], 300) * (1 + X[:, 0]) + RNG.normal(0, 0.1, 300))
FRAME = pd.DataFrame(X, columns=["a", "b"]).assign(site=np.where(X[:, 1] > 0, "north", "south"))
PLACES = ["hand", "foot"]


def tree(**options):
    inner = DecisionTreeClassifier(max_depth=4, random_state=0)
    return ConformalRegressor(inner, **({"n_bins": 8, "random_state": 0} | options))


def chain(**options):
    return make_pipeline(StandardScaler(), tree(**options))


def neg_length(model, X, y):
    return -model.predict(X, region=True).length.mean()


def encoder():
    return make_column_transformer((OneHotEncoder(sparse_output=False), ["site"]), remainder="passthrough")


WORKFLOWS = {
    "pipeline": lambda: chain().fit(X, Y),
    "set_output": lambda: make_pipeline(encoder(), tree()).set_output(transform="pandas").fit(FRAME, Y),
    "search over a parameter": lambda: GridSearchCV(tree(), {"n_bins": [4, 8]}, cv=2).fit(X, Y).best_estimator_,
    "search over the inner estimator": lambda: (
        GridSearchCV(chain(), {"conformalregressor__estimator__max_depth": [1, 4]}, cv=2).fit(X, Y).best_estimator_
    ),
}


@pytest.mark.parametrize("name", WORKFLOWS)
def test_it_works_inside(name):
    model = WORKFLOWS[name]()
    table = FRAME if name == "set_output" else X
    regions = model.predict(table, region=True, alpha=[0.1, 0.3])
    assert [isinstance(one, Regions) for one in regions] == [True, True]
    assert regions[0].contains(Y).mean() > 0.8
    assert model.predict(table).shape == (300,)
    assert np.isfinite(model.score(table, Y))


def test_out_of_fold_predictions_and_scores():
    assert cross_val_predict(chain(), X, Y, cv=3).shape == (300,)
    assert (cross_val_score(chain(), X, Y, cv=3, scoring=neg_length) < 0).all()


def test_the_score_is_that_of_the_means():
    reg = tree().fit(X, Y)
    assert reg.score(X, Y) == r2_score(Y, reg.predict(X))


def test_given_rows_calibrate_through_the_transformers():
    model = chain(calibration_size=0).fit(X[:150], Y[:150])
    model[-1].conformalize(model[:-1].transform(X[150:]), Y[150:])
    assert model[-1].calibrator_.scores_.shape == (150, 1)
    assert model.predict(X, region=True).contains(Y).mean() > 0.8


@pytest.mark.parametrize("groups", [None, np.repeat(PLACES, 150)])
def test_weights_and_groups_are_routed(groups):
    weight = np.where(X[:, 0] > 0.5, 0.0, 1.0)
    with config_context(enable_metadata_routing=True):
        reg = tree().set_fit_request(sample_weight=True, groups=groups is not None)
        reg.set_score_request(sample_weight=True)
        given = {"sample_weight": weight} | ({} if groups is None else {"groups": groups})
        model = make_pipeline(StandardScaler().set_fit_request(sample_weight=False), reg).fit(X, Y, **given)
        options = {} if groups is None else {"groups": groups}
        assert len(model.predict(X, region=True, **options)) == 300
        assert model.score(X, Y, sample_weight=weight) != model.score(X, Y)
        assert model[-1].calibrator_.scores_.shape[0] < 60  # a fifth of the rows that weigh
        folds = cross_validate(
            tree().set_fit_request(groups=False), X, Y, cv=GroupKFold(2), params={"groups": np.arange(300) % 7}
        )
        assert np.isfinite(folds["test_score"]).all()


class Demanding(DecisionTreeClassifier):
    """Takes labels 0..K-1 only, as XGBoost does."""

    def fit(self, X, y):
        assert np.array_equal(np.unique(y), np.arange(y.max() + 1))
        return super().fit(X, y)


def test_a_classifier_that_demands_labels_without_gaps_gets_them():
    y = np.repeat([0.0, 5.0, 9.0, 20.0, 21.0], 60) + RNG.normal(0, 0.01, 300)
    own = np.column_stack((y + RNG.normal(0, 0.01, 300), X))
    y[:3] = [30, 40, 50]  # bins that some folds do not see
    plain = ConformalRegressor(DecisionTreeClassifier(max_depth=3, random_state=0), n_bins=150, random_state=0)
    reg = ConformalRegressor(Demanding(max_depth=3, random_state=0), n_bins=150, random_state=0).fit(own, y)
    np.testing.assert_array_equal(reg.predict_bins(own)[0], plain.fit(own, y).predict_bins(own)[0])
