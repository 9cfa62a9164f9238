"""A baseline of one's own beside the model's answer: a random forest on the same features and frames.

python examples/custom_baseline.py
"""

from tempfile import TemporaryDirectory

from sklearn.ensemble import ExtraTreesRegressor

from conformodal.core.files import default_cache_dir
from conformodal.corridor import write_corridor
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, normalise_quat
from conformodal.io import read_recording
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.evaluate import error_table
from conformodal.pipeline.train import prepare_training_data, train_model

if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        sequence = read_recording(write_corridor(folder, n_modules=2, n_laps=1, seed=0))
        config = ModelConfig(alpha=0.2, sources=("head",), training=TrainingConfig(epochs=20))
        data = prepare_training_data(sequence, config, FeatureCache(default_cache_dir()))
        model = train_model(data, config)
        run = VisualOdometry(model).process(sequence, model.split.test)

        forest = ExtraTreesRegressor(100, min_samples_leaf=2, max_features="sqrt", random_state=0)
        forest.fit(data.features[data.split.train], data.targets[data.split.train])
        values = forest.predict(data.features[run.frames])
        answer = Trajectory(run.timestamps_s, values[:, :3], normalise_quat(values[:, 3:]))

        rows = error_table({"ours": run.trajectory, "forest": answer}, sequence.require_truth()[run.frames])
        for name, row in rows.items():
            print(f"{name}: {row['rmse_m']:.3f} m, {row['rmse_deg']:.2f} degrees")
