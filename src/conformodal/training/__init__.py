"""Training a model: splits, folds, pose sources and calibration."""
