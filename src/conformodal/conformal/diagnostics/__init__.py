"""Diagnostics of a calibration: coverage, set sizes and p-values, compared with their exact distributions."""
