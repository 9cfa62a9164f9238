import numpy as np
import pytest

from conformodal.conformal import QuantileBins
from conformodal.datasets import SplitKind
from conformodal.odometry.components import choose_components
from conformodal.vision import TrainingConfig

TRAINING = TrainingConfig(epochs=12, hidden=32, learning_rate=1e-2, batch_size=64)


def choose(features, targets, choices, kind=SplitKind.INTERLEAVED, frames=None):
    at = np.arange(len(targets)) if frames is None else frames
    bins = QuantileBins(10, 0.02).fit(targets[at])
    return choose_components(
        features.astype(np.float32),
        targets,
        np.zeros(len(targets), int),
        at,
        choices,
        kind=kind,
        bins=bins,
        sigma_bins=0.7,
        training=TRAINING,
    )


def world(n=600):
    """Targets that hang on the third and fourth strongest direction of the features."""
    rng = np.random.default_rng(0)
    hidden = rng.normal(size=(n, 30))
    targets = np.tanh(hidden[:, 2:4])
    return hidden * np.concatenate(([9, 7, 5, 4], np.full(26, 0.5))) @ np.linalg.qr(rng.normal(size=(30, 30)))[
        0
    ], targets


def test_enough_components_are_taken():
    features, targets = world()
    assert choose(features, targets, (2, 4)) == 4


def test_only_training_frames_are_looked_at():
    features, targets = world()
    spoilt_x, spoilt_y = features.copy(), targets.copy()
    spoilt_x[450:], spoilt_y[450:] = np.nan, np.nan
    assert choose(spoilt_x, spoilt_y, (2, 4), frames=np.arange(450)) == 4


def test_one_choice_needs_no_training(monkeypatch):
    monkeypatch.setattr("conformodal.odometry.components.fit_head", lambda *_, **__: pytest.fail("was trained"))
    assert choose(*world(60), (7,)) == 7
