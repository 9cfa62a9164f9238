from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import conformodal
from conformodal.datasets import Split, SplitKind
from conformodal.experiments.baseline_kinds import BASELINES, Problem, register_baseline
from conformodal.experiments.baselines import (
    deep_ensemble,
    dropout_passes,
    learnt_weights,
    mixture_density,
    quantile_regression,
    with_thumbnail,
)
from conformodal.experiments.classical import train_classical
from conformodal.experiments.errors import ExperimentError
from conformodal.experiments.losses import (
    N_COMPONENTS,
    WeightedHead,
    learnt_weights_loss,
    mixture_loss,
    pinball_loss,
    split_mixture,
)
from conformodal.experiments.plain import fit_values, known_frames, scaling
from conformodal.experiments.table1 import METHODS
from conformodal.networks import predict_values
from conformodal.odometry import TrainingData
from conformodal.vision import Projection, TrainingConfig, feature_views, fit_projection

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
    classical = train_classical(data, CONFIG)
    return data, classical, Problem(data, classical)


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
    data, classical, problem = trained
    x = data.features[data.split.test]
    nothing = data.targets.std()
    assert problem.config == classical.training
    found = {
        "classical": classical.predict(x),
        "weights": learnt_weights(problem).answer(x),
        "mixture": mixture_density(problem).answer(x),
        "dropout": dropout_passes(problem).answer(x),
        "ensemble": deep_ensemble(problem).answer(x),
        "quantiles": quantile_regression(problem).answer(x),
    }
    errors = {name: rmse(values, data) for name, values in found.items()}
    assert max(errors.values()) < 0.5 * nothing, errors
    assert errors["ensemble"] < 1.05 * errors["classical"]


def test_a_short_search_tries_three_rates_and_keeps_the_best(trained, monkeypatch):
    data, _, _ = trained
    tried, errors = [], {}

    def noted(data, standard, rows, settings, **options):
        head = fit_values(data, standard, rows, settings, **options)
        tried.append((settings, len(rows)))
        if len(rows) == len(data.split.train):
            check, (mean, scale) = data.split.calibration, scaling(data)
            miss = predict_values(head, data.features[check]) * scale + mean - data.targets[check]
            errors[settings] = np.mean(np.sum(miss[:, :3] ** 2, axis=1))
        return head

    monkeypatch.setattr("conformodal.experiments.classical.fit_values", noted)
    few = train_classical(data, CONFIG, thorough=False)
    assert [replace(CONFIG, learning_rate=s.learning_rate) for s, _ in tried] == [s for s, _ in tried]
    assert [s.learning_rate for s, n in tried if n == len(data.split.train)] == [3e-4, 1e-3, 3e-3]
    assert len(tried) == 4
    assert tried[-1] == (min(errors, key=errors.get), len(known_frames(data)))
    assert few.training == tried[-1][0]
    x = data.features[data.split.test]
    assert rmse(few.predict(x), data) < 0.5 * data.targets.std()


def test_a_baseline_is_named_in_one_file_of_the_source():
    source = Path(conformodal.__file__).parent
    texts = {path.relative_to(source).as_posix(): path.read_text(encoding="utf-8") for path in source.rglob("*.py")}
    assert len(BASELINES) == 7
    for name in BASELINES:
        assert [path for path, text in texts.items() if f'"{name}"' in text] == ["experiments/baselines.py"]
        assert METHODS[name] == BASELINES[name].label


def test_two_baselines_of_one_name_are_refused():
    with pytest.raises(ExperimentError, match="'deep_ensemble' already: deep ensemble of 5"):
        register_baseline("deep_ensemble", "another")(lambda problem: None)


def test_networks_see_a_thumbnail_only_if_they_are_shown_it():
    data = make_data(told_by="thumbnail")
    classical = train_classical(data, CONFIG)
    shown = with_thumbnail(Problem(data, classical))
    x = data.features[data.split.test]
    assert rmse(classical.predict(x), data) > 0.95 * data.targets.std()
    assert rmse(shown.answer(x), data) < 0.5 * data.targets.std()
    assert shown.n_parameters > 0


def test_an_ensemble_is_the_mean_of_five_and_knows_its_size(trained):
    data, classical, problem = trained
    x = data.features[:5]
    ensemble = deep_ensemble(problem)
    one = sum(p.numel() for p in classical.head.parameters())
    assert ensemble.n_parameters == 5 * one
    assert not np.allclose(ensemble.answer(x), classical.predict(x))


def test_dropout_is_averaged_the_same_way_every_time_and_switched_off_again(trained):
    data, classical, problem = trained
    x = data.features[:5]
    passes = dropout_passes(problem)
    first = passes.answer(x)
    np.testing.assert_array_equal(first, passes.answer(x))
    assert not classical.head.training
    assert np.abs(first - classical.predict(x)).max() > 0


def test_a_mixture_answers_with_one_of_two_values_where_a_mean_lies_between():
    data = make_data(two_answers=True)
    known = np.concatenate((data.split.train, data.split.calibration))
    through = fit_projection(data.features[known], CONFIG.components)
    classical = SimpleNamespace(
        training=CONFIG,
        mean=data.targets.mean(axis=0),
        scale=data.targets.std(axis=0),
        head=SimpleNamespace(projection=through),
    )
    answers = mixture_density(Problem(data, classical)).answer(data.features[data.split.test])
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


def test_learnt_variances_settle_at_the_mean_squares():
    head = WeightedHead(Projection(np.zeros(2, np.float32), np.ones(2, np.float32)), [1] * 7)
    raw, y = torch.zeros(100, 7), torch.ones(100, 7)
    y[:, :3] = 3.0
    optimiser = torch.optim.Adam([head.log_variance], lr=0.1)
    for _ in range(400):
        optimiser.zero_grad()
        learnt_weights_loss(head, raw, y).backward()
        optimiser.step()
    np.testing.assert_allclose(head.log_variance.detach().exp().numpy(), [9, 1], rtol=0.02)


def test_pinball_loss_is_least_at_the_quantiles():
    y = torch.arange(100.0)[:, None]
    loss = pinball_loss((0.1, 0.5, 0.9))

    def at(*q):
        return float(loss(None, torch.tensor(q).repeat(100, 1), y))

    best = at(9.5, 49.5, 89.5)
    for other in ((20.0, 49.5, 89.5), (9.5, 60.0, 89.5), (9.5, 49.5, 80.0)):
        assert at(*other) > best


def test_quantile_intervals_hold_as_often_as_promised(trained):
    data, _, problem = trained
    found = quantile_regression(replace(problem, alpha=0.2))
    lower, upper = found.interval(data.features[data.split.test])
    y = data.targets[data.split.test]
    held = ((y >= lower) & (y <= upper)).mean(axis=0)
    # 225 calibration and 225 test samples: the Beta-binomial law spreads by 0.04 about 0.8
    assert np.abs(held - 0.8).max() < 0.12
    assert (lower < upper).all()


def test_quantile_regression_learns_from_a_lone_training_recording():
    data = make_data(n=300)
    recording = np.zeros(300, dtype=np.int64)
    recording[data.split.calibration], recording[data.split.test] = 1, 2
    split = replace(data.split, kind=SplitKind.RECORDINGS)
    data = replace(data, split=split, sequence=SimpleNamespace(recording=recording, given_test=None))
    problem = Problem(data, train_classical(data, CONFIG), 0.2)
    lower, upper = quantile_regression(problem).interval(data.features[split.test])
    assert (lower <= upper).all()
    assert np.isfinite(lower).all()
