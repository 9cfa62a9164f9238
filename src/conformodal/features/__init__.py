"""Images to features and features to probabilities, without torch."""
