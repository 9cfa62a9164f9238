"""Answering recordings and streams with a trained model, and writing the results."""
