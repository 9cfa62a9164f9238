"""Online conformal prediction for sequences that drift: thresholds adapt to past misses."""
