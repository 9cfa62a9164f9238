"""Conditional densities over bins, learnt from a table; and the scikit-learn estimator around them."""
