"""Whether a recording is good enough: where it is sparse, fast or ambiguous, what it guarantees, what to record."""
