from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from conformodal.datasets import Split, SplitKind
from conformodal.training.training_data import TrainingData
from conformodal.vision.backbone import feature_views
from conformodal.vision.projection import fit_projection
from conformodal.vision.settings import TrainingConfig
from experiments.baselines import (
    BASELINES,
    N_COMPONENTS,
    RegressionTask,
    deep_ensemble,
    mixture_density,
    mixture_loss,
    register_baseline,
    split_mixture,
)
from experiments.regressors import train_tuned
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
    return TrainingData(sequence, split, None, features, targets, np.array([1.0, 0, 0, 0]))


@pytest.fixture(scope="module")
def trained():
    data = make_data()
    tuned = train_tuned(data, CONFIG)
    return data, tuned, RegressionTask(data, tuned)


@pytest.mark.parametrize("whole", [False, True])
def test_projections_are_of_the_rows_asked_for_and_fitted_once(whole):
    data = make_data(n=200)
    views = feature_views(data.features.shape[1])
    for rows in (data.split.train, data.split.calibration):
        found = data.projection(rows, 4, whole=whole)
        true = fit_projection(data.features[rows], 4, views.both if whole else views.network)
        np.testing.assert_array_equal(found.components, true.components)
        np.testing.assert_array_equal(found.offset, true.offset)
        assert data.projection(rows.copy(), 4, whole=whole) is found
        assert data.projection(rows, 3, whole=whole) is not found
    other = replace(data, features=2 * data.features)
    assert not np.array_equal(other.projection(rows, 4).offset, data.projection(rows, 4).offset)


def rmse(values, data):
    return np.sqrt(np.mean((values - data.targets[data.split.test]) ** 2))


def test_all_learn_what_can_be_learnt(trained):
    data, tuned, task = trained
    x = data.features[data.split.test]
    methods = {"tuned": tuned, "mixture": mixture_density(task), "ensemble": deep_ensemble(task)}
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
    one = sum(p.numel() for p in tuned.head.parameters())
    assert ensemble.n_parameters == 5 * one
    assert not np.allclose(ensemble.predict(x), tuned.predict(x))


def test_a_mixture_answers_with_one_of_two_values_where_a_mean_lies_between():
    data = make_data(two_answers=True)
    tuned = SimpleNamespace(training=CONFIG, mean=data.targets.mean(axis=0), scale=data.targets.std(axis=0))
    answers = mixture_density(RegressionTask(data, tuned)).predict(data.features[data.split.test])
    assert np.median(np.abs(np.abs(answers) - 1)) < 0.1


def test_mixture_loss_is_the_likelihood():
    torch.manual_seed(0)
    d, n = 3, 4
    raw, y = torch.randn(n, N_COMPONENTS * (1 + 2 * d)), torch.randn(n, d)
    logits, means, log_sigma = split_mixture(raw, d)
    mixture = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(logits=logits),
        torch.distributions.Independent(torch.distributions.Normal(means, log_sigma.exp()), 1),
    )
    expected = -mixture.log_prob(y).mean() - 0.5 * d * np.log(2 * np.pi)  # constants do not matter
    assert float(mixture_loss(None, raw, y)) == pytest.approx(float(expected), abs=1e-5)
