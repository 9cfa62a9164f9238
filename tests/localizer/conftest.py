"""The small corridor, and frames whose features tell their poses: as cheap to learn from as it gets."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from conformodal.features.settings import TrainingConfig
from conformodal.geometry import PinholeCamera, Trajectory, normalise_quat
from conformodal.io import Recording, Split, SplitKind
from conformodal.localizer.sources.registry import SourceAnswer, SourceState
from conformodal.localizer.training_data import SourceSettings, TrainingData

THUMBNAIL = 768
CAMERA = PinholeCamera(500, 500, 320, 240, 640, 480)
SIGN = np.array([1.0, 0, 0, 0])


def poses_of(x):
    """A smooth map from six numbers to poses: positions, and rotations about z."""
    angle = x[:, 2] / 2
    positions = np.column_stack((np.sin(x[:, 0]), np.sin(x[:, 1]), x[:, 3]))
    return np.column_stack((positions, np.cos(angle), 0 * angle, 0 * angle, np.sin(angle)))


def features_of(x):
    """Six numbers of a network, and a thumbnail that follows them."""
    mix = np.random.default_rng(5).normal(size=(x.shape[1], THUMBNAIL))
    return np.concatenate((x, np.cos(x @ mix)), axis=1).astype(np.float32)


def make_data(n=240, seed=0, n_recordings=1, **settings):
    x = np.random.default_rng(seed).uniform(-1, 1, size=(n, 6)).astype(np.float32)
    targets, times = poses_of(x), np.arange(n) / 10
    truth = Trajectory(times, targets[:, :3], normalise_quat(targets[:, 3:]))
    paths, recording = tuple(Path(f"{i}.png") for i in range(n)), np.arange(n) * n_recordings // n
    sequence = Recording("numbers", paths, times, recording, CAMERA, truth)
    training = TrainingConfig(epochs=2, hidden=16, components=6)
    split = Split(SplitKind.INTERLEAVED, 0, np.arange(n), *[np.empty(0, dtype=np.int64)] * 2)
    chosen = SourceSettings(**{"n_bins": 12, "training": training, **settings})
    return TrainingData(sequence, split, features_of(x), targets, SIGN, settings=chosen)


def spoil(data, kept, value):
    """The same data, where frames that are not kept say something else; a new one: nothing of before is remembered."""
    features, targets = data.features.copy(), data.targets.copy()
    others = np.setdiff1d(np.arange(len(features)), kept)
    features[others], targets[others] = value, value
    truth = data.sequence.require_truth()
    positions, quats = truth.positions_xyz.copy(), truth.orientations_quat_wxyz.copy()
    positions[others], quats[others] = 1e9, [0, 1, 0, 0]
    sequence = replace(data.sequence, poses=Trajectory(truth.timestamps_s, positions, quats))
    return replace(data, sequence=sequence, features=features, targets=targets)


@dataclass(frozen=True, eq=False)
class Told:
    """Says of every image what it was told."""

    name: ClassVar[str] = "told"
    local: ClassVar[bool] = False
    least_sigma_m: ClassVar[float] = np.inf

    frames: np.ndarray
    answers: SourceAnswer = field(default_factory=SourceAnswer)

    @classmethod
    def fit(cls, data: TrainingData, frames):
        return cls(frames)

    def answer(self, evidence):
        return self.answers

    def state(self):
        return SourceState({"frames": self.frames})

    @classmethod
    def from_state(cls, state):
        return cls(state.arrays["frames"])


@pytest.fixture(scope="session")
def data_of():
    return make_data


@pytest.fixture(scope="session")
def spoilt():
    return spoil
