"""Conformal calibration, from scores to thresholds: split, Mondrian (by group), conditional, online."""
