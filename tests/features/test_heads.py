import threading

import numpy as np
import pytest
import torch
from torch import nn

from conformodal.features import head as heads
from conformodal.features.head import fit_head, fit_projection, mean_squared_error, soft_cross_entropy
from conformodal.features.settings import TrainingConfig, VisionError


def toy(n=120, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 6)).astype(np.float32)
    return x, np.stack([x[:, 0] > 0, x[:, 0] <= 0], axis=1).astype(np.float32)


CONFIG = TrainingConfig(epochs=12, hidden=16, dropout=0.0, learning_rate=1e-2, batch_size=16)


def test_training_learns_and_is_seeded():
    x, y = toy()
    head = fit_head(x, y, [2], soft_cross_entropy, CONFIG)
    proba = head.predict_proba(x)[0]
    np.testing.assert_allclose(proba.sum(axis=1), 1)
    assert ((proba[:, 0] > 0.5) == (y[:, 0] > 0.5)).mean() > 0.95
    np.testing.assert_array_equal(fit_head(x, y, [2], soft_cross_entropy, CONFIG).predict_proba(x)[0], proba)


@pytest.mark.parametrize("dropout", [0.3, 0.0])
def test_training_is_the_same_in_a_thread_of_its_own(dropout):
    x, y = toy()
    config, found = TrainingConfig(epochs=2, hidden=8, dropout=dropout), []
    threads = [
        threading.Thread(target=lambda: found.append(fit_head(x, y, [2], soft_cross_entropy, config).predict(x)))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_array_equal(*found)


def test_cross_entropy_gradient_matches_torch():
    rng = np.random.default_rng(0)
    for sizes in ([3, 3], [2, 4]):
        raw = torch.from_numpy(rng.normal(size=(8, 6))).requires_grad_()
        labels = np.concatenate([rng.dirichlet(np.ones(k), 8) for k in sizes], axis=1)
        blocks = zip(torch.split(raw, sizes, dim=1), torch.split(torch.from_numpy(labels), sizes, dim=1), strict=True)
        torch.stack([nn.functional.cross_entropy(r, t) for r, t in blocks]).mean().backward()
        np.testing.assert_allclose(soft_cross_entropy(raw.detach().numpy(), labels, sizes), raw.grad, atol=1e-12)


def test_the_gradient_of_the_squared_error_is_torchs():
    rng = np.random.default_rng(0)
    raw, targets = torch.from_numpy(rng.normal(size=(8, 6))).requires_grad_(), rng.normal(size=(8, 6))
    nn.functional.mse_loss(raw, torch.from_numpy(targets)).backward()
    np.testing.assert_allclose(mean_squared_error(raw.detach().numpy(), targets, [1] * 6), raw.grad, atol=1e-12)


def test_too_little_data_is_refused():
    with pytest.raises(VisionError, match="two samples"):
        fit_head(np.zeros((1, 3), np.float32), np.zeros((1, 2)), [2], soft_cross_entropy, CONFIG)


def in_torch(layers, n_inputs, hidden, n_outputs):
    network = nn.Sequential(nn.Linear(n_inputs, hidden), nn.LayerNorm(hidden), nn.GELU(), nn.Linear(hidden, n_outputs))
    names = dict(zip(network.state_dict(), heads._LAYERS, strict=True))
    network.load_state_dict({name: torch.from_numpy(layers.by_name[mine]) for name, mine in names.items()})
    return network


def test_outputs_and_gradients_are_torchs():
    rng = np.random.default_rng(2)
    layers = heads._Layers.drawn(5, 7, 9, rng)
    layers.flat += 0.3 * rng.normal(size=layers.flat.shape).astype(np.float32)
    network = in_torch(layers, 5, 7, 9)
    x, kept = rng.normal(size=(11, 5)).astype(np.float32), (rng.random((11, 7)) > 0.5).astype(np.float32) * 2
    labels = rng.normal(size=(11, 9)).astype(np.float32)
    passed = heads._forward(layers.by_name, x, None, kept)
    gradient = heads._Layers({name: values.shape for name, values in layers.by_name.items()})
    heads._backward(layers.by_name, gradient.by_name, passed, mean_squared_error(passed.raw, labels, [1] * 9))
    *first, last = network
    raw = last(nn.Sequential(*first)(torch.from_numpy(x)) * torch.from_numpy(kept))
    nn.functional.mse_loss(raw, torch.from_numpy(labels)).backward()
    np.testing.assert_allclose(passed.raw, raw.detach(), atol=2e-6)
    for mine, theirs in zip(heads._LAYERS, network.parameters(), strict=True):
        np.testing.assert_allclose(gradient.by_name[mine], theirs.grad, atol=2e-6)


def test_the_optimiser_takes_the_steps_of_torchs():
    x, y = toy(64)
    config = TrainingConfig(epochs=10, hidden=8, dropout=0.0, learning_rate=1e-2, batch_size=16, components=None)
    head = fit_head(x, y, [2], soft_cross_entropy, config)
    projection = fit_projection(x, None)
    network = in_torch(heads._Layers.drawn(6, 8, 2, np.random.default_rng(config.seed)), 6, 8, 2)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-2, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=1e-2, total_steps=40, pct_start=0.1)
    projected = torch.from_numpy(projection.apply(x))
    for epoch in range(10):
        for rows in np.split(np.random.default_rng((config.seed, epoch)).permutation(64), 4):
            optimizer.zero_grad()
            nn.functional.cross_entropy(network(projected[rows]), torch.from_numpy(y[rows])).backward()
            optimizer.step()
            schedule.step()
    # torch corrects the first moment as if momentum had always been what it is
    np.testing.assert_allclose(head.predict(x), network(projected).detach(), atol=0.1)
    assert np.corrcoef(head.predict(x).ravel(), network(projected).detach().numpy().ravel())[0, 1] > 0.999


@pytest.mark.parametrize("n_steps", [20, 500])
def test_the_rate_rises_and_falls_as_torchs(n_steps):
    optimizer = torch.optim.AdamW([nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=1.0, total_steps=n_steps, pct_start=0.1)
    for step in range(n_steps):
        [group] = optimizer.param_groups
        assert heads._one_cycle(step, n_steps) == pytest.approx((group["lr"], group["betas"][0]), abs=1e-6)
        optimizer.step()
        if step < n_steps - 1:
            schedule.step()


@pytest.mark.parametrize("n_steps", [1, 2, 9, 10, 11])
def test_the_rate_of_a_few_steps_falls_to_nothing(n_steps):
    rates, momenta = np.transpose([heads._one_cycle(step, n_steps) for step in range(n_steps)])
    assert (np.diff(rates[n_steps // 10 :]) < 0).all()
    assert rates[-1] < 1e-5
    assert ((momenta >= 0.85) & (momenta <= 0.95)).all()


def test_a_share_of_inputs_is_dropped_and_their_mean_kept():
    kept = heads._kept((1000, 50), 0.3, np.random.default_rng(0))
    assert (kept == 0).mean() == pytest.approx(0.3, abs=0.01)
    assert kept.mean() == pytest.approx(1, abs=0.01)
    assert heads._kept((3, 3), 0, None) is None


@pytest.mark.parametrize(("unit", "stored"), [(1.0, "float16"), (1e6, "float32"), (1e-6, "float32")])
def test_components_use_half_precision_if_exact(unit, stored):
    """Features in very large or small units have components beyond the range of half precision."""
    rng = np.random.default_rng(0)
    x = (rng.normal(size=(60, 5)) @ rng.normal(size=(5, 40))).astype(np.float32) * np.float32(unit)
    projection = fit_projection(x, 8)
    arrays = projection.arrays()
    assert arrays["components"].dtype == stored
    np.testing.assert_array_equal(type(projection).from_arrays(**arrays).apply(x), projection.apply(x))
    assert np.linalg.norm(projection.apply(x), axis=1).mean() == pytest.approx(np.sqrt(8), rel=0.5)
