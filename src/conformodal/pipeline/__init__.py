"""A trained model: settings, pose sources, calibrated regions, and its folder on disk."""
