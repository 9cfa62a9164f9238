"""A reasoner of one's own: of each frame the candidate nearest to where the camera was before.

python examples/custom_reasoner.py
"""

from itertools import pairwise
from tempfile import TemporaryDirectory

import numpy as np

from conformodal.corridor import write_corridor
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, trajectory_errors
from conformodal.io import read_recording
from conformodal.localizer.observations import Observations
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.train import train_model


def nearest(seen: Observations) -> Trajectory:
    """A reasoner is a function from observations to a path."""
    chosen = [0]  # the most probable one
    for before, here in pairwise(seen.candidates):
        apart = np.linalg.norm(here.positions_xyz - before.positions_xyz[chosen[-1]], axis=1)
        chosen.append(int(np.argmin(apart)))
    places = [here.positions_xyz[k] for here, k in zip(seen.candidates, chosen, strict=True)]
    quats = [here.orientations_quat_wxyz[k] for here, k in zip(seen.candidates, chosen, strict=True)]
    return Trajectory(seen.timestamps_s, np.array(places), np.array(quats))


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        sequence = read_recording(write_corridor(folder, n_modules=2, n_laps=1, seed=0))
        config = ModelConfig(alpha=0.2, sources=("head",), training=TrainingConfig(epochs=20))
        model = train_model(sequence, config)
        run = VisualOdometry(model).process(sequence, model.split.test)
        truth = sequence.require_truth()[run.frames]
        seen = run.observations(np.arange(len(run.frames)))
        paths = {"nearest": nearest(seen), "hindsight": run.trajectories["hindsight"]}
        for name, path in paths.items():
            print(f"{name}: {trajectory_errors(path, truth)['rmse_m']:.3f} m")
