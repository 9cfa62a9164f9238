"""The files of a run: trajectories, regions, metrics."""
