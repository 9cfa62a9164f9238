"""From hypotheses of single images and relative motion to the probability of each place. NumPy and SciPy only."""
