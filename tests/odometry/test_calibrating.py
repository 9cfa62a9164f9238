from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from conformodal.localization import SourceAnswer, SourceState, register_source
from conformodal.localization import source as registry
from conformodal.odometry import Calibration, ModelConfig, OdometryError, prepare_training_data, train_model
from conformodal.vision import FeatureCache


@dataclass(frozen=True, eq=False)
class SeesAll:
    """A source that looks at every frame that has a pose, whatever it is given."""

    name: ClassVar[str] = "sees-all"
    local: ClassVar[bool] = False
    frames: np.ndarray

    @classmethod
    def fit(cls, data, frames):
        return cls(np.arange(len(data.targets)))

    def answer(self, evidence):
        return SourceAnswer(measurements=[[]] * len(evidence))

    def state(self):
        return SourceState({"frames": self.frames})

    @classmethod
    def from_state(cls, state):
        return cls(state.arrays["frames"])


@pytest.mark.parametrize("calibrate_on", [Calibration.FRAMES, Calibration.STRETCHES])
def test_a_source_is_not_calibrated_on_frames_that_it_has_seen(sequence, small_world, calibrate_on, monkeypatch):
    monkeypatch.setattr(registry, "_KINDS", dict(registry._KINDS))  # known in this test alone
    register_source(SeesAll)
    config = ModelConfig(alpha=0.2, sources=(SeesAll.name,), calibrate_on=calibrate_on)
    data = prepare_training_data(sequence, config, FeatureCache(small_world.cache))
    with pytest.raises(OdometryError, match=r"pose source 'sees-all' has seen frame \d+, and (\d+) of the \1 frames"):
        train_model(data, config)
