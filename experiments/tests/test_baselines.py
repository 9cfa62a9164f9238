import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from conformodal.features.backbone import feature_views
from conformodal.features.head import fit_projection
from conformodal.features.settings import TrainingConfig
from conformodal.io import Split, SplitKind
from conformodal.localizer.training_data import TrainingData
from experiments.baselines import (
    BASELINES,
    N_COMPONENTS,
    RegressionTask,
    deep_ensemble,
    local_regression,
    mixture_density,
    mixture_loss,
    register_baseline,
)
from experiments.regressors import RATES, SettingsSearch, train_tuned
from experiments.tables import METHODS
from experiments.tasks import ExperimentError

CONFIG = TrainingConfig(epochs=25, hidden=32, dropout=0.05, batch_size=64, seed=1)


def make_data(two_answers=False, told_by="network", n=900):
    """Targets that are smooth functions of some features; or +-1 at random, which no feature tells apart."""
    rng = np.random.default_rng(0)
    other = np.random.default_rng(1)
    seen = {"network": rng.normal(size=(n, 6)), "thumbnail": other.normal(size=(n, 6))}
    pictures = seen["thumbnail"] @ other.normal(size=(6, 768))
    features = np.column_stack((seen["network"], pictures)).astype(np.float32)
    targets = np.tanh(seen[told_by] @ rng.normal(size=(6, 7))) + 0.05 * rng.normal(size=(n, 7))
    if two_answers:
        targets[:, :] = np.where(rng.random(n) < 0.6, 1.0, -1.0)[:, None] + 0.05 * rng.normal(size=(n, 7))
    order = rng.permutation(n)
    split = Split(SplitKind.INTERLEAVED, 0, *(np.sort(p) for p in np.split(order, [n // 2, 3 * n // 4])))
    sequence = SimpleNamespace(recording=np.zeros(n, dtype=np.int64), given_test=None)
    return TrainingData(sequence, split, features, targets, np.array([1.0, 0, 0, 0]))


@pytest.fixture(scope="module")
def trained():
    data = make_data()
    tuned = train_tuned(data, CONFIG)
    return data, tuned, RegressionTask(data, tuned)


def test_projections_are_of_the_rows_asked_for_and_fitted_once():
    data = make_data(n=200)
    view = feature_views(data.features.shape[1]).network
    for rows in (data.split.train, data.split.calibration):
        found = data.projection(rows, 4)
        true = fit_projection(data.features[rows], 4, view)
        np.testing.assert_array_equal(found.components, true.components)
        np.testing.assert_array_equal(found.offset, true.offset)
        assert data.projection(rows.copy(), 4) is found
        assert data.projection(rows, 3) is not found
    other = replace(data, features=2 * data.features)
    assert not np.array_equal(other.projection(rows, 4).offset, data.projection(rows, 4).offset)


def rmse(values, data):
    return np.sqrt(np.mean((values - data.targets[data.split.test]) ** 2))


def test_all_learn_what_can_be_learnt(trained):
    data, tuned, task = trained
    x = data.features[data.split.test]
    methods = {
        "tuned": tuned,
        "mixture": mixture_density(task),
        "ensemble": deep_ensemble(task),
        "local": local_regression(task),
    }
    errors = {name: rmse(method.predict(x), data) for name, method in methods.items()}
    assert max(errors.values()) < 0.5 * data.targets.std(), errors
    assert errors["ensemble"] < 1.15 * errors["tuned"]


def test_every_baseline_has_a_line_in_the_table():
    assert {name: METHODS[name] for name in BASELINES} == {name: kind.label for name, kind in BASELINES.items()}


def test_two_baselines_of_one_name_are_refused():
    with pytest.raises(ExperimentError, match="'deep_ensemble' already: deep ensemble of 5"):
        register_baseline("deep_ensemble", "another")(lambda task: None)


def test_an_ensemble_is_the_mean_of_five_and_knows_its_size(trained):
    data, tuned, task = trained
    x = data.features[:5]
    ensemble = deep_ensemble(task)
    one = tuned.head.n_trained
    assert ensemble.n_parameters == 5 * one
    assert not np.allclose(ensemble.predict(x), tuned.predict(x))


def test_mixture_answers_with_a_mode_not_the_mean():
    data = make_data(two_answers=True)
    tuned = SimpleNamespace(training=CONFIG, mean=data.targets.mean(axis=0), scale=data.targets.std(axis=0))
    answers = mixture_density(RegressionTask(data, tuned)).predict(data.features[data.split.test])
    assert np.median(np.abs(np.abs(answers) - 1)) < 0.1


def test_mixture_loss_is_the_likelihood():
    torch.manual_seed(0)
    d, n = 3, 4
    raw, y = torch.randn(n, N_COMPONENTS * (1 + 2 * d), requires_grad=True), torch.randn(n, d)
    logits, means, log_sigma = torch.split(raw, [N_COMPONENTS, N_COMPONENTS * d, N_COMPONENTS * d], dim=1)
    means, log_sigma = means.reshape(n, -1, d), log_sigma.reshape(n, -1, d)
    mixture = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(logits=logits),
        torch.distributions.Independent(torch.distributions.Normal(means, log_sigma.exp()), 1),
    )
    (-mixture.log_prob(y).mean()).backward()
    np.testing.assert_allclose(mixture_loss(raw.detach().numpy(), y.numpy(), [raw.shape[1]]), raw.grad, atol=1e-5)


def far_from(best_rate):
    """Error in steps of rates; less without dropout."""
    return lambda s: abs(RATES.index(s.learning_rate) - RATES.index(best_rate)) + s.dropout


def at(rate, dropout=0.3):
    return TrainingConfig(learning_rate=rate, dropout=dropout)


@pytest.mark.parametrize("best", RATES)
@pytest.mark.parametrize("starts", [(1e-3, 3e-3), (1e-2,), (1e-5,), (1e-1,)])
def test_a_walk_ends_at_the_best_rate_between_two_worse_ones(best, starts):
    search = SettingsSearch(far_from(best))
    search.walk(*map(at, starts))
    assert search.best == at(best)
    k = RATES.index(best)
    assert {at(rate) for rate in RATES[max(k - 1, 0) : k + 2]} <= set(search.errors)


def test_a_second_walk_is_its_own_though_the_first_was_better():
    search = SettingsSearch(lambda s: far_from(1e-2)(s) if s.dropout else 10 + far_from(1e-4)(s))
    search.walk(at(1e-3))
    search.walk(replace(search.best, dropout=0.0))
    assert at(1e-4, 0.0) in search.errors
    assert search.best == at(1e-2)


def test_nothing_is_trained_twice():
    trained = []
    search = SettingsSearch(lambda s: trained.append(s) or s.dropout)
    search.try_out(at(1e-3), at(1e-3), at(1e-3, 0.1))
    search.try_out(at(1e-3, 0.1), at(1e-3, 0.0))
    assert trained == [at(1e-3), at(1e-3, 0.1), at(1e-3, 0.0)]
    assert search.best == at(1e-3, 0.0)


@pytest.mark.parametrize("broken", [math.nan, math.inf, -math.inf])
def test_a_training_that_broke_down_is_never_the_best(broken):
    search = SettingsSearch(lambda s: broken if s.dropout else 5.0)
    search.try_out(at(1e-3), at(1e-3, 0.0))
    assert search.best == at(1e-3, 0.0)


def test_failed_final_training_uses_next_best_settings():
    search = SettingsSearch(lambda s: {0.3: 1.0, 0.1: 2.0, 0.0: 3.0}[s.dropout])
    search.try_out(at(1e-3), at(1e-3, 0.1), at(1e-3, 0.0))
    errors = {0.3: math.nan, 0.1: 4.1, 0.0: 5.9}
    assert search.once_more(lambda s: s.dropout, errors.__getitem__) == (at(1e-3, 0.0), 0.0)
    assert search.once_more(lambda s: s.dropout, lambda _: 0.1) == (at(1e-3), 0.3)
    assert search.once_more(lambda s: s.dropout, lambda _: math.inf) == (at(1e-3), 0.3)  # nothing is better


def test_nothing_is_trained_on_more_before_anything_was_tried():
    with pytest.raises(ExperimentError, match="tried out"):
        SettingsSearch(lambda _: 1.0).once_more(lambda s: s, lambda _: 0.0)
