"""Conformal calibration, from scores to thresholds: split, Mondrian (by group), weighted (covariate shift)."""
