from dataclasses import replace

import numpy as np
import pytest
import torch

from conformodal.features.head import fit_projection
from conformodal.features.heads import Head, fit_head, soft_cross_entropy
from conformodal.features.settings import TrainingConfig, VisionError


def toy(n=120, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 6)).astype(np.float32)
    return x, np.stack([x[:, 0] > 0, x[:, 0] <= 0], axis=1).astype(np.float32)


CONFIG = TrainingConfig(epochs=12, hidden=16, dropout=0.0, learning_rate=1e-2, batch_size=16)


def test_training_learns_and_is_seeded():
    x, y = toy()
    head = fit_head(x, y, [2], soft_cross_entropy, CONFIG)
    proba = head.trained().predict_proba(x)[0]
    np.testing.assert_allclose(proba.sum(axis=1), 1)
    assert ((proba[:, 0] > 0.5) == (y[:, 0] > 0.5)).mean() > 0.95
    np.testing.assert_array_equal(fit_head(x, y, [2], soft_cross_entropy, CONFIG).trained().predict_proba(x)[0], proba)


def test_the_loss_is_the_mean_cross_entropy_of_the_targets_whatever_their_sizes():
    rng = np.random.default_rng(0)
    for sizes in ([3, 3], [2, 4]):
        head = Head(fit_projection(rng.normal(size=(20, 5)).astype(np.float32), None), sizes)
        raw = torch.from_numpy(rng.normal(size=(8, 6)))
        labels = torch.cat([torch.from_numpy(rng.dirichlet(np.ones(k), 8)) for k in sizes], dim=1)
        each = [
            -(t * torch.log(torch.softmax(r, dim=1))).sum(dim=1).mean()
            for r, t in zip(torch.split(raw, sizes, dim=1), torch.split(labels, sizes, dim=1), strict=True)
        ]
        assert float(soft_cross_entropy(head, raw, labels)) == pytest.approx(float(sum(each) / 2))


def test_too_little_data_is_refused():
    with pytest.raises(VisionError, match="two samples"):
        fit_head(np.zeros((1, 3), np.float32), np.zeros((1, 2)), [2], soft_cross_entropy, CONFIG)


@pytest.mark.parametrize("components", [4, None])
def test_a_trained_head_answers_as_torch_does(components):
    rng = np.random.default_rng(1)
    x = rng.normal(size=(300, 12)).astype(np.float32)
    y = np.concatenate([rng.dirichlet(np.ones(k), 300) for k in (5, 9, 2)], axis=1)
    head = fit_head(x, y, [5, 9, 2], soft_cross_entropy, replace(CONFIG, components=components))
    trained = head.trained()
    with torch.inference_mode():
        blocks = torch.split(head(torch.from_numpy(x)).double(), [5, 9, 2], dim=1)
        expected = [torch.softmax(block, dim=1).numpy() for block in blocks]
    found = trained.predict_proba(x)
    assert [p.shape[1] for p in found] == trained.outputs
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-6)
        np.testing.assert_allclose(one.sum(axis=1), 1)
    assert trained.hidden == CONFIG.hidden
