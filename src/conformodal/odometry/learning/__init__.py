"""Training and calibrating a pose model."""

from .depths import measure_depths
from .folds import make_folds
from .training import prepare_training_data, train_model
from .training_data import TrainingData

__all__ = ["TrainingData", "make_folds", "measure_depths", "prepare_training_data", "train_model"]
