"""Regression among the training frames whose global features are nearest."""
