from types import SimpleNamespace

import numpy as np

from conformodal.datasets import Split, SplitKind
from conformodal.training.plain import train_plain
from conformodal.training.training_data import TrainingData
from conformodal.vision.settings import TrainingConfig


def made_up(n=300):
    """Poses that are linear in some features."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(n, 6 + 768)).astype(np.float32)
    targets = features[:, :6].astype(np.float64) @ rng.normal(size=(6, 7)) * [1, 2, 3, 0.1, 0.1, 0.1, 0] + 4
    parts = np.split(np.arange(n), [n // 3, 2 * n // 3])
    sequence = SimpleNamespace(recording=np.zeros(n, dtype=np.int64), given_test=None)
    split = Split(SplitKind.INTERLEAVED, 0, *parts)
    return TrainingData(sequence, split, None, features, targets, np.array([1.0, 0, 0, 0]))


def test_it_learns_from_training_and_calibration_part_and_from_no_test_frame():
    data, config = made_up(), TrainingConfig(epochs=15, hidden=32, dropout=0.0, input_dropout=0.0, components=None)
    regressor = train_plain(data, config)
    known = np.concatenate((data.split.train, data.split.calibration))
    np.testing.assert_allclose(regressor.mean, data.targets[known].mean(axis=0))
    for part in (data.split.calibration, data.split.test):
        off = (regressor.predict(data.features[part]) - data.targets[part])[:, :3]
        assert np.sqrt(np.mean(off**2)) < 0.5 * data.targets[:, :3].std()
    data.targets[data.split.test] += 100
    again = train_plain(data, config)
    np.testing.assert_array_equal(again.predict(data.features), regressor.predict(data.features))


def test_a_target_that_does_not_vary_and_unnormalised_quaternions_make_a_trajectory():
    data, config = made_up(60), TrainingConfig(epochs=2, hidden=8, components=None)
    regressor = train_plain(data, config)
    path = regressor.trajectory(data.features, np.arange(60.0))
    np.testing.assert_allclose(regressor.predict(data.features)[:, 6], 4, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(path.orientations_quat_wxyz, axis=1), 1)
    np.testing.assert_array_equal(path.positions_xyz, regressor.predict(data.features)[:, :3])
