"""A pose source of one's own: the poses of the training frames whose features are nearest.

python examples/custom_pose_source.py
"""

from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import ClassVar

import numpy as np

from conformodal.corridor import write_corridor
from conformodal.features.settings import TrainingConfig
from conformodal.io import read_recording
from conformodal.localizer.evidence import PoseMeasurement
from conformodal.localizer.sources.registry import SourceAnswer, SourceState, register_source
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.train import train_model


@register_source
@dataclass(frozen=True, eq=False)
class NearestFrame:
    name: ClassVar[str] = "nearest"
    local: ClassVar[bool] = False
    least_sigma_m: ClassVar[float] = 0.1
    features: np.ndarray
    targets: np.ndarray
    frames: np.ndarray

    @classmethod
    def fit(cls, data, frames):
        return cls(data.features[frames], data.targets[frames], frames)

    def answer(self, evidence):
        apart = ((evidence.features[:, None] - self.features) ** 2).sum(axis=2)
        found = self.targets[apart.argmin(axis=1)]
        # the standard deviations and the inlier probability are guesses here; ErrorModel learns them
        return SourceAnswer(measurements=[[PoseMeasurement(t[:3], t[3:], 0.1, 0.05, 1, 0.5)] for t in found])

    def state(self):
        return SourceState({"features": self.features, "targets": self.targets, "frames": self.frames})

    @classmethod
    def from_state(cls, state):
        return cls(state.arrays["features"], state.arrays["targets"], state.arrays["frames"])


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        sequence = read_recording(write_corridor(folder, n_modules=2, n_laps=1, seed=0))
        config = ModelConfig(alpha=0.2, sources=("head", "nearest"), training=TrainingConfig(epochs=20))
        model = train_model(sequence, config)
        run = VisualOdometry(model).process(sequence, model.split.test)
        print(f"{len(run.frames)} frames; sources: {', '.join(s.name for s in model.localizer.sources)}")
